"""Robots that already live on a ROS graph: one drive contract, and a class for each way to reach them."""
