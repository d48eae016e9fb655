"""Evaluation of policies in simulation: tasks, experts, episodes, report."""
