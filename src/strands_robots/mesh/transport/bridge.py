"""Both legs at once: everything on Zenoh, and what the fleet's cloud side needs on MQTT."""

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
from strands_robots.mesh.transport import Callback, Handle, LivenessCallback, Sample, Transport, TransportError

logger = logging.getLogger(__name__)

SEEN_S = 120.0
SEEN_MAX = 10_000
NEAR_S = 3.0
NEAR_MAX = 1024
RETRY_S = 1.0
RETRY_MAX_S = 8.0
CLOSE_S = 1.0
OWED = frozenset({"estop", "resume"})
OWED_MAX = 64

ALSO_NEAR = frozenset({"presence", "response", "health", "safety_event"})


class Seen:
    """Commands that came by one leg and need not be served again by the other; bounded by age and number."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._at: dict[bytes, float] = {}
        self._lock = threading.Lock()

    def first(self, payload: bytes) -> bool:
        """False when a message with this sender, turn and command was there already."""
        mark = _mark(payload)
        if mark is None:
            return True
        now = self._clock()
        with self._lock:
            while self._at and now - next(iter(self._at.values())) > SEEN_S:
                del self._at[next(iter(self._at))]
            if mark in self._at:
                return False
            while len(self._at) >= SEEN_MAX:
                del self._at[next(iter(self._at))]
            self._at[mark] = now
            return True


class Near:
    """Peers heard of on the local leg lately: what the broker brings of them as well says less and is left out.

    Their heartbeat there names no session, and its signature would count only once.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._at: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, peer: str) -> None:
        with self._lock:
            self._at.pop(peer, None)
            self._at[peer] = self._clock()
            while len(self._at) > NEAR_MAX:
                del self._at[next(iter(self._at))]

    def holds(self, peer: str) -> bool:
        at = self._at.get(peer)
        return at is not None and self._clock() - at <= NEAR_S


class _Nothing:
    def undeclare(self) -> None:
        """There is nothing to undeclare."""


class _Both:
    """One subscriber on the legs it belongs to; what a leg that is down owes it waits."""

    def __init__(self, key: str, heard: list[tuple[Transport, Callback]]) -> None:
        self.key = key
        self._waiting = heard
        self._handles: list[Handle] = []
        self._gone = False
        self._lock = threading.Lock()

    @property
    def whole(self) -> bool:
        return not self._waiting

    def settle(self) -> list[str]:
        """Declare on every leg that is up and has it not; why that failed, for each that refused."""
        problems: list[str] = []
        with self._lock:
            for entry in [] if self._gone else list(self._waiting):
                leg, callback = entry
                if not leg.is_alive():
                    continue
                try:
                    self._handles.append(leg.declare_subscriber(self.key, callback))
                except TransportError as exc:
                    problems.append(str(exc))
                else:
                    self._waiting.remove(entry)
        return problems

    def undeclare(self) -> None:
        with self._lock:
            handles, self._handles = self._handles, []
            self._waiting, self._gone = [], True
        for handle in handles:
            handle.undeclare()

    @property
    def gone(self) -> bool:
        return self._gone


