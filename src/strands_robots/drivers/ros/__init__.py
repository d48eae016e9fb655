"""Robots that already live on a ROS graph, behind one drive contract."""
