"""Two transports as one: a local leg for everything, a cloud leg for some."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots import settings
from strands_robots.mesh import topics, wire
from strands_robots.mesh.transport import (
    Callback,
    Declaration,
    LivenessCallback,
    NoToken,
    Sample,
    Transport,
    TransportError,
)
from strands_robots.mesh.transport.factory import make_transport
from strands_robots.rate_limits import RecentKeys

logger = logging.getLogger(__name__)

SEEN_S = 120.0
SEEN_MAX = 10_000
LOCAL_S = 3.0
LOCAL_MAX = 1024
RETRY_S = 1.0
RETRY_MAX_S = 8.0
CLOSE_S = 1.0
SAFETY = frozenset({"estop", "resume"})
UNSENT_MAX = 64

LOCAL_FIRST = frozenset({"presence", "response", "health", "safety_event"})
"""Topics on which a message from the cloud leg is dropped while its publisher is on the local leg."""


class SeenCommands:
    """Commands that came by one leg already; bounded by age and number."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._recent = RecentKeys(SEEN_S, SEEN_MAX, clock)

    def first(self, payload: bytes) -> bool:
        """False when a message with this sender, turn and command came before."""
        mark = _mark(payload)
        return mark is None or self._recent.first(mark)


class LocalPeers:
    """Peers that sent a heartbeat on the local leg lately.

    Their heartbeat from the broker is dropped: it names no session, and its signature would count only once.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._at: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, peer: str) -> None:
        with self._lock:
            self._at.pop(peer, None)
            self._at[peer] = self._clock()
            while len(self._at) > LOCAL_MAX:
                del self._at[next(iter(self._at))]

    def __contains__(self, peer: str) -> bool:
        at = self._at.get(peer)
        return at is not None and self._clock() - at <= LOCAL_S


class _BridgedSubscriber:
    """One subscriber on several legs; ``pending`` are those it lacks yet."""

    def __init__(self, key: str, callbacks: list[tuple[Transport, Callback]]) -> None:
        self.key = key
        self.pending = callbacks
        self._declared: list[Declaration] = []
        self.gone = False
        self._lock = threading.Lock()

    def declare(self) -> list[str]:
        """Declare on every pending leg that is up; return the refusals."""
        problems: list[str] = []
        with self._lock:
            for entry in [] if self.gone else list(self.pending):
                leg, callback = entry
                if not leg.is_alive():
                    continue
                try:
                    self._declared.append(leg.declare_subscriber(self.key, callback))
                except TransportError as exc:
                    problems.append(str(exc))
                else:
                    self.pending.remove(entry)
        return problems

    def undeclare(self) -> None:
        with self._lock:
            declared, self._declared = self._declared, []
            self.pending, self.gone = [], True
        for each in declared:
            each.undeclare()


class BridgeTransport(Transport):
    """Zenoh and MQTT as one transport; connected while either leg is.

    A leg that is down when the bridge connects is retried in the background, and is then given the subscribers that
    were declared meanwhile. The e-stops and resumes that a cloud leg missed are published there as soon as it is up.

    Args:
        local: the leg that carries everything; Zenoh by default.
        cloud: the leg that carries the bridged topics; MQTT by default.
    """

    pins_topics = True
    stops_apart = True

    def __init__(self, local: Transport | None = None, cloud: Transport | None = None) -> None:
        self._local = local or make_transport("zenoh")
        self._cloud = cloud or make_transport("iot")
        self._seen = SeenCommands()
        self._local_peers = LocalPeers()
        self._bridged = _bridged_names()
        self._lock = threading.Lock()
        self._joined: set[Transport] = set()
        self._subscribers: list[_BridgedSubscriber] = []
        self._unsent: dict[tuple[str, str], bytes] = {}
        self._closed = threading.Event()
        self._closed.set()
        self._repairing: threading.Thread | None = None

    @property
    def session_id(self) -> str | None:
        return self._local.session_id

    @property
    def posture(self) -> Any:
        """The certificates of the local leg."""
        return getattr(self._local, "posture", None)

    @property
    def dials_only(self) -> bool:
        """True where the local leg never becomes the hub."""
        return self._local.dials_only

    @dials_only.setter
    def dials_only(self, value: bool) -> None:
        self._local.dials_only = value

    def take_part(self) -> None:
        self._local.take_part()

    def connect(self) -> None:
        problems = self._join()
        if not self._joined:
            raise TransportError(f"neither leg of the bridge connects: {'; '.join(problems)}")
        self._closed = threading.Event()
        for problem in problems:
            logger.error("One leg of the bridge is down and is retried: %s", problem)
        self._repair()

    def close(self) -> None:
        self._closed.set()
        self._local.close()
        self._cloud.close()
        with self._lock:
            repairing, self._repairing = self._repairing, None
            self._joined.clear()
            self._subscribers.clear()
            self._unsent.clear()
        if repairing is not None:
            repairing.join(CLOSE_S)

    def is_alive(self) -> bool:
        return self._local.is_alive() or self._cloud.is_alive()

    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        topic = topics.topic_of(key)
        data = payload if isinstance(payload, bytes) else wire.encode(payload, topic.max_bytes)
        legs = self._legs(topic)
        problems = [problem for leg in legs if (problem := self._put(leg, key, topic, data)) is not None]
        if len(problems) == len(legs):
            raise TransportError(f"{key}: {'; '.join(problems)}")

    def _put(self, leg: Transport, key: str, topic: topics.Topic, data: bytes) -> str | None:
        """Publish on one leg; return the reason why that failed, or None."""
        cloud = leg is self._cloud
        sent = _without_session(topic, data) if cloud else data
        problem = _try(leg.put, key, sent) if leg.is_alive() else "this leg of the bridge is not connected"
        if problem is not None and cloud and topic.name in SAFETY:
            self._store_unsent(key, topic, sent)
        return problem

    def declare_subscriber(self, key: str, callback: Callback) -> _BridgedSubscriber:
        topic = topics.topic_of(key)
        once = topic.name in ("cmd", "broadcast")

        def deliver(sample: Sample) -> None:
            if not once or sample.retained or self._seen.first(sample.payload):
                callback(sample)

        def from_local(sample: Sample) -> None:
            if topic.name == "presence":
                self._local_peers.note(_publisher(sample.key))
            deliver(sample)

        def from_cloud(sample: Sample) -> None:
            if topic.name not in LOCAL_FIRST or _publisher(sample.key) not in self._local_peers:
                deliver(sample)

        if not self.is_alive():
            raise TransportError(f"{key}: no leg of the bridge is connected.")
        legs = self._legs(topic)
        subscriber = _BridgedSubscriber(key, [(leg, from_local if leg is self._local else from_cloud) for leg in legs])
        problems = subscriber.declare()
        if len(problems) == len(legs):
            raise TransportError("; ".join(problems))
        with self._lock:
            self._subscribers = [each for each in self._subscribers if not each.gone] + [subscriber]
        self._repair()
        return subscriber

    @property
    def stops_up(self) -> bool:
        return self._local.stops_up

    def open_stops(
        self, on_stop: Callable[[str, bytes], None], on_check_in: Callback | None = None
    ) -> Callable[[], None]:
        return self._local.open_stops(on_stop, on_check_in)

    def put_stop(self, key: str, payload: Mapping[str, Any]) -> bool:
        return self._local.put_stop(key, payload)

    def refusals(self) -> Mapping[str, str]:
        return {**self._local.refusals(), **self._cloud.refusals()}

    def subscribe_again(self) -> int:
        return self._local.subscribe_again() + self._cloud.subscribe_again()

    def clear_retained(self, key: str) -> bool:
        return self._cloud.is_alive() and self._cloud.clear_retained(key)

    def declare_token(self, key: str) -> Declaration:
        return self._local.declare_token(key) if self._local.is_alive() else NoToken()

    def watch_tokens(self, key: str, callback: LivenessCallback) -> Declaration:
        return self._local.watch_tokens(key, callback) if self._local.is_alive() else NoToken()

    def anchored(self) -> bool:
        return self._local.anchored()

    def cut_off(self) -> bool:
        return self._local.cut_off() and not self._cloud.is_alive()

    def rejoined(self) -> int:
        # Each side has peers that the other one does not reach.
        return self._local.rejoined() + self._cloud.rejoined()

    def links_back(self) -> int:
        return self._local.links_back() + self._cloud.links_back()

    def lost_link_at(self) -> float | None:
        # A local leg that comes up late is judged like one whose link can be lost.
        at = self._local.lost_link_at()
        return at if at is not None else -math.inf

    def _join(self) -> list[str]:
        """Connect the legs that never were; return the reason of each that failed."""
        problems: list[str] = []
        for leg in (self._local, self._cloud):
            if leg in self._joined:
                continue
            problem = _try(leg.connect)
            if problem is None:
                self._joined.add(leg)
            else:
                problems.append(problem)
        return problems

    def _repair(self) -> None:
        """Start a thread that works until both legs have everything."""
        with self._lock:
            if self._repairing is None and not self._closed.is_set() and not self._complete():
                self._repairing = threading.Thread(target=self._run, name="mesh-bridge-repair", daemon=True)
                self._repairing.start()

    def _run(self) -> None:
        pause, closed = RETRY_S, self._closed
        while not closed.wait(pause):
            pause = min(2 * pause, RETRY_MAX_S)
            self._join()
            if closed.is_set():
                # A leg came up while the bridge was closed.
                self._local.close()
                self._cloud.close()
                return
            for each in list(self._subscribers):
                each.declare()
            self._publish_unsent()
            with self._lock:
                if self._complete():
                    self._repairing = None
                    logger.info("Both legs of the bridge are up.")
                    return

    def _complete(self) -> bool:
        return len(self._joined) == 2 and not self._unsent and all(not each.pending for each in self._subscribers)

    def _store_unsent(self, key: str, topic: topics.Topic, data: bytes) -> None:
        """Store a stop or a resume for the cloud leg, once for each id, until it is back."""
        name = (key, _safety_id(data, topic))
        with self._lock:
            self._unsent.pop(name, None)
            self._unsent[name] = data
            while len(self._unsent) > UNSENT_MAX:
                del self._unsent[next(iter(self._unsent))]
        self._repair()

    def _publish_unsent(self) -> None:
        for name, data in list(self._unsent.items()):
            if not self._cloud.is_alive() or _try(self._cloud.put, name[0], data) is not None:
                return
            with self._lock:
                if self._unsent.get(name) is data:
                    del self._unsent[name]

    def _legs(self, topic: topics.Topic) -> list[Transport]:
        return [self._local, self._cloud] if topic.name in self._bridged else [self._local]


def _bridged_names() -> frozenset[str]:
    stated = settings.items("STRANDS_MESH_BRIDGE_TOPICS")
    unknown = [name for name in stated if name not in topics.BY_NAME]
    if unknown:
        raise TransportError(
            f"STRANDS_MESH_BRIDGE_TOPICS must name topics of {', '.join(topics.BY_NAME)}, not {', '.join(unknown)}."
        )
    return frozenset(stated) or frozenset(topic.name for topic in topics.TABLE if topic.bridged)


def _publisher(key: str) -> str:
    """Return the publisher of a key; of a reply's key that is the responder."""
    parts = key.split("/")
    if len(parts) > 3 and parts[2] == "response":
        return parts[3]
    return parts[1] if len(parts) > 1 else ""


