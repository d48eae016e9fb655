"""Link to a ROS 2 graph through rclpy of the ROS 2 that is sourced, and its node."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any
from weakref import WeakSet

from strands_robots.ros.link import (
    CancelCheck,
    Goal,
    Message,
    OnMessage,
    RosError,
    Unwatch,
    absolute,
    bare_kind,
    domain,
    filled,
    interface,
    is_latched,
    never,
    next_message,
    node_name,
    plain,
)
from strands_robots.utils import number, whole

logger = logging.getLogger(__name__)

SPIN_S = 0.1
"""Longest time in seconds that the executor waits before it checks whether to end."""

NO_RCLPY = (
    "rclpy cannot be imported here: source a ROS 2 installation, Humble or later, "
    "and use the Python that it was built for."
)

DEPTH = 10
MAX_QOS_HISTORY_DEPTH = 2**31 - 1
"""Deepest KEEP_LAST history: DDS carries the depth as a signed 32-bit number."""

WAIT_S = 0.002


def sourced() -> bool:
    """Return True where the Python client of a ROS 2 is on the path."""
    return find_spec("rclpy") is not None


def ros2(module: str) -> ModuleType:
    """Import a module of the ROS 2 client, or raise :class:`RosError`."""
    try:
        return import_module(module)
    except ImportError as exc:
        raise RosError(f"{NO_RCLPY} ({exc})") from exc


class RclpySession:
    """One node, spun by a thread of its own from construction to :meth:`close`.

    It has its own context: it installs no signal handler, writes no environment variable for its domain, and is
    independent of any other use of rclpy in the process.

    Raises:
        RosError: no ROS 2 is sourced, or its middleware did not start.
    """

    def __init__(self, name: str, domain_id: int) -> None:
        rclpy, contexts, executors = ros2("rclpy"), ros2("rclpy.context"), ros2("rclpy.executors")
        self._rclpy = rclpy
        self._context = contexts.Context()
        try:
            rclpy.init(context=self._context, domain_id=domain_id)
            self.node = rclpy.create_node(
                name,
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self._executor = executors.SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self.node)
        except Exception as exc:
            # Whatever the middleware raises; what has been made so far goes with the context.
            self._shut()
            raise RosError(f"ROS 2 could not be joined in domain {domain_id}: {exc}") from exc
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=f"rclpy-{name}", daemon=True)
        self._thread.start()
        # A thread that is still inside the client library at the interpreter's exit can abort the process.
        atexit.register(self.close)

    def later(self, action: Callable[[], None]) -> None:
        """Run ``action`` on the executor's thread, soon, and log what it raises.

        Requests go out there: a response that arrives before its request is registered would be lost.
        """

        def run() -> None:
            try:
                action()
            except Exception:
                logger.exception("A request to the ROS 2 graph failed.")

        self._executor.create_task(run)

    def close(self, parts: Sequence[Any] = ()) -> None:
        """End the thread and take the node off the graph; not from a callback.

        A second call does nothing; the interpreter's exit calls it for every session that is still open.

        Args:
            parts: parts that the node does not destroy by itself, such as its action clients.
        """
        atexit.unregister(self.close)
        if self._done.is_set():
            return
        self._done.set()
        self._thread.join(20 * SPIN_S)
        for each in parts:
            each.destroy()
        self._executor.shutdown(timeout_sec=SPIN_S)
        self.node.destroy_node()
        self._shut()

    def _shut(self) -> None:
        if self._context.ok():
            self._rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._done.is_set() and self._context.ok():
            try:
                self._executor.spin_once(timeout_sec=SPIN_S)
            except Exception:
                if self._done.is_set() or not self._context.ok():
                    return
                logger.exception("The executor of %s raised; it goes on.", self._thread.name)
                self._done.wait(SPIN_S)


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
        self._endpoints: dict[tuple[str, str, str], Any] = {}
        self._goals: WeakSet[Goal] = WeakSet()

    def open(self) -> RclpySession:
        """Join the graph now, rather than at the first use. Raises :class:`RosError`."""
        with self._lock:
            if self._session is None:
                self._session = RclpySession(self.name, self.domain_id)
                self._opened_at = time.monotonic()
            return self._session

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        message = filled(_new(kind), fields, _new)
        publisher = self._publisher(topic, kind)
        if not self._wait_for(lambda: bool(publisher.get_subscription_count()), self._match_s):
            raise RosError(f"No subscription to {topic} as {bare_kind(kind)} in domain {self.domain_id}.")
        _send(publisher, message, topic, kind)

    def broadcast(self, topic: str, kind: str, fields: Message) -> None:
        """Publish, such as telemetry, whether or not there is a subscription."""
        message = filled(_new(kind), fields, _new)
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
        request = filled(struct.Request(), fields, _new)
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
        message = filled(struct.Goal(), goal, _new)
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
            actions = [client for (section, _, _), client in self._endpoints.items() if section == "action"]
            self._endpoints.clear()
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
            if key not in self._endpoints:
                try:
                    self._endpoints[key] = make()
                except Exception as exc:
                    raise RosError(f"{name} cannot be used as {bare_kind(kind)}: {exc}") from exc
            return self._endpoints[key]

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
    package, _, name = bare_kind(interface("type", kind)).partition("/")
    module = f"{package}.{section}"
    try:
        found = getattr(import_module(module), name, None)
    except ModuleNotFoundError as exc:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: no module {exc.name}.") from exc
    if found is None:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: {module} has no {name}.")
    return found


def _new(kind: str) -> Any:
    return interface_class(kind, "msg")()
