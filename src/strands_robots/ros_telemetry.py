"""Bridges of joint robots to ROS: topics, refusals and joint commands."""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.envelope import is_error, text_of
from strands_robots.moved import of_module
from strands_robots.policies.base import limited, numbers
from strands_robots.ros.link import DOMAIN_MAX, BroadcastLink, Message
from strands_robots.ros.link import node_name as checked_node_name
from strands_robots.ros.rclpy import MAX_QOS_HISTORY_DEPTH, RclpyLink
from strands_robots.safety.gate import MotionGate
from strands_robots.utils import ValidationError, flag, number, shown, text, whole

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = ["MAX_QOS_HISTORY_DEPTH", "RosTelemetryBase", "RosTelemetryBridge", "checked_limits", "refuse_unsecured"]

logger = logging.getLogger(__name__)

INSECURE = "STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE"
JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"

RATE_MAX_HZ = 200.0

JOINT_SPEED = 360.0
"""Default bound of a commanded joint in the robot's unit a second: a turn, in degrees."""

STREAM_S = 0.1
"""Longest pause between two commands of a stream; after a longer one the arm's own joints are where it begins."""

Limits = dict[str, tuple[float, float]]


def segment(name: str, kind: str = "robot") -> str:
    """Return one word of a topic's name for the name of a robot or camera.

    A word may not begin with a digit, and ROS 2 hides one that begins with an underscore: ``kind`` goes before it.
    """
    word = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or kind
    return f"{kind}_{word}" if word[0].isdigit() else word


def checked_limits(limits: object) -> Limits:
    """Check ``{"<motor>.pos": (min, max)}`` of finite numbers."""
    if limits is None:
        return {}
    if not isinstance(limits, dict):
        raise ValidationError(f"joint_limits must be an object of (min, max) pairs by joint, not {shown(limits)}.")
    checked: Limits = {}
    for joint, pair in limits.items():
        where = f"joint_limits[{shown(joint)}]"
        if not isinstance(joint, str) or not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValidationError(f"{where} must be a (min, max) pair by a joint's name, not {shown(pair)}.")
        low, high = number(f"{where} min", pair[0]), number(f"{where} max", pair[1])
        if low > high:
            raise ValidationError(f"{where} must have its min at most its max, not {low:g} and {high:g}.")
        checked[joint] = (low, high)
    return checked


def refuse_unsecured(why: str | None) -> None:
    """Refuse commands from an unsecured graph, unless the operator opted out.

    Args:
        why: reason why the graph is not secured; None where it is.

    Raises:
        ValidationError: it is not secured, and ``STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE`` is not set.
    """
    if why is not None and not settings.boolean(INSECURE):
        raise ValidationError(
            f"enable_commands must be false on an unsecured ROS 2 graph, where anyone could drive the robot: {why} "
            f"Set {INSECURE}=1 to take commands all the same."
        )


