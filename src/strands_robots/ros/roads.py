"""Which road leads to a ROS 2 graph: rclpy where a ROS 2 is sourced, else bare DDS."""

from __future__ import annotations

import threading
from importlib.util import find_spec
from typing import Any

from strands_robots import settings
from strands_robots.ros.dds import DOMAIN_MAX, DdsLink
from strands_robots.ros.link import GivenUp, Goal, GoalLink, Heard, Message, RosError, RosLink, Unwatch, never
from strands_robots.ros.rclpy_link import RclpyLink
from strands_robots.ros.rclpy_session import sourced
from strands_robots.utils import install_line, whole

NO_ROAD = (
    "No road to a ROS 2 graph: source a ROS 2 installation, or install the [ros2] extra for topics over bare DDS: "
    f"{install_line('ros2')}."
)


def nearest_backend() -> str:
    """``rclpy`` where a ROS 2 is sourced, else ``dds``. Raises :class:`RosError` where there is neither."""
    if sourced():
        return "rclpy"
    if find_spec("cyclonedds") is None:
        raise RosError(NO_ROAD)
    return "dds"


def nearest(domain_id: int | None = None) -> RclpyLink | DdsLink:
    """A link by the nearest road. Raises :class:`RosError` where there is none."""
    return RclpyLink(domain_id) if nearest_backend() == "rclpy" else DdsLink(domain_id)


class Ros2Link:
    """The nearest road to a ROS 2 graph, chosen by the first use; until then nothing has to be installed.

    Args:
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.

    Raises:
        ValidationError: ``domain_id`` outside its domain.
    """

    def __init__(self, domain_id: int | None = None) -> None:
        stated = settings.integer("ROS_DOMAIN_ID") if domain_id is None else domain_id
        self.domain_id = whole("domain_id", stated, low=0, high=DOMAIN_MAX)
        self._lock = threading.Lock()
        self._link: RosLink | None = None

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        self._chosen().publish(topic, kind, fields)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return self._chosen().read(topic, kind, within_s)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        return self._chosen().call(service, kind, fields, within_s)

    def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
        return self._chosen().watch(topic, kind, heard)

    def begin_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: Heard | None = None,
        given_up: GivenUp = never,
    ) -> Goal:
        link = self._chosen()
        if not isinstance(link, GoalLink):
            raise RosError(
                f"{action} is an action, and bare DDS carries topics only; source a ROS 2, or use rosbridge."
            )
        return link.begin_goal(action, kind, goal, within_s, feedback=feedback, given_up=given_up)

    def close(self) -> None:
        with self._lock:
            link, self._link = self._link, None
        if link is not None:
            link.close()

    def _chosen(self) -> RosLink:
        with self._lock:
            if self._link is None:
                self._link = nearest(self.domain_id)
            return self._link
