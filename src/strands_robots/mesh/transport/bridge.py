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
from strands_robots.mesh.transport.base import Callback, LivenessCallback, Sample, Subscription, Transport
from strands_robots.mesh.transport.base import TransportError as LegError

logger = logging.getLogger(__name__)

SEEN_S = 120.0
SEEN_MAX = 10_000
NEAR_S = 3.0
NEAR_MAX = 1024


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


class _Both:
    def __init__(self, handles: list[Subscription]) -> None:
        self._handles = handles

    def undeclare(self) -> None:
        for handle in self._handles:
            handle.undeclare()


class BridgeTransport:
    """Zenoh and MQTT as one transport; connected while either leg is.

    Args:
        local: the leg that carries everything; Zenoh by default.
        cloud: the leg that carries the bridged topics; MQTT by default.
    """

    def __init__(self, local: Transport | None = None, cloud: Transport | None = None) -> None:
        self._local = local or _zenoh()
        self._cloud = cloud or _iot()
        self._seen = Seen()
        self._near = Near()
        self._bridged = _bridged_names()

    @property
    def session_id(self) -> str | None:
        return self._local.session_id

    @property
    def posture(self) -> Any:
        """The certificates of the local leg."""
        return getattr(self._local, "posture", None)

    def connect(self) -> None:
        problems = [problem for leg in (self._local, self._cloud) if (problem := _try(leg.connect)) is not None]
        for problem in problems:
            logger.error("One leg of the bridge is down: %s", problem)
        if len(problems) == 2:
            raise LegError(f"neither leg of the bridge connects: {'; '.join(problems)}")

    def close(self) -> None:
        self._local.close()
        self._cloud.close()

    def is_alive(self) -> bool:
        return self._local.is_alive() or self._cloud.is_alive()

    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        topic = topics.topic_of(key)
        data = payload if isinstance(payload, bytes) else wire.encode(payload, topic.max_bytes)
        legs = [leg for leg in self._legs(topic) if leg.is_alive()]
        problems = [
            problem
            for leg in legs
            if (problem := _try(leg.put, key, data if leg is self._local else _sessionless(topic, data))) is not None
        ]
        if len(problems) == len(legs):
            raise LegError(f"{key}: {'; '.join(problems) or 'no leg of the bridge is connected'}")

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

        handles = [
            leg.declare_subscriber(key, near if leg is self._local else far)
            for leg in self._legs(topic)
            if leg.is_alive()
        ]
        if not handles:
            raise LegError(f"{key}: no leg of the bridge is connected.")
        return _Both(handles)

    def declare_token(self, key: str) -> Subscription:
        declare: Callable[[str], Subscription] = getattr(self._local, "declare_token", _nothing)
        return declare(key) if self._local.is_alive() else _Both([])

    def watch_tokens(self, key: str, callback: LivenessCallback) -> Subscription:
        watch: Callable[[str, LivenessCallback], Subscription] = getattr(self._local, "watch_tokens", _nothing)
        return watch(key, callback) if self._local.is_alive() else _Both([])

    @property
    def lost_link_at(self) -> float:
        """When the local leg last lost its hub, monotonic seconds."""
        at: float = getattr(self._local, "lost_link_at", -math.inf)
        return at

    def anchored(self) -> bool:
        """Whether the local leg can tell who is alive."""
        anchored = getattr(self._local, "anchored", None)
        return bool(anchored()) if callable(anchored) else True

    def _legs(self, topic: topics.Topic) -> list[Transport]:
        return [self._local, self._cloud] if topic.name in self._bridged else [self._local]


def _bridged_names() -> frozenset[str]:
    stated = settings.items("STRANDS_MESH_BRIDGE_TOPICS")
    unknown = [name for name in stated if name not in topics.BY_NAME]
    if unknown:
        raise LegError(
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
    except (LegError, ImportError) as exc:
        return str(exc)
    return None


def _nothing(*args: Any) -> _Both:
    return _Both([])


def _zenoh() -> Transport:
    from strands_robots.mesh.transport.zenoh import ZenohTransport  # noqa: PLC0415 - loaded when it is a leg

    return ZenohTransport()


def _iot() -> Transport:
    from strands_robots.mesh.transport.iot import IotMqttTransport  # noqa: PLC0415 - loaded when it is a leg

    return IotMqttTransport()