def _without_session(topic: topics.Topic, data: bytes) -> bytes:
    """Remove the session from a stop or resume, which the cloud leg lacks."""
    if topic.name not in SAFETY:
        return data
    try:
        body = wire.decode(data, topic.max_bytes)
    except wire.WireError:
        return data
    body.pop("source_zid", None)
    return wire.encode(body, topic.max_bytes)


def _safety_id(data: bytes, topic: topics.Topic) -> str:
    """Return a stop's id or a resume's nonce, which identifies the message."""
    try:
        body = wire.decode(data, topic.max_bytes)
    except wire.WireError:
        return ""
    assertion = body.get("assertion")
    return str(body.get("estop_id") or (assertion.get("nonce") if isinstance(assertion, dict) else ""))


def _mark(payload: bytes) -> bytes | None:
    try:
        body = wire.decode(payload, topics.BY_NAME["cmd"].max_bytes)
        key = json.dumps([body["sender_id"], body["turn_id"], body.get("command")], sort_keys=True)
    except (wire.WireError, KeyError, ValueError, TypeError, RecursionError):
        return None
    return hashlib.sha256(key.encode("utf-8", "surrogatepass")).digest()


def _try(verb: Callable[..., Any], *args: Any) -> str | None:
    try:
        verb(*args)
    except (TransportError, ImportError) as exc:
        return str(exc)
    return None
