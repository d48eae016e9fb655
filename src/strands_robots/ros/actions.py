"""``ros_action``: inspect, read and write a ROS graph; the link that is there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import (
    CancelCheck,
    Goal,
    GoalLink,
    Message,
    OnMessage,
    RosError,
    RosLink,
    Unwatch,
    absolute,
    domain,
    graph_name,
    interface,
    never,
    run_goal,
)
from strands_robots.ros.rclpy import RclpyLink, sourced
from strands_robots.ros.rosbridge import RosbridgeLink
from strands_robots.utils import MissingExtraError, ValidationError, choice, install_line, mapping, number, whole

NO_LINK = (
    "No way to a ROS 2 graph: source a ROS 2 installation, or install the [ros2] extra for topics over bare DDS: "
    f"{install_line('ros2')}."
)

BACKENDS = ("auto", "rclpy", "dds", "rosbridge")
ACTIONS = (
    "status",
    "list_topics",
    "list_nodes",
    "list_services",
    "list_actions",
    "info",
    "echo",
    "publish",
    "service_call",
    "action_goal",
)
INSTEAD = {
    "types": "docs/ros.md lists the types that bare DDS carries",
    "advertise": "publish advertises its topic and waits for a subscription",
    "subscribe": "echo reads the next messages",
}
"""Actions of strands-robots 0.5, and what to use."""

COUNT_MAX = 1000
RATE_MAX_HZ = 100.0
TIMEOUT_MAX_S = 600.0
RATE_MIN_HZ = 1 / TIMEOUT_MAX_S

GraphLink = RclpyLink | DdsLink | RosbridgeLink

_links: dict[tuple[Any, ...], GraphLink] = {}
_links_lock = threading.Lock()

_LISTS: dict[str, Callable[[GraphLink], Sequence[Any]]] = {
    "list_topics": lambda graph: graph.topics(),
    "list_nodes": lambda graph: graph.nodes(),
    "list_services": lambda graph: graph.services(),
    "list_actions": lambda graph: graph.actions(),
}


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


def link_for(backend: str, host: str, port: int, domain_id: int | None) -> GraphLink:
    """Return the process's link to a graph; ``auto`` asks :func:`ros2_backend`.

    Raises:
        ValidationError: an address or a domain outside its domain.
        RosError: ``auto``, and neither a ROS 2 nor bare DDS is there.
    """
    makers: dict[str, Callable[[], GraphLink]] = {
        "rclpy": lambda: RclpyLink(domain_id),
        "dds": lambda: DdsLink(domain_id),
        "rosbridge": lambda: RosbridgeLink(host, port),
    }
    if backend == "auto":
        backend = ros2_backend()
    with _links_lock:
        key = (backend, host, port) if backend == "rosbridge" else (backend, domain_id)
        if key not in _links:
            _links[key] = makers[backend]()
        return _links[key]


def close_links() -> None:
    """Leave every graph that :func:`ros_action` has used."""
    with _links_lock:
        links = list(_links.values())
        _links.clear()
    for link in links:
        link.close()


def ros_action(
    action: str,
    *,
    name: str = "",
    type: str | None = None,  # noqa: A002 - ROS calls it so
    fields: Mapping[str, Any] | None = None,
    count: int = 1,
    rate: float = 10.0,
    timeout: float = 5.0,
    backend: str = "auto",
    host: str = "localhost",
    port: int = 9090,
    domain_id: int | None = None,
    tool_context: Any = None,
    command_gate: CommandGate | None = None,
) -> Envelope:
    """Do one thing on a ROS graph; every refusal and failure is an error envelope.

    A publish, a service call and a goal on a command surface ask the command gate first. They are single commands:
    no lockout refuses them and no halt ends what they began, so drive a robot by its own class.

    Args:
        action: one of :data:`ACTIONS`.
        name: topic, service or action, where the action needs one.
        type: its interface; publish, service_call and action_goal need one.
        fields: of the message, request or goal; omitted ones are zero.
        count: messages to read or publish, 1 to 1000. ``rate``: Hz of several, 1/600 to 100.
        timeout: seconds to wait for each message, answer or end, above 0 and at most 600.
        backend: ``rclpy``, ``dds`` (topics alone), ``rosbridge``, or ``auto``: rclpy where a ROS 2 is sourced,
            else bare DDS.
        host: of the rosbridge server, with its ``port``. ``domain_id``: of DDS, ``ROS_DOMAIN_ID`` by default.
    """
    try:
        if isinstance(action, str) and action in INSTEAD:
            return error(f"action {action} is none here: {INSTEAD[action]}.")
        wanted = choice("action", action, ACTIONS)
        chosen = choice("backend", backend, BACKENDS)
        seconds = number("timeout", timeout, above=0, high=TIMEOUT_MAX_S)
        link = link_for(chosen, host, port, domain_id)
        if wanted in ("status", *_LISTS):
            return _listing(link, wanted)
        target = graph_name("name", name)
        kind = None if type is None and wanted in ("info", "echo") else interface("type", type)
        messages = whole("count", count, low=1, high=COUNT_MAX)
        if wanted == "info":
            return _info(link, target)
        if wanted == "echo":
            found = [_jsonable(link.read(target, kind, seconds)) for _ in range(messages)]
            return success(f"{messages} messages of {target}.", topic=target, messages=found)
        assert kind is not None
        body = mapping("fields", {} if fields is None else fields)
        hertz = number("rate", rate, low=RATE_MIN_HZ, high=RATE_MAX_HZ)
        refusal = (command_gate or CommandGate()).refusal(target, kind, wanted, tool_context)
        if refusal is not None:
            return refusal
        if wanted == "publish":
            return _publish(link, target, kind, body, messages, rate_hz=hertz)
        if wanted == "service_call":
            return success(f"{target} answered.", response=_jsonable(link.call(target, kind, body, seconds)))
        return _goal(link, target, kind, body, seconds)
    except (ValidationError, RosError, MissingExtraError) as exc:
        return error(str(exc))


def _listing(graph: GraphLink, action: str) -> Envelope:
    if action == "status":
        count = len(graph.topics())
        return success(f"{count} topics can be seen.", backend=type(graph).__name__, topics=count)
    what = action.removeprefix("list_")
    rows = _LISTS[action](graph)
    lines = [f"{row['topic']} {row['type']}" if isinstance(row, dict) else row for row in rows]
    return success("\n".join(lines) or f"No {what}.", **{what: rows})


def _info(link: GraphLink, topic: str) -> Envelope:
    wanted = absolute(topic)
    row = next((each for each in link.topics() if each["topic"] == wanted), None)
    if row is None:
        return error(f"{wanted} is not on the graph.", topic=wanted)
    return success(f"{wanted} carries {row['type']}.", **row)


def _publish(link: RosLink, topic: str, kind: str, fields: Message, count: int, *, rate_hz: float) -> Envelope:
    for sent in range(count):
        if sent:
            time.sleep(1 / rate_hz)
        try:
            link.publish(topic, kind, fields)
        except RosError as exc:
            return error(f"{sent} of {count} messages were published: {exc}", messages=sent)
    return success(f"Published {count} messages on {topic}.", topic=topic, messages=count)


def _goal(link: RosLink, action: str, kind: str, goal: Message, within_s: float) -> Envelope:
    report = run_goal(link, action, kind, goal, within_s)
    fields = {"goal_status": report.status, "goal_state": report.state, "values": _jsonable(report.values)}
    if report.state != "succeeded":
        return error(f"{action}: {report.sentence()}", **fields)
    return success(f"{action} succeeded.", **fields)


def _jsonable(value: Any) -> Any:
    """Return a message for JSON, with the number of bytes in place of bytes."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping):
        return {key: _jsonable(each) for key, each in value.items()}
    return [_jsonable(each) for each in value] if isinstance(value, list | tuple) else value
