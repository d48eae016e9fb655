"""Link to a ROS 2 graph by rclpy where a ROS 2 is sourced, else by bare DDS."""

from __future__ import annotations

import threading
from importlib.util import find_spec
from typing import Any

from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import (
    CancelCheck,
    Goal,
    GoalLink,
    Message,
    OnMessage,
    RosError,
    RosLink,
    Unwatch,
    never,
)
from strands_robots.ros.names import domain
from strands_robots.ros.rclpy import RclpyLink
from strands_robots.ros.rclpy_session import sourced
from strands_robots.utils import install_line

NO_LINK = (
    "No way to a ROS 2 graph: source a ROS 2 installation, or install the [ros2] extra for topics over bare DDS: "
    f"{install_line('ros2')}."
)


def ros2_backend() -> str:
    """Return ``rclpy`` or else ``dds``; :class:`RosError` where there is neither."""
    if sourced():
        return "rclpy"
    if find_spec("cyclonedds") is None:
        raise RosError(NO_LINK)
    return "dds"


class Ros2Link:
    """A link that the first use chooses; until then nothing has to be installed.

    Args:
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.

    Raises:
        ValidationError: ``domain_id`` outside its domain.
    """

    def __init__(self, domain_id: int | None = None) -> None:
        self.domain_id = domain(domain_id)
        self._lock = threading.Lock()
        self._link: RosLink | None = None

    def open(self) -> RosLink:
        """Choose the link now, by :func:`ros2_backend`, and return it."""
        with self._lock:
            if self._link is None:
                self._link = (RclpyLink if ros2_backend() == "rclpy" else DdsLink)(self.domain_id)
            return self._link

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        self.open().publish(topic, kind, fields)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return self.open().read(topic, kind, within_s)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        return self.open().call(service, kind, fields, within_s)

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        return self.open().watch(topic, kind, on_message)

    def send_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: OnMessage | None = None,
        cancelled: CancelCheck = never,
    ) -> Goal:
        link = self.open()
        if not isinstance(link, GoalLink):
            raise RosError(
                f"{action} is an action, and bare DDS carries topics only; source a ROS 2, or use rosbridge."
            )
        return link.send_goal(action, kind, goal, within_s, feedback=feedback, cancelled=cancelled)

    def close(self) -> None:
        with self._lock:
            link, self._link = self._link, None
        if link is not None:
            link.close()
