"""The safety plane: who may move a robot, whether it stopped, and what keeps it still."""
