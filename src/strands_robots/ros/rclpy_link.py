"""A ROS 2 graph through rclpy, the Python client of the ROS 2 that is sourced."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any
from weakref import WeakSet

from strands_robots import settings
from strands_robots.ros.dds import DOMAIN_MAX
from strands_robots.ros.link import GivenUp, Goal, Heard, Message, RosError, Unwatch, never, next_message
from strands_robots.ros.names import bare_kind, node_name
from strands_robots.ros.rclpy_fields import filled, interface_class, plain
from strands_robots.ros.rclpy_session import Session, ros2
from strands_robots.utils import number, whole

logger = logging.getLogger(__name__)

DEPTH = 10
MAX_QOS_HISTORY_DEPTH = 2**31 - 1
"""Deepest KEEP_LAST history: DDS carries the depth as a signed 32-bit number."""

WAIT_S = 0.002


class RclpyLink:
    """A :class:`~strands_robots.ros.link.RosLink` of topics, services and actions. Opened by the first use.

    What is published has to reach somebody: while no subscription matches, a publish waits ``match_s`` and fails.

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
        stated = settings.integer("ROS_DOMAIN_ID") if domain_id is None else domain_id
        self.domain_id = whole("domain_id", stated, low=0, high=DOMAIN_MAX)
        self.name = node_name("name", name)
        self._depth = whole("depth", depth, low=1, high=MAX_QOS_HISTORY_DEPTH)
        self._match_s = number("match_s", match_s, low=0, high=60)
        self._lock = threading.RLock()
        self._session: Session | None = None
        self._opened_at = 0.0
        self._made: dict[tuple[str, str, str], Any] = {}
        self._goals: WeakSet[Goal] = WeakSet()

    def open(self) -> None:
        """Join the graph now. Raises :class:`RosError`."""
        self._open()

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        message = filled(interface_class(kind, "msg")(), fields)
        publisher = self._publisher(topic, kind)
        if not self._comes(lambda: bool(publisher.get_subscription_count()), self._match_s):
            raise RosError(f"Nobody subscribes to {topic} as {bare_kind(kind)} in domain {self.domain_id}.")
        _send(publisher, message, topic, kind)

    def tell(self, topic: str, kind: str, fields: Message) -> None:
        """Publish what is for whoever cares, such as telemetry: it is no error that nobody subscribes."""
        message = filled(interface_class(kind, "msg")(), fields)
        _send(self._publisher(topic, kind), message, topic, kind)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return next_message(self.watch, topic, kind, within_s)

    def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
        session = self._open()
        qos = ros2("rclpy.qos")
        # Best effort takes what a sensor sends so as well as what is sent reliably.
        profile = qos.QoSProfile(
            history=qos.HistoryPolicy.KEEP_LAST, depth=self._depth, reliability=qos.ReliabilityPolicy.BEST_EFFORT
        )
        struct = interface_class(kind or self._kind_of(topic), "msg")
        subscription = session.node.create_subscription(struct, _absolute(topic), _telling(heard, topic), profile)
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
        session = self._open()
        client = self._cached("srv", service, kind, lambda: session.node.create_client(struct, _absolute(service)))
        if not self._comes(client.service_is_ready, within_s):
            raise RosError(f"Nobody offers the service {service}.")
        answer, futures = Goal(lambda: None), list[Any]()

        def ask() -> None:
            futures.append(client.call_async(request))
            futures[0].add_done_callback(lambda future: _settle(future, answer, plain))

        session.later(ask)
        if not answer.done.wait(max(0.0, deadline - time.monotonic())):
            session.later(lambda: client.remove_pending_request(futures[0]))
            raise RosError(f"{service} did not answer within {within_s:g} s.")
        if answer.problem:
            raise RosError(f"{service} failed: {answer.problem}")
        return dict(answer.values)

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
        deadline = time.monotonic() + within_s
        struct = interface_class(kind, "action")
        message = filled(struct.Goal(), goal)
        session = self._open()
        make = ros2("rclpy.action").ActionClient
        client = self._cached("action", action, kind, lambda: make(session.node, struct, _absolute(action)))
        if not self._comes(client.server_is_ready, within_s, given_up):
            raise RosError(f"Nobody serves the action {action}.")
        sending = _Sending(session, action)
        self._goals.add(sending.goal)
        tell = None if feedback is None else _telling(feedback, f"{action} feedback", lambda told: told.feedback)
        session.later(lambda: sending.send(client, message, tell))
        try:
            self._comes(sending.answered.is_set, deadline - time.monotonic(), given_up)
        except BaseException:
            # A Ctrl-C here must not leave the robot on its way.
            sending.goal.cancel()
            raise
        if sending.goal.rejected:
            raise RosError(sending.goal.problem)
        return sending.goal

    def topics(self) -> list[dict[str, Any]]:
        """``topic``, ``type``, and how many ``publishers`` and ``subscriptions`` it has, by topic and type."""
        node = self._looked()
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
        """Names of the nodes, with their namespaces."""
        found = self._looked().get_node_names_and_namespaces()
        return sorted(f"{space.rstrip('/')}/{name}" for name, space in found)

    def services(self) -> list[str]:
        """Names of the services."""
        return sorted(name for name, _ in self._looked().get_service_names_and_types())

    def actions(self) -> list[str]:
        """Names of the actions."""
        return sorted(name for name, _ in ros2("rclpy.action").get_action_names_and_types(self._looked()))

    def close(self) -> None:
        with self._lock:
            session, self._session = self._session, None
            actions = [made for (section, _, _), made in self._made.items() if section == "action"]
            self._made.clear()
        for goal in list(self._goals):
            goal.fail("the link was closed")
        if session is not None:
            session.close(actions)

    def _open(self) -> Session:
        with self._lock:
            if self._session is None:
                self._session = Session(self.name, self.domain_id)
                self._opened_at = time.monotonic()
            return self._session

    def _publisher(self, topic: str, kind: str) -> Any:
        session = self._open()
        struct, qos = interface_class(kind, "msg"), ros2("rclpy.qos")
        profile = qos.QoSProfile(
            history=qos.HistoryPolicy.KEEP_LAST, depth=self._depth, reliability=qos.ReliabilityPolicy.RELIABLE
        )
        make = session.node.create_publisher
        return self._cached("msg", topic, kind, lambda: make(struct, _absolute(topic), profile))

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
        node, found = self._open().node, list[str]()

        def known() -> bool:
            rows = dict(node.get_topic_names_and_types())
            found.extend(rows.get(_absolute(topic), ()))
            return bool(found)

        if not self._comes(known, self._match_s):
            raise RosError(f"Nobody publishes {topic} in domain {self.domain_id}, so its type is not known.")
        return found[0]

    def _looked(self) -> Any:
        """Our node, which has had ``match_s`` since it joined to be told of the graph."""
        node = self._open().node
        left = self._opened_at + self._match_s - time.monotonic()
        self._comes(lambda: len(node.get_node_names_and_namespaces()) > 1, left)
        return node

    def _comes(self, true: Callable[[], bool], within_s: float, given_up: GivenUp = never) -> bool:
        deadline = time.monotonic() + within_s
        while not true():
            if time.monotonic() >= deadline or given_up():
                return False
            time.sleep(WAIT_S)
        return not given_up()


