"""Link to a ROS 1 or ROS 2 graph behind a rosbridge server."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from strands_robots.ros.link import (
    CancelCheck,
    EarlierRefusedError,
    Goal,
    Message,
    OnMessage,
    RosError,
    Unwatch,
    bare_kind,
    deliver,
    never,
)
from strands_robots.ros.rosbridge_session import (
    Fragments,
    RosbridgeAccess,
    RosbridgeSession,
    UrgentConnection,
    decoded,
    encoded,
    with_bytes,
)
from strands_robots.utils import number, shown

logger = logging.getLogger(__name__)

ROSAPI_S = 5.0
"""Seconds within which the server's own services answer."""

LOOKS = 3
"""Answers without our publisher that make a refusal; a graph may need a second or two to show a new one."""


_INQUIRIES = {"/rosapi/topic_type": "rosapi/TopicType", "/rosapi/publishers": "rosapi/Publishers"}
"""Services that show whether a server publishes for us, with their types."""


@dataclass(slots=True)
class _Request:
    """A request that waits for its answer."""

    done: threading.Event = field(default_factory=threading.Event)
    answer: dict[str, Any] | None = None
    problem: str = ""

    def end(self, answer: Message) -> None:
        if self.answer is None:
            self.answer = dict(answer)
            self.done.set()

    def fail(self, problem: str) -> None:
        self.problem = problem
        self.done.set()


@dataclass(slots=True)
class _Subscription:
    """One subscription on the wire for all watchers of the topic."""

    id: str
    kind: str | None
    watchers: list[OnMessage]
    failed: list[Callable[[str], None]]
    silent: bool = True


@dataclass(slots=True)
class _Inquiry:
    """Question whether the graph has our publisher of a topic."""

    kind: str
    looks: int = 0
    missed: int = 0
    typed: bool = False
    listed: bool = False