class RosTelemetryBase:
    """Transport-independent part of a bridge.

    It takes the newest command once a period and drops older ones. It drops a command whole when a joint is out of its
    range, when lengths differ, when a joint is named twice, or when a value is no number.

    Args:
        robot: takes inbound commands by its ``send_action``; None for a bridge that only publishes.
        domain_id: ROS 2 domain, 0 to 232.
        enable_commands: take inbound commands, which needs a secured graph or the explicit opt-out.
        command_robot_name: name in the command topic; the robot's own by default.
        period: seconds between two looks for a command, above 0; refusals call it ``period_name``.
        joint_limits: ``{"<motor>.pos": (min, max)}`` in the robot's unit; others are not limited here.
        max_joint_speed: bound of a joint in the robot's unit a second. A command that goes beyond is cut to it, so a
            far target is reached by a stream of commands and not by one.

    Raises:
        ValidationError: an argument outside its domain, or two cameras of one topic, before anything else has happened.
    """

    def __init__(
        self,
        robot: Any,
        *,
        domain_id: int,
        enable_commands: bool,
        command_robot_name: str | None,
        period: float,
        period_name: str,
        joint_limits: dict[str, tuple[float, float]] | None = None,
        max_joint_speed: float = JOINT_SPEED,
    ) -> None:
        self._takes_commands = flag("enable_commands", enable_commands) and robot is not None
        self.domain_id = whole("domain_id", domain_id, low=0, high=DOMAIN_MAX)
        self._period_s = number(period_name, period, above=0)
        if command_robot_name is not None:
            command_robot_name = text("command_robot_name", command_robot_name, longest=128)
        self._robot = robot
        named = str(getattr(robot, "tool_name_str", "") or "robot")
        self.command_topic = f"/{segment(named if command_robot_name is None else command_robot_name)}/joint_command"
        self._topics: dict[str, str] = {}
        self._claim_known()
        self._limits = checked_limits(joint_limits)
        self._max_speed = number("max_joint_speed", max_joint_speed, above=0)
        self._sent: dict[str, float] = {}
        self._sent_at = -math.inf
        # One place: a newer command replaces an older one.
        self._latest: deque[Message] = deque(maxlen=1)
        self._done = threading.Event()
        self._thread: threading.Thread | None = None
        self._link: BroadcastLink | None = None
        self._publisher: threading.Thread | None = None

    def publish(self, cameras: Sequence[str] = ()) -> None:
        """Publish the joints once, and the newest picture of each of these cameras.

        Joints that could not be read are not published: a message of now would hold positions of the past.

        Raises:
            ValidationError: the bridge has no robot, the robot no such camera, or the camera another one's topic.
        """
        if self._robot is None:
            raise ValidationError("robot must be given to publish all of it at once, not None.")
        name, state = self._robot.tool_name_str, self._robot.get_state()
        joints = state.get("joints") or {}
        if state.get("joints_error"):
            logger.warning("The joints of %s are not published: %s", name, state["joints_error"])
        elif joints:
            self.publish_joint_states(name, list(joints), list(joints.values()))
        frames = self._robot.camera_frames() if cameras else {}
        for camera in cameras:
            if camera not in frames:
                raise ValidationError(f"cameras must be among {', '.join(frames) or 'none'}, not {shown(camera)}.")
            self.publish_image(name, camera, frames[camera])

    def start(self, rate_hz: float = 20.0, cameras: Sequence[str] = ()) -> None:
        """Publish at ``rate_hz``, above 0 and at most 200, until :meth:`shutdown`.

        Raises:
            ValidationError: a rate outside its domain, nothing to publish, or started already.
        """
        period_s = 1 / number("rate_hz", rate_hz, above=0, high=RATE_MAX_HZ)
        names = [text("cameras", each) for each in cameras]
        if self._publisher is not None:
            raise ValidationError("start was called before; shutdown ends it.")
        self.publish(names)
        name = "ros-telemetry"
        self._publisher = threading.Thread(target=self._publish_on, args=(period_s, names), name=name, daemon=True)
        self._publisher.start()

    def publish_joint_states(self, robot: str, names: list[str], positions: list[float]) -> None:
        """Publish positions in the robot's unit; drop lists of different length.

        Raises:
            ValidationError: another robot's name gives the same topic.
        """
        topic = self._claim(self.joint_states_topic(robot), f"robot {robot!r}")
        if len(names) != len(positions):
            logger.warning("%d names and %d positions of %s are not published.", len(names), len(positions), robot)
            return
        fields = {"header": _header(), "name": list(names), "position": [float(each) for each in positions]}
        self._send(topic, JOINT_STATE, fields)

    def publish_image(self, robot: str, camera: str, image: Any) -> None:
        """Publish one RGB picture of shape (height, width, 3) and type uint8.

        Raises:
            ValidationError: another camera's name gives the same topic.
        """
        topic = self._claim_image(robot, camera)
        shape = tuple(getattr(image, "shape", ()))
        if len(shape) != 3 or shape[2] != 3 or str(getattr(image, "dtype", "")) != "uint8":
            logger.warning("An image of %s must have shape (height, width, 3) and type uint8; not published.", camera)
            return
        fields = {
            "header": _header(camera),
            "height": int(shape[0]),
            "width": int(shape[1]),
            "encoding": "rgb8",
            "step": 3 * int(shape[1]),
            "data": image.tobytes(),
        }
        self._send(topic, IMAGE, fields)

    def shutdown(self) -> None:
        """Take no more commands and leave the graph. A second call does nothing."""
        self._done.set()
        for thread in (self._thread, self._publisher):
            if thread is not None and thread is not threading.current_thread():
                thread.join(2.0)
        link, self._link = self._link, None
        if link is not None:
            link.close()

    @staticmethod
    def joint_states_topic(robot: str) -> str:
        """Return the topic of a robot's joints."""
        return f"/{segment(robot)}/joint_states"

    @staticmethod
    def image_topic(robot: str, camera: str) -> str:
        """Return the topic of a camera's pictures."""
        return f"/{segment(robot)}/{segment(camera, 'camera')}/image_raw"

    def command_error(self, names: Sequence[Any], positions: Sequence[Any]) -> str | None:
        """Return why a joint command is dropped whole, or None."""
        if not names or len(names) != len(positions):
            return f"{len(names)} names and {len(positions)} positions"
        if len(set(names)) != len(names):
            return "a joint is named twice"
        for name, position in zip(names, positions, strict=True):
            try:
                value = number(str(name), position)
            except ValidationError as exc:
                return str(exc)
            low, high = self._limits.get(str(name), (value, value))
            if not low <= value <= high:
                return f"{name} must be from {low:g} to {high:g}, not {value:g}"
        return None

    def apply(self, command: Mapping[str, Any]) -> bool:
        """Command the robot by a whole ``JointState``; return True if it took it."""
        names, positions = list(command.get("name", ())), list(command.get("position", ()))
        problem = self.command_error(names, positions)
        if problem is not None:
            logger.warning("A command on %s is dropped whole: %s.", self.command_topic, problem)
            return False
        try:
            gate = getattr(self._robot, "gate", None)
            if isinstance(gate, MotionGate) and gate.held:
                return False  # one of a stream; those after the hold count
            action = self._within_speed({str(n): float(p) for n, p in zip(names, positions, strict=True)})
            # The robot's own verb asks its own gate: a locked robot refuses here as on every other path.
            answer = self._robot.send_action(action)
        except Exception:
            logger.exception("%s did not take a command.", self.command_topic)
            return False
        if is_error(answer):
            logger.warning("%s was refused: %s", self.command_topic, text_of(answer))
            return False
        self._sent, self._sent_at = {**self._sent, **action}, time.monotonic()
        return True

    def _within_speed(self, action: dict[str, float]) -> dict[str, float]:
        """Cut each target to what the joint may go since the last command."""
        since = time.monotonic() - self._sent_at
        start = self._sent
        if since > STREAM_S:
            # Whatever was commanded then, the arm may be elsewhere now.
            state: dict[str, Any] = getattr(self._robot, "get_state", dict)()
            start = {**start, **numbers(state.get("joints") or {})}
        speeds = dict.fromkeys(action, self._max_speed)
        cut = limited(action, start, speeds, min(max(since, self._period_s), STREAM_S))
        if cut != action:
            logger.info("A command on %s is cut to %g a second: %s.", self.command_topic, self._max_speed, cut)
        return cut

    def _claim_known(self) -> None:
        """Claim the topics of all that this bridge knows before it publishes."""
        frames = getattr(self._robot, "camera_frames", None)
        if not callable(frames):
            return
        names: list[str] = []
        with contextlib.suppress(Exception):  # a foreign camera that fails is reported when it is published
            names = [str(name) for name in frames()]
        for camera in names:
            self._claim_image(str(getattr(self._robot, "tool_name_str", "") or "robot"), camera)

    def _claim_image(self, robot: str, camera: str) -> str:
        return self._claim(self.image_topic(robot, camera), f"camera {camera!r} of {robot!r}")

    def _claim(self, topic: str, what: str) -> str:
        """Return the topic, which is of the first that asks for it; refuse another."""
        owner = self._topics.setdefault(topic, what)
        if owner != what:
            raise ValidationError(f"{what} must have a topic of its own: {topic} is that of {owner}. Rename one.")
        return topic

    def _begin(self, link: BroadcastLink, name: str, *, open_now: bool = False) -> None:
        """Use this link from now on, and take commands from it where enabled.

        Args:
            link: closed again where this raises.
            name: of the thread.
            open_now: join the graph at once, so that a refusal is raised here and not by the first message.
        """
        try:
            if open_now:
                link.open()
            self._link = link
            if self._takes_commands:
                link.watch(self.command_topic, JOINT_STATE, self._latest.append)
                self._thread = threading.Thread(target=self._poll, name=name, daemon=True)
                self._thread.start()
        except BaseException:
            link.close()
            raise

    def _send(self, topic: str, kind: str, fields: Message) -> None:
        link = self._link
        if link is None:
            logger.warning("Nothing is published on %s: the bridge was shut down.", topic)
        else:
            link.broadcast(topic, kind, fields)

    def _publish_on(self, period_s: float, cameras: list[str]) -> None:
        due = time.monotonic() + period_s
        while not self._done.wait(max(0.0, due - time.monotonic())):
            due = max(due + period_s, time.monotonic())
            try:
                self.publish(cameras)
            except Exception as exc:  # noqa: BLE001 - whatever a device raises, the next sample is tried
                logger.warning("%s was not published: %s", type(self).__name__, exc)

    def _poll(self) -> None:
        while not self._done.wait(min(self._period_s, threading.TIMEOUT_MAX)):
            if self._latest:
                self.apply(self._latest.popleft())


