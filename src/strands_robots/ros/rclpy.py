"""Link to a ROS 2 graph through rclpy of the ROS 2 that is sourced."""

from __future__ import annotations

import logging
import re
import threading
import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any
from weakref import WeakSet

from strands_robots.ros.link import CancelCheck, Goal, Message, OnMessage, RosError, Unwatch, never, next_message
from strands_robots.ros.names import absolute, bare_kind, class_place, domain, is_latched, node_name
from strands_robots.ros.rclpy_session import RclpySession, ros2
from strands_robots.utils import number, shown, whole

logger = logging.getLogger(__name__)

DEPTH = 10
MAX_QOS_HISTORY_DEPTH = 2**31 - 1
"""Deepest KEEP_LAST history: DDS carries the depth as a signed 32-bit number."""

WAIT_S = 0.002

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, *(\d+))?>\Z")
_ARRAY = re.compile(r"(.+)\[(\d+)\]\Z")
_INTEGER = re.compile(r"(u?)int(8|16|32|64)\Z")
_NUMBERS: dict[str, type] = {"float": float, "double": float, "long double": float, "boolean": bool}


class RclpyLink:
    """A link of topics, services and actions, opened by the first use.

    A published message needs a subscription: while no subscription matches, a publish waits ``match_s`` and fails.

    Args:
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        name: of our node.
        depth: KEEP_LAST history of each publisher and subscription, 1 to :data:`MAX_QOS_HISTORY_DEPTH`.
        match_s: how long a publish waits for a first subscription, and a read without a type for a publisher.

    Raises:
        ValidationError: an argument outside its domain.
    """

    def __init__(
        self,
        domain_id: int | None = None,
        *,
        name: str = "strands_robots",
        depth: int = DEPTH,
        match_s: float = 0.5,
    ) -> None:
        self.domain_id = domain(domain_id)
        self.name = node_name("name", name)
        self._depth = whole("depth", depth, low=1, high=MAX_QOS_HISTORY_DEPTH)
        self._match_s = number("match_s", match_s, low=0, high=60)
        self._lock = threading.RLock()
        self._session: RclpySession | None = None
        self._opened_at = 0.0
        self._made: dict[tuple[str, str, str], Any] = {}
        self._goals: WeakSet[Goal] = WeakSet()

    def open(self) -> RclpySession:
        """Join the graph now, rather than at the first use. Raises :class:`RosError`."""
        with self._lock:
            if self._session is None:
                self._session = RclpySession(self.name, self.domain_id)
                self._opened_at = time.monotonic()
            return self._session

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        message = filled(interface_class(kind, "msg")(), fields)
        publisher = self._publisher(topic, kind)
        if not self._wait_for(lambda: bool(publisher.get_subscription_count()), self._match_s):
            raise RosError(f"No subscription to {topic} as {bare_kind(kind)} in domain {self.domain_id}.")
        _send(publisher, message, topic, kind)

    def broadcast(self, topic: str, kind: str, fields: Message) -> None:
        """Publish, such as telemetry, whether or not there is a subscription."""
        message = filled(interface_class(kind, "msg")(), fields)
        _send(self._publisher(topic, kind), message, topic, kind)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return next_message(self.watch, topic, kind, within_s)

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        session = self.open()
        qos = ros2("rclpy.qos")
        latched = is_latched(topic)
        # Best effort takes what a sensor sends so as well as what is sent reliably; what is latched is sent so.
        profile = qos.QoSProfile(
            history=qos.HistoryPolicy.KEEP_LAST,
            depth=self._depth,
            reliability=qos.ReliabilityPolicy.RELIABLE if latched else qos.ReliabilityPolicy.BEST_EFFORT,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if latched else qos.DurabilityPolicy.VOLATILE,
        )
        struct = interface_class(kind or self._kind_of(topic), "msg")
        deliver = _deliver_to(on_message, topic)
        subscription = session.node.create_subscription(struct, absolute(topic), deliver, profile)
        watched = threading.Event()

        def unwatch() -> None:
            with self._lock:
                if not watched.is_set() and self._session is session:
                    session.node.destroy_subscription(subscription)
                watched.set()

        return unwatch

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        deadline = time.monotonic() + within_s
        struct = interface_class(kind, "srv")
        request = filled(struct.Request(), fields)
        session = self.open()
        client = self._cached("srv", service, kind, lambda: session.node.create_client(struct, absolute(service)))
        if not self._wait_for(client.service_is_ready, within_s):
            raise RosError(f"No server for the service {service}.")
        answer, futures = Goal(lambda: None), list[Any]()

        def request_call() -> None:
            futures.append(client.call_async(request))
            futures[0].add_done_callback(lambda future: _settle(future, answer, plain))

        session.later(request_call)
        if not answer.done.wait(max(0.0, deadline - time.monotonic())):
            session.later(lambda: client.remove_pending_request(futures[0]))
            raise RosError(f"{service} did not answer within {within_s:g} s.")
        if answer.problem:
            raise RosError(f"{service} failed: {answer.problem}")
        return dict(answer.values)

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
        deadline = time.monotonic() + within_s
        struct = interface_class(kind, "action")
        message = filled(struct.Goal(), goal)
        session = self.open()
        make = ros2("rclpy.action").ActionClient
        client = self._cached("action", action, kind, lambda: make(session.node, struct, absolute(action)))
        if not self._wait_for(client.server_is_ready, within_s, cancelled):
            raise RosError(f"No server for the action {action}.")
        sending = _Sending(session, action)
        self._goals.add(sending.goal)
        on_feedback = (
            None
            if feedback is None
            else _deliver_to(feedback, f"{action} feedback", lambda received: received.feedback)
        )
        session.later(lambda: sending.send(client, message, on_feedback))
        try:
            self._wait_for(sending.answered.is_set, deadline - time.monotonic(), cancelled)
        except BaseException:
            # A Ctrl-C here must not leave the robot on its way.
            sending.goal.cancel()
            raise
        if sending.goal.rejected:
            raise RosError(sending.goal.problem)
        return sending.goal

    def topics(self) -> list[dict[str, Any]]:
        """Return ``topic``, ``type``, ``publishers`` and ``subscriptions`` of each topic."""
        node = self._settled_node()
        return [
            {
                "topic": topic,
                "type": kind,
                "publishers": node.count_publishers(topic),
                "subscriptions": node.count_subscribers(topic),
            }
            for topic, kinds in sorted(node.get_topic_names_and_types())
            for kind in sorted(kinds)
        ]

    def nodes(self) -> list[str]:
        """Return the names of the nodes, with their namespaces."""
        found = self._settled_node().get_node_names_and_namespaces()
        return sorted(f"{space.rstrip('/')}/{name}" for name, space in found)

    def services(self) -> list[str]:
        """Return the names of the services."""
        return sorted(name for name, _ in self._settled_node().get_service_names_and_types())

    def actions(self) -> list[str]:
        """Return the names of the actions."""
        return sorted(name for name, _ in ros2("rclpy.action").get_action_names_and_types(self._settled_node()))

    def close(self) -> None:
        with self._lock:
            session, self._session = self._session, None
            actions = [made for (section, _, _), made in self._made.items() if section == "action"]
            self._made.clear()
        for goal in list(self._goals):
            goal.fail("the link was closed")
        if session is not None:
            session.close(actions)

    def _publisher(self, topic: str, kind: str) -> Any:
        session = self.open()
        struct, qos = interface_class(kind, "msg"), ros2("rclpy.qos")
        profile = qos.QoSProfile(
            history=qos.HistoryPolicy.KEEP_LAST, depth=self._depth, reliability=qos.ReliabilityPolicy.RELIABLE
        )
        make = session.node.create_publisher
        return self._cached("msg", topic, kind, lambda: make(struct, absolute(topic), profile))

    def _cached(self, section: str, name: str, kind: str, make: Callable[[], Any]) -> Any:
        key = (section, name, bare_kind(kind))
        with self._lock:
            if key not in self._made:
                try:
                    self._made[key] = make()
                except Exception as exc:
                    raise RosError(f"{name} cannot be used as {bare_kind(kind)}: {exc}") from exc
            return self._made[key]

    def _kind_of(self, topic: str) -> str:
        node, found = self.open().node, list[str]()

        def known() -> bool:
            rows = dict(node.get_topic_names_and_types())
            found.extend(rows.get(absolute(topic), ()))
            return bool(found)

        if not self._wait_for(known, self._match_s):
            raise RosError(f"No publisher of {topic} in domain {self.domain_id}, so its type is not known.")
        return found[0]

    def _settled_node(self) -> Any:
        """Return our node once it has had ``match_s`` to discover the graph."""
        node = self.open().node
        left = self._opened_at + self._match_s - time.monotonic()
        self._wait_for(lambda: len(node.get_node_names_and_namespaces()) > 1, left)
        return node

    def _wait_for(self, true: Callable[[], bool], within_s: float, cancelled: CancelCheck = never) -> bool:
        deadline = time.monotonic() + within_s
        while not true():
            if time.monotonic() >= deadline or cancelled():
                return False
            time.sleep(WAIT_S)
        return not cancelled()


