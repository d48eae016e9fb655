"""Native drivers: robots that are reached without LeRobot."""