class RosTelemetryBridge(RosTelemetryBase):
    """Bridge through rclpy, for real robots and for simulations.

    Args:
        robot: see :class:`RosTelemetryBase`, as for ``enable_commands``, ``command_robot_name``, ``joint_limits`` and
            ``max_joint_speed``.
        domain_id: ROS 2 domain, 0 to 232. The node has a context of its own, so no environment variable is written.
        node_name: name of the node; each subclass has its own default.
        qos_depth: KEEP_LAST history of each endpoint, 1 to :data:`MAX_QOS_HISTORY_DEPTH`.
        spin_period: seconds between two looks for a command, above 0.

    Raises:
        ValidationError: an argument outside its domain, or commands on an unsecured graph; no node was made.
        RosError: no ROS 2 is sourced, or it did not start.
    """

    default_node_name = "strands_telemetry"

    def __init__(
        self,
        robot: Any = None,
        *,
        domain_id: int = 0,
        node_name: str | None = None,
        qos_depth: int = 10,
        enable_commands: bool = True,
        command_robot_name: str | None = None,
        spin_period: float = 0.02,
        joint_limits: dict[str, tuple[float, float]] | None = None,
        max_joint_speed: float = JOINT_SPEED,
    ) -> None:
        super().__init__(
            robot,
            domain_id=domain_id,
            enable_commands=enable_commands,
            command_robot_name=command_robot_name,
            period=spin_period,
            period_name="spin_period",
            joint_limits=joint_limits,
            max_joint_speed=max_joint_speed,
        )
        depth = whole("qos_depth", qos_depth, low=1, high=MAX_QOS_HISTORY_DEPTH)
        name = checked_node_name("node_name", self.default_node_name if node_name is None else node_name)
        if self._takes_commands:
            refuse_unsecured(rclpy_security_gap())
        self._begin(RclpyLink(self.domain_id, name=name, depth=depth), f"{name}-commands", open_now=True)


def rclpy_security_gap() -> str | None:
    """Return why the graph that rclpy joins is not secured, or None: it is.

    ROS 2 compares the two values letter by letter and falls back to an open graph on any other, so this does too.
    """
    if settings.verbatim("ROS_SECURITY_ENABLE") != "true":
        return "ROS_SECURITY_ENABLE is not true."
    if settings.verbatim("ROS_SECURITY_STRATEGY") != "Enforce":
        return "ROS_SECURITY_STRATEGY is not Enforce."
    keystore = settings.verbatim("ROS_SECURITY_KEYSTORE")
    if not keystore or not Path(keystore).is_dir():
        return "ROS_SECURITY_KEYSTORE names no folder."
    return None


def _header(frame_id: str = "") -> dict[str, Any]:
    sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}
