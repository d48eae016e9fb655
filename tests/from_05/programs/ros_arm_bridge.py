"""An arm on a ROS 2 graph: its joints are published, and its commands are taken from a topic."""

from strands_robots.hardware_ros_bridge import HardwareRosBridge


class Arm:
    """What the bridge asks of a robot."""

    tool_name_str = "arm"

    def send_action(self, action, robot_name=None):
        return {"status": "success", "content": [{"text": "sent"}]}


bridge = HardwareRosBridge(
    Arm(), domain_id=7, node_name="arm_bridge", enable_commands=True, joint_limits={"shoulder.pos": (-1.0, 1.0)}
)
bridge.publish("arm", {"shoulder.pos": 0.5})
bridge.shutdown()
