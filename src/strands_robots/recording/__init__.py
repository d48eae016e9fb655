"""Recordings of robots, in an MCAP file that Foxglove and Rerun open.

| channel | schema | content |
|---|---|---|
| ``/DEVICE/EVENT`` | JSON | every event as it came |
| ``/DEVICE[/ROBOT]/joint_states`` | ``sensor_msgs/msg/JointState`` | joints, in the robot's own units |
| ``/DEVICE/camera/CAMERA`` | ``foxglove.CompressedImage`` | pictures, JPEG |
| ``/DEVICE/log`` | ``foxglove.Log`` | one line for each event that is not steady: tasks, stops, locks |
"""