class BridgeTransport:
    """Zenoh and MQTT as one transport; connected while either leg is.

    A leg that is down when the bridge connects is tried again in the background, and then hears what was subscribed
    meanwhile. The e-stops and resumes that a cloud leg missed are published there as soon as it is up.

    Args:
        local: the leg that carries everything; Zenoh by default.
        cloud: the leg that carries the bridged topics; MQTT by default.
    """

    pins_topics = True
    """The broker's policy keeps a peer to topics of its own name."""

    def __init__(self, local: Transport | None = None, cloud: Transport | None = None) -> None:
        self._local = local or _zenoh()
        self._cloud = cloud or _iot()
        self._seen = Seen()
        self._near = Near()
        self._bridged = _bridged_names()
        self._lock = threading.Lock()
        self._joined: set[Transport] = set()
        self._subscribers: list[_Both] = []
        self._owed: dict[tuple[str, str], bytes] = {}
        self._closed = threading.Event()
        self._closed.set()
        self._mender: threading.Thread | None = None

    @property
    def session_id(self) -> str | None:
        return self._local.session_id

    @property
    def posture(self) -> Any:
        """The certificates of the local leg."""
        return getattr(self._local, "posture", None)

    def connect(self) -> None:
        problems = self._join()
        if not self._joined:
            raise TransportError(f"neither leg of the bridge connects: {'; '.join(problems)}")
        self._closed = threading.Event()
        for problem in problems:
            logger.error("One leg of the bridge is down and is tried again: %s", problem)
        self._mend()

    def close(self) -> None:
        self._closed.set()
        self._local.close()
        self._cloud.close()
        with self._lock:
            mender, self._mender = self._mender, None
            self._joined.clear()
            self._subscribers.clear()
            self._owed.clear()
        if mender is not None:
            mender.join(CLOSE_S)

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
        """Why a message did not go by a leg, or None."""
        cloud = leg is self._cloud
        said = _sessionless(topic, data) if cloud else data
        problem = _try(leg.put, key, said) if leg.is_alive() else "this leg of the bridge is not connected"
        if problem is not None and cloud and topic.name in OWED:
            self._owe(key, topic, said)
        return problem

    def declare_subscriber(self, key: str, callback: Callback) -> _Both:
        topic = topics.topic_of(key)
        once = topic.name in ("cmd", "broadcast")

        def heard(sample: Sample) -> None:
            if not once or self._seen.first(sample.payload):
                callback(sample)

        def near(sample: Sample) -> None:
            if topic.name == "presence":
                self._near.note(_publisher(sample.key))
            heard(sample)

        def far(sample: Sample) -> None:
            if topic.name in ALSO_NEAR and self._near.holds(_publisher(sample.key)):
                return
            heard(sample)

        if not self.is_alive():
            raise TransportError(f"{key}: no leg of the bridge is connected.")
        both = _Both(key, [(leg, near if leg is self._local else far) for leg in self._legs(topic)])
        problems = both.settle()
        if len(problems) == len(self._legs(topic)):
            raise TransportError("; ".join(problems))
        with self._lock:
            self._subscribers = [each for each in self._subscribers if not each.gone] + [both]
        self._mend()
        return both

    def declare_token(self, key: str) -> Handle:
        declare: Callable[[str], Handle] = getattr(self._local, "declare_token", _nothing)
        return declare(key) if self._local.is_alive() else _Nothing()

    def watch_tokens(self, key: str, callback: LivenessCallback) -> Handle:
        watch: Callable[[str, LivenessCallback], Handle] = getattr(self._local, "watch_tokens", _nothing)
        return watch(key, callback) if self._local.is_alive() else _Nothing()

    @property
    def lost_link_at(self) -> float:
        """When the local leg last lost its hub, monotonic seconds."""
        at: float = getattr(self._local, "lost_link_at", -math.inf)
        return at

    def anchored(self) -> bool:
        """Whether the local leg can tell who is alive."""
        anchored = getattr(self._local, "anchored", None)
        return bool(anchored()) if callable(anchored) else True

    def _join(self) -> list[str]:
        """Connect the legs that never were; why that failed."""
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

    def _mend(self) -> None:
        """Have a thread bring up what is down, for as long as something is."""
        with self._lock:
            if self._mender is None and not self._closed.is_set() and not self._whole():
                self._mender = threading.Thread(target=self._run, name="mesh-bridge-mend", daemon=True)
                self._mender.start()

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
                each.settle()
            self._pay()
            with self._lock:
                if self._whole():
                    self._mender = None
                    logger.info("Both legs of the bridge are up.")
                    return

    def _whole(self) -> bool:
        return len(self._joined) == 2 and not self._owed and all(each.whole for each in self._subscribers)

    def _owe(self, key: str, topic: topics.Topic, data: bytes) -> None:
        """Keep a stop or a resume for the cloud, once for each id, until it is back."""
        mark = _safety_mark(data, topic)
        with self._lock:
            self._owed.pop((key, mark), None)
            self._owed[key, mark] = data
            while len(self._owed) > OWED_MAX:
                del self._owed[next(iter(self._owed))]
        self._mend()

    def _pay(self) -> None:
        for name, data in list(self._owed.items()):
            if not self._cloud.is_alive() or _try(self._cloud.put, name[0], data) is not None:
                return
            with self._lock:
                if self._owed.get(name) is data:
                    del self._owed[name]

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
    """Whose a key is: a reply's is the responder's."""
    parts = key.split("/")
    if len(parts) > 3 and parts[2] == "response":
        return parts[3]
    return parts[1] if len(parts) > 1 else ""


def _sessionless(topic: topics.Topic, data: bytes) -> bytes:
    """A stop or a resume as it goes to the broker: one that names a session is refused where samples have none."""
    if topic.name not in ("estop", "resume"):
        return data
    try:
        body = wire.decode(data, topic.max_bytes)
    except wire.WireError:
        return data
    body.pop("source_zid", None)
    return wire.encode(body, topic.max_bytes)


def _safety_mark(data: bytes, topic: topics.Topic) -> str:
    """What makes two messages of a safety topic the same one: the id of a stop, the nonce of a resume."""
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


def _nothing(*args: Any) -> _Nothing:
    return _Nothing()


def _zenoh() -> Transport:
    from strands_robots.mesh.transport.zenoh import ZenohTransport  # noqa: PLC0415 - loaded when it is a leg

    return ZenohTransport()


def _iot() -> Transport:
    from strands_robots.mesh.transport.iot import IotMqttTransport  # noqa: PLC0415 - loaded when it is a leg

    return IotMqttTransport()