class RosbridgeLink:
    """A :class:`~strands_robots.ros.link.RosLink` over a connection that is kept.

    Urgent messages have a second connection of their own.

    A lost connection is reopened, its subscriptions restored and its topics advertised anew; what is sent meanwhile
    is refused, not queued: a velocity that arrives late is worse than one that does not. A ``status`` error of the
    server fails the request that it names, or the next publish on the topic that it names, and is logged. A server
    that sends none, as rosbridge_suite for ROS 2, is asked by rosapi for the type and the publishers of each topic
    that we advertise, and for a topic without a type again until it appears.

    Args:
        host: bare hostname or IP literal of the server.
        port: its TCP port, 1 to 65535.
        connect_s: how long one attempt to connect may take, above 0 and at most 60 s.
        access: TLS, headers and a rosauth secret for a server that is not open to everyone.

    Raises:
        ValidationError: an argument outside its domain.
    """

    def __init__(
        self,
        host: str = "localhost",
        port: int = 9090,
        *,
        connect_s: float = 5.0,
        access: RosbridgeAccess | None = None,
    ) -> None:
        seconds = number("connect_s", connect_s, above=0, high=60)
        self._session = RosbridgeSession(
            host,
            port,
            connect_s=seconds,
            opened=self._restore,
            received=self._received,
            lost=self._lost,
            tick=self._ask_again,
            access=access,
        )
        self._urgent = UrgentConnection(host, port, seconds, access)
        self._numbers = count(1)
        self._lock = threading.RLock()
        self._advertised: dict[str, str] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._requests: dict[str, _Request] = {}
        self._goals: dict[str, tuple[Goal, OnMessage | None]] = {}
        self._refusals: dict[str, str] = {}
        self._inquiries: dict[str, _Inquiry] = {}
        self._fragments = Fragments()

    @property
    def url(self) -> str:
        """Address of the server."""
        return self._session.url

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        refusal = self._refusals.pop(topic, None)
        if refusal is not None:
            self._advertised.pop(topic, None)
            raise EarlierRefusedError(refusal)
        frame = encoded("publish", id=self._id("publish", topic), topic=topic, type=kind, msg=fields)
        if self._advertised.get(topic) != kind or not self._session.up:
            self._session.send(encoded("advertise", id=self._id("advertise", topic), topic=topic, type=kind))
            self._advertised[topic] = kind
            self._inquiries[topic] = _Inquiry(kind)
        self._session.send(frame)

    def prepare_urgent(self, topic: str, kind: str) -> None:
        self._urgent.prepare(topic, kind)

    def publish_urgent(self, topic: str, kind: str, fields: Message) -> None:
        self._urgent.publish(topic, kind, fields)

    def cut(self) -> None:
        self._session.cut()

    def confirm(self, within_s: float) -> None:
        self._session.confirm(within_s)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        request = _Request()
        unwatch = self._watch(topic, kind, request.end, request.fail)
        try:
            return self._awaited(request, f"Nothing arrived on {topic}", within_s)
        finally:
            unwatch()

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        key = self._id("call_service", service)
        # The type is not in the protocol's example, but servers over ROS 2 cannot do without it.
        frame = encoded("call_service", id=key, service=service, type=kind, args=fields, timeout=within_s)
        answer = self._request(key, frame, f"{service} did not answer", within_s)
        values = answer.get("values")
        if answer.get("result") is False:
            raise RosError(f"{service} failed: {shown(values)}")
        return values if isinstance(values, dict) else {}

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
        """Send an action goal and return at once: acceptance is not reported.

        A server that does not take a goal answers ``result: false``; the goal is then rejected and nothing began.
        """
        if cancelled():
            raise RosError(f"{action} was given up before its goal was sent.")
        del within_s
        key = self._id("send_action_goal", action)
        frame = encoded("send_action_goal", id=key, action=action, action_type=kind, args=goal, feedback=True)
        sent = Goal(lambda: self._session.send(encoded("cancel_action_goal", id=key, action=action)))
        self._goals[key] = (sent, feedback)
        try:
            self._session.send(frame)
        except BaseException:
            # A connection that was lost, or not there, has ended its goals already.
            self._goals.pop(key, None)
            raise
        return sent

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        return self._watch(topic, kind, on_message, lambda problem: logger.warning("%s: %s", topic, problem))

    def topics(self) -> list[dict[str, Any]]:
        """Return ``topic`` and ``type`` of each topic, by rosapi."""
        answer = self.call("/rosapi/topics", "rosapi/Topics", {}, ROSAPI_S)
        names, kinds = answer.get("topics"), answer.get("types")
        if not isinstance(names, list) or not isinstance(kinds, list) or len(names) != len(kinds):
            raise RosError(f"/rosapi/topics answered {shown(answer)}.")
        return [{"topic": str(name), "type": str(kind)} for name, kind in sorted(zip(names, kinds, strict=True))]

    def nodes(self) -> list[str]:
        """Return the names of the nodes, by rosapi."""
        return self._names("/rosapi/nodes", "rosapi/Nodes", "nodes")

    def services(self) -> list[str]:
        """Return the names of the services, by rosapi."""
        return self._names("/rosapi/services", "rosapi/Services", "services")

    def actions(self) -> list[str]:
        """Return the names of the actions that have a server, by rosapi."""
        return self._names("/rosapi/action_servers", "rosapi/GetActionServers", "action_servers")

    def _names(self, service: str, kind: str, key: str) -> list[str]:
        names = self.call(service, kind, {}, ROSAPI_S).get(key)
        if not isinstance(names, list):
            raise RosError(f"{service} answered without {key}.")
        return sorted(str(name) for name in names)

    def close(self) -> None:
        self._urgent.close()
        self._session.close()
        with self._lock:
            self._subscriptions.clear()
            self._advertised.clear()

    def _watch(self, topic: str, kind: str | None, on_message: OnMessage, failed: Callable[[str], None]) -> Unwatch:
        self._session.open()
        with self._lock:
            subscription = self._subscriptions.get(topic)
            if subscription is None:
                subscription = self._subscriptions[topic] = _Subscription(self._id("subscribe", topic), kind, [], [])
                frame = self._subscription(topic, subscription)
            else:
                frame = ""
            subscription.watchers.append(on_message)
            subscription.failed.append(failed)

        def unwatch() -> None:
            with self._lock:
                if on_message not in subscription.watchers:
                    return
                subscription.watchers.remove(on_message)
                subscription.failed.remove(failed)
                last = not subscription.watchers and self._subscriptions.get(topic) is subscription
                if last:
                    del self._subscriptions[topic]
            if last and self._session.up:
                with contextlib.suppress(RosError):  # a connection that just broke has no subscriptions left
                    self._session.send(encoded("unsubscribe", id=subscription.id, topic=topic))

        if frame:
            try:
                self._session.send(frame)
            except Exception:
                with self._lock:
                    self._subscriptions.pop(topic, None)
                raise
        return unwatch

    def _subscription(self, topic: str, subscription: _Subscription) -> str:
        kind = {} if subscription.kind is None else {"type": subscription.kind}
        # A queue of one: only the latest state of a robot is of use.
        return encoded("subscribe", id=subscription.id, topic=topic, queue_length=1, compression="none", **kind)

    def _request(self, key: str, frame: str, what: str, within_s: float) -> dict[str, Any]:
        request = self._requests[key] = _Request()
        try:
            self._session.send(frame)
            return self._awaited(request, what, within_s)
        finally:
            del self._requests[key]

    def _awaited(self, request: _Request, what: str, within_s: float) -> dict[str, Any]:
        if not request.done.wait(within_s):
            raise RosError(f"{what} within {within_s:g} s.")
        if request.answer is None:
            raise RosError(request.problem)
        return request.answer

    def _id(self, op: str, name: str) -> str:
        return f"{op}:{name}:{next(self._numbers)}"

    # On the session's thread.

    def _restore(self, send: Callable[[str], None]) -> None:
        with self._lock:
            self._fragments = Fragments()
            # A subscriber discovers a new publisher some milliseconds late, so advertise ahead of the first message.
            for topic, kind in list(self._advertised.items()):
                send(encoded("advertise", id=self._id("advertise", topic), topic=topic, type=kind))
                self._inquiries[topic] = _Inquiry(kind)
            for topic, subscription in self._subscriptions.items():
                send(self._subscription(topic, subscription))

    def _ask_again(self) -> None:
        """Ask for our publishers, and subscribe again to what was not there yet."""
        for topic, inquiry in list(self._inquiries.items()):
            # Asked often enough, it stays for the answers that are still to come.
            if inquiry.looks > LOOKS:
                continue
            sent = True
            for service, kind in _INQUIRIES.items():
                key = f"{service}:{topic}:{next(self._numbers)}"
                frame = encoded("call_service", id=key, service=service, type=kind, args={"topic": topic})
                sent = self._session.send_if_free(frame) and sent
            inquiry.looks += sent
        with self._lock:
            waiting = [(t, s) for t, s in self._subscriptions.items() if s.silent and s.kind is None]
        for topic, subscription in waiting:
            # Without a type rosbridge_suite drops a subscription to a topic that nothing publishes yet.
            self._session.send_if_free(self._subscription(topic, subscription))

    def _inquired(self, key: str, message: Message) -> bool:
        """Take the answer of rosapi to a question of ours; return whether it was one."""
        service, _, rest = key.partition(":")
        topic, values = rest.rpartition(":")[0], message.get("values")
        inquiry = self._inquiries.get(topic)
        if service not in _INQUIRIES:
            return False
        if inquiry is None:
            return True
        known = values if isinstance(values, dict) and message.get("result") is not False else {}
        other = known.get("type")
        inquiry.typed |= bool(other)
        inquiry.listed |= bool(known.get("publishers"))
        inquiry.missed += known.get("publishers") == []
        if isinstance(other, str) and other and bare_kind(other) != bare_kind(inquiry.kind):
            self._refuse(topic, f"rosbridge does not publish {inquiry.kind} on {topic}, which carries {other}")
        elif inquiry.missed >= LOOKS:
            self._refuse(topic, f"rosbridge has no publisher on {topic}: it refused ours")
        elif not known or (inquiry.typed and inquiry.listed):
            # Without rosapi the refusal of a command cannot be found.
            self._inquiries.pop(topic, None)
        return True

    def _refuse(self, topic: str, why: str) -> None:
        logger.warning("%s", why)
        self._inquiries.pop(topic, None)
        self._refusals[topic] = why

    def _lost(self, why: str) -> None:
        for request in list(self._requests.values()):
            request.fail(f"The connection to rosbridge at {self.url} was lost: {why}.")
        while self._goals:
            _, (goal, _) = self._goals.popitem()
            goal.fail(f"the connection to rosbridge at {self.url} was lost: {why}")

    def _received(self, frame: str | bytes) -> None:
        try:
            message: dict[str, Any] | None = decoded(frame)
            if message is not None and message["op"] == "fragment":
                message = self._fragments.add(message)
            if message is not None:
                self._dispatch(message)
        except RosError as exc:
            logger.warning("%s sent what cannot be used: %s", self.url, exc)

    def _dispatch(self, message: dict[str, Any]) -> None:
        op, key = message["op"], message.get("id")
        if op == "publish":
            self._published(message)
        elif op in ("action_feedback", "action_result"):
            self._goal_event(op, key, message)
        elif op == "service_response":
            request = self._requests.get(key) if isinstance(key, str) else None
            if isinstance(key, str) and self._inquired(key, message):
                return
            if request is not None:
                request.end(message)
        elif op == "status":
            self._status(message)

    def _goal_event(self, op: str, key: object, message: dict[str, Any]) -> None:
        goal, feedback = self._goals.get(key, (None, None)) if isinstance(key, str) else (None, None)
        if goal is None:
            return
        values, status = message.get("values"), message.get("status")
        if op == "action_feedback":
            if feedback is not None and isinstance(values, dict):
                feedback(values)
            return
        self._goals.pop(str(key), None)
        if message.get("result") is False:
            # Only what happens before the server has taken a goal, or after it has ended, is answered so.
            goal.reject(f"{message.get('action')} did not take the goal: {shown(values)}")
        elif isinstance(status, int):
            goal.end(status, values)
        else:
            goal.fail(f"the server reported no status: {shown(values)}")

    def _published(self, message: dict[str, Any]) -> None:
        topic, body = message.get("topic"), message.get("msg")
        with self._lock:
            subscription = self._subscriptions.get(topic) if isinstance(topic, str) else None
            watchers = list(subscription.watchers) if subscription is not None else []
        if subscription is None or not isinstance(body, dict):
            return
        subscription.silent = False
        whole = with_bytes(subscription.kind, body)
        for each in watchers:
            deliver(each, whole, str(topic))

    def _status(self, message: dict[str, Any]) -> None:
        said = f"rosbridge says: {shown(message.get('msg'))}"
        if self._inquired(str(message.get("id") or ""), message):
            return
        if message.get("level") != "error":
            logger.info("%s", said)
            return
        logger.warning("%s (%s)", said, message.get("id"))
        key = str(message.get("id") or "")
        request = self._requests.get(key)
        if request is not None:
            request.fail(said)
            return
        if key in self._goals:
            self._goals.pop(key)[0].fail(said)
            return
        op, _, rest = key.partition(":")
        topic = rest.rpartition(":")[0]
        if op in ("publish", "advertise"):
            self._refusals[topic] = said
        elif op == "subscribe":
            with self._lock:
                subscription = self._subscriptions.get(topic)
                failed = list(subscription.failed) if subscription is not None else []
            for each in failed:
                each(said)
