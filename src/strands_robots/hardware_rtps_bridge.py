"""A real robot's joints and cameras on a ROS 2 graph, and its joint commands from it, over bare DDS."""

from __future__ import annotations

import logging
import threading
from importlib.util import find_spec
from typing import Any

from strands_robots import settings
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import Message, Unwatch
from strands_robots.ros_telemetry import IMAGE, JOINT_STATE, RosTelemetryBase, checked_limits
from strands_robots.utils import ValidationError, mapping, missing_extra, shown, text

logger = logging.getLogger(__name__)

INSECURE = "STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE"
CREDENTIALS = ("identity_ca", "certificate", "private_key", "governance", "permissions")


class HardwareRtpsBridge(RosTelemetryBase):
    """Publishes joints and images, and forwards ``/<robot>/joint_command`` to ``robot.send_action``.

    The newest command is taken once a ``poll_period``; older ones are dropped. A command is dropped whole when a joint
    is out of its range, when lengths differ, or when a value is no number.

    Args:
        robot: the robot to drive; None for a bridge that only publishes.
        domain_id: DDS domain, 0 to 232.
        enable_commands: take commands, which needs a secured graph or the explicit opt-out.
        command_robot_name: whose command topic is taken; the robot's own name by default.
        poll_period: seconds between two looks for a command, above 0.
        joint_limits: ``{"<motor>.pos": (min, max)}`` in the robot's unit; what is not named is not limited here.
        dds_security_config: paths or URIs of ``identity_ca``, ``certificate``, ``private_key``, ``governance``,
            ``permissions`` and, optionally, ``permissions_ca``. The supported Cyclone DDS wheels have no DDS Security,
            so that a well-formed one is refused too: nothing is started without what it asks for.

    Raises:
        ValidationError: an argument outside its domain, or commands on a graph that nobody secured.
        MissingExtraError: the [ros2] extra is not installed.
    """

    def __init__(
        self,
        robot: Any = None,
        *,
        domain_id: int = 0,
        enable_commands: bool = True,
        command_robot_name: str | None = None,
        poll_period: float = 0.02,
        joint_limits: dict[str, tuple[float, float]] | None = None,
        dds_security_config: dict[str, str] | None = None,
    ) -> None:
        super().__init__(
            robot,
            domain_id=domain_id,
            enable_commands=enable_commands,
            command_robot_name=command_robot_name,
            period=poll_period,
            period_name="poll_period",
        )
        if find_spec("cyclonedds") is None:
            raise missing_extra("HardwareRtpsBridge", "ros2")
        self._limits = checked_limits(joint_limits)
        _refuse_security(dds_security_config)
        if self._takes_commands and not settings.boolean(INSECURE):
            raise ValidationError(
                f"enable_commands must be false on an unsecured DDS graph, where anybody could drive the robot; set "
                f"{INSECURE}=1 to take commands all the same."
            )
        self._link = DdsLink(self.domain_id)
        self._latest: Message | None = None
        self._done = threading.Event()
        self._thread: threading.Thread | None = None
        self._unwatch: Unwatch | None = None
        if self._takes_commands:
            self._unwatch = self._link.watch(self.command_topic, JOINT_STATE, self._keep)
            self._thread = threading.Thread(target=self._poll, name="rtps-bridge", daemon=True)
            self._thread.start()

    def publish_joint_states(self, robot: str, names: list[str], positions: list[float]) -> None:
        """Publish joint positions in the robot's own unit; lists of different length are dropped with a warning."""
        if len(names) != len(positions):
            logger.warning("%d names and %d positions of %s are not published.", len(names), len(positions), robot)
            return
        fields = {"name": list(names), "position": [float(each) for each in positions]}
        self._link.tell(self.joint_states_topic(robot), JOINT_STATE, fields)

    def publish_image(self, robot: str, camera: str, image: Any) -> None:
        """Publish one RGB picture of shape (height, width, 3) and type uint8; any other is dropped with a warning."""
        shape = tuple(getattr(image, "shape", ()))
        if len(shape) != 3 or shape[2] != 3 or str(getattr(image, "dtype", "")) != "uint8":
            logger.warning("An image of %s must have shape (height, width, 3) and type uint8; not published.", camera)
            return
        fields = {
            "header": {"frame_id": camera},
            "height": int(shape[0]),
            "width": int(shape[1]),
            "encoding": "rgb8",
            "step": 3 * int(shape[1]),
            "data": image.tobytes(),
        }
        self._link.tell(self.image_topic(robot, camera), IMAGE, fields)

    def shutdown(self) -> None:
        """Take no more commands and leave the graph. A second call does nothing."""
        self._done.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2.0)
        self._link.close()

    def _keep(self, command: Message) -> None:
        self._latest = command

    def _poll(self) -> None:
        while not self._done.wait(self._period_s):
            command, self._latest = self._latest, None
            if command is not None:
                self.apply(command)


def _refuse_security(config: object) -> None:
    if config is None:
        return
    checked = mapping("dds_security_config", config)
    missing = [key for key in CREDENTIALS if key not in checked]
    unknown = sorted(set(checked) - {*CREDENTIALS, "permissions_ca"})
    if missing or unknown:
        raise ValidationError(
            f"dds_security_config must have {', '.join(CREDENTIALS)} and may have permissions_ca, not {shown(checked)}."
        )
    for key, value in checked.items():
        text(f"dds_security_config[{key!r}]", value)
    raise ValidationError(
        "dds_security_config cannot be honoured: the wheels of cyclonedds 11 have no DDS Security. Use a ROS 2 whose "
        "middleware has it, behind a rosbridge server."
    )
