"""ROS graphs: names, the command gate, and the roads to them."""