class _Sending:
    """A goal on its way. The send, the acceptance, a cancel and the end all happen on the executor's thread."""

    def __init__(self, session: Session, action: str) -> None:
        self._session = session
        self._action = action
        self._handle: Any = None
        self._cancelled = False
        self.answered = threading.Event()
        self.goal = Goal(lambda: session.later(self._cancel))

    def send(self, client: Any, message: Any, tell: Callable[[Any], None] | None) -> None:
        if self._cancelled:
            self.goal.reject(f"{self._action} was given up before its goal was sent.")
            return
        client.send_goal_async(message, feedback_callback=tell).add_done_callback(self._accepted)

    def _accepted(self, future: Any) -> None:
        failed = future.exception()
        handle = None if failed is not None else future.result()
        if handle is None:
            self.goal.fail(f"{self._action} did not take the goal: {failed}")
        elif not handle.accepted:
            self.goal.reject(f"{self._action} refused the goal.")
        else:
            self._handle = handle
            self._ask_for_end()
            if self._cancelled:
                self._cancel()
        self.answered.set()

    def _ask_for_end(self) -> None:
        self._handle.get_result_async().add_done_callback(self._ended)

    def _cancel(self) -> None:
        # One that is not taken yet is cancelled when it is.
        self._cancelled = True
        if self._handle is not None:
            self._handle.cancel_goal_async().add_done_callback(self._cancel_answered)

    def _cancel_answered(self, future: Any) -> None:
        # A goal that is not being cancelled may be over, its end told before anybody could hear it: it is kept.
        if future.exception() is None and not future.result().goals_canceling and not self.goal.done.is_set():
            self._ask_for_end()

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


def _telling(heard: Heard, what: str, part: Callable[[Any], Any] = lambda message: message) -> Callable[[Any], None]:
    def told(message: Any) -> None:
        try:
            heard(plain(part(message)))
        except Exception:
            logger.exception("A watcher of %s failed.", what)

    return told


def _send(publisher: Any, message: Any, topic: str, kind: str) -> None:
    try:
        publisher.publish(message)
    except Exception as exc:
        raise RosError(f"{topic} did not take a {bare_kind(kind)}: {exc}") from exc


def _absolute(name: str) -> str:
    return name if name.startswith(("/", "~")) else f"/{name}"