class _Sending:
    """A goal being sent; all its steps happen on the executor's thread."""

    def __init__(self, session: RclpySession, action: str) -> None:
        self._session = session
        self._action = action
        self._handle: Any = None
        self._cancelled = False
        self.answered = threading.Event()
        self.goal = Goal(lambda: session.later(self._cancel))

    def send(self, client: Any, message: Any, on_feedback: Callable[[Any], None] | None) -> None:
        if self._cancelled:
            self.goal.reject(f"{self._action} was given up before its goal was sent.")
            return
        client.send_goal_async(message, feedback_callback=on_feedback).add_done_callback(self._accepted)

    def _accepted(self, future: Any) -> None:
        failed = future.exception()
        handle = None if failed is not None else future.result()
        if handle is None:
            self.goal.fail(f"{self._action} did not take the goal: {failed}")
        elif not handle.accepted:
            self.goal.reject(f"{self._action} refused the goal.")
        else:
            self._handle = handle
            self._request_result()
            if self._cancelled:
                self._cancel()
        self.answered.set()

    def _request_result(self) -> None:
        self._handle.get_result_async().add_done_callback(self._ended)

    def _cancel(self) -> None:
        # A goal that its server has not accepted yet is cancelled when it is.
        self._cancelled = True
        if self._handle is not None:
            self._handle.cancel_goal_async().add_done_callback(self._cancel_answered)

    def _cancel_answered(self, future: Any) -> None:
        # A goal that cannot be cancelled may have ended before we asked for its result; its server keeps the result.
        if future.exception() is None and not future.result().goals_canceling and not self.goal.done.is_set():
            self._request_result()

    def _ended(self, future: Any) -> None:
        _settle(future, self.goal, lambda answer: plain(answer.result), lambda answer: int(answer.status))


