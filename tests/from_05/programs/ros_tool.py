"""A script uses the ROS tool as a function: is ROS there, what is on the graph, drive the turtle."""

from strands_robots.tools.use_ros import use_ros

for call in (
    {"action": "status"},
    {"action": "list_topics"},
    {"action": "echo", "topic": "/turtle1/pose", "timeout": 1.0, "count": 1},
    {
        "action": "publish",
        "topic": "/turtle1/cmd_vel",
        "type": "geometry_msgs/msg/Twist",
        "fields": {"linear": {"x": 2.0}, "angular": {"z": 1.5}},
    },
):
    answer = use_ros(**call)
    assert set(answer) >= {"status", "content"}, answer
    print(call["action"], answer["status"], answer["content"][0]["text"].splitlines()[0])