def _settle(
    future: Any, answer: Goal, values: Callable[[Any], Any], status: Callable[[Any], int] = lambda answer: 0
) -> None:
    failed = future.exception()
    if failed is not None or future.result() is None:
        answer.fail(str(failed or "no answer"))
    else:
        answer.end(status(future.result()), values(future.result()))


def _deliver_to(
    on_message: OnMessage, what: str, part: Callable[[Any], Any] = lambda message: message
) -> Callable[[Any], None]:
    def deliver(message: Any) -> None:
        try:
            on_message(plain(part(message)))
        except Exception:
            logger.exception("A watcher of %s failed.", what)

    return deliver


def _send(publisher: Any, message: Any, topic: str, kind: str) -> None:
    try:
        publisher.publish(message)
    except Exception as exc:
        raise RosError(f"{topic} did not take a {bare_kind(kind)}: {exc}") from exc


def interface_class(kind: str, section: str) -> Any:
    """Return the class of an interface; ``section`` is msg, srv or action."""
    module, name = class_place(kind, section)
    try:
        found = getattr(import_module(module), name, None)
    except ModuleNotFoundError as exc:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: no module {exc.name}.") from exc
    if found is None:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: {module} has no {name}.")
    return found


def filled(message: Any, fields: Mapping[str, Any], place: str = "") -> Any:
    """Set fields of ``message`` and return it; a wrong one is a RosError.

    A message class describes its fields by ``get_fields_and_field_types``, in the terms of the ROS 2 interface
    definition: ``double``, ``string<10>``, ``sequence<uint8>``, ``double[36]``, ``geometry_msgs/Vector3``.
    """
    types = message.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise RosError(f"{type(message).__name__} has no field {place}{name}; it has {', '.join(types)}.")
        where = f"{place}{name}"
        try:
            setattr(message, name, _value(types[name], value, where, getattr(message, name)))
        except (AssertionError, OverflowError) as exc:
            raise RosError(f"{where} must be a {types[name]}, not {shown(value)}.") from exc
    return message


def plain(message: Any) -> dict[str, Any]:
    """Return the fields of a message as numbers, text, bytes, lists and dictionaries."""
    types = message.get_fields_and_field_types()
    return {name: _plain(kind, getattr(message, name)) for name, kind in types.items()}


def _value(kind: str, value: Any, place: str, zero: Any = None) -> Any:
    if (several := _several(kind)) is not None:
        return _items(*several, value, place)
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(interface_class(kind, "msg")() if zero is None else zero, value, f"{place}.")
    if kind == "octet":
        if not isinstance(value, int) or isinstance(value, bool):
            raise RosError(f"{place} must be an octet, not {shown(value)}.")
        return value.to_bytes(1, "little")
    wanted = str if kind.partition("<")[0] in ("string", "wstring") else _NUMBERS.get(kind, int)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise RosError(f"{place} must be a {kind}, not {shown(value)}.")
    # Newer ROS 2 checks no value in its setters, and the conversion to C would cut an integer.
    return _whole(kind, value, place) if isinstance(value, int) else value


def _whole(kind: str, value: int, place: str) -> int:
    integer = _INTEGER.match(kind)
    if integer is not None:
        bits = int(integer[2])
        low, high = (0, 2**bits) if integer[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        if not low <= value < high:
            raise RosError(f"{place} must be a {kind}, from {low} to {high - 1}, not {shown(value)}.")
    return value


def _items(kind: str, length: int | None, value: Any, place: str) -> Any:
    if kind == "uint8" and str(getattr(value, "dtype", "")) == "uint8":
        value = value.tobytes()
    if kind == "uint8" and isinstance(value, bytes | bytearray):
        items: Any = bytes(value)
    else:
        items = value.tolist() if callable(getattr(value, "tolist", None)) else value
        if not isinstance(items, Sequence) or isinstance(items, str | bytes):
            raise RosError(f"{place} must be a list, not {shown(value)}.")
        items = [_value(kind, each, f"{place}[{n}]") for n, each in enumerate(items)]
    if length is not None and len(items) != length:
        raise RosError(f"{place} must have {length} items, not {len(items)}.")
    # An array of the right type is taken as it is; every other sequence would be checked number by number.
    return array("B", items) if kind == "uint8" and length is None else items


def _plain(kind: str, value: Any) -> Any:
    several = _several(kind)
    if several is not None:
        if several[0] == "uint8":
            return bytes(value)
        if "/" in several[0] or several[0] == "octet":
            return [_plain(several[0], each) for each in value]
        return value.tolist() if callable(getattr(value, "tolist", None)) else list(value)
    if "/" in kind:
        return plain(value)
    return value[0] if kind == "octet" else value


def _several(kind: str) -> tuple[str, int | None] | None:
    """Return the item type and the fixed length of a list; None for other types."""
    if (found := _SEQUENCE.match(kind)) is not None:
        return found[1], None
    if (found := _ARRAY.match(kind)) is not None:
        return found[1], int(found[2])
    return None
