"""The mesh session of a process, its registry of peers, and a peer's context.

The session is opened for its first user and closed with its last. Without stated endpoints (``STRANDS_MESH_CONNECT``,
``STRANDS_MESH_LISTEN``, else ``ZENOH_CONNECT``, ``ZENOH_LISTEN``) the first process of a machine is the hub on
``tcp/127.0.0.1:STRANDS_MESH_PORT`` and the others are its clients; when it dies a survivor takes the port. Zenoh is
imported with the first session, not before.
"""

from __future__ import annotations

import atexit
import logging
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.mesh import wire
from strands_robots.mesh.scheduler import AuditThrottle, end_jobs
from strands_robots.mesh.transport import Sample, Transport, TransportError
from strands_robots.mesh.transport.config import stated_endpoints
from strands_robots.mesh.transport.factory import make_transport
from strands_robots.mesh.wire import WireError
from strands_robots.mesh.wire_identity import ConsoleSigner, ConsoleTrust, Identity
from strands_robots.moved import of_module
from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.utils import MissingExtraError, number

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


PEER_TIMEOUT = 10.0
"""Seconds of silence after which a peer is out of reach."""

PAST_MAX = 1024
SESSION_PEERS_MAX = 256
"""Peers that one session may announce: a process with several worlds, and no flood of invented names."""


class Attribution(Enum):
    """Result of :func:`attribute`."""

    BOUND = "the session the peer announced itself from"
    PINNED = "no session on this transport; the broker's policy pins the topic"
    OTHER = "another session than the peer announced itself from"
    MISSING = "no session, and the peer announced itself from one"
    UNKNOWN = "the peer was never seen"

    @property
    def accepted(self) -> bool:
        """True where a reply counts."""
        return self in (Attribution.BOUND, Attribution.PINNED)


def attribute(bound: str | None, sample: Sample) -> Attribution:
    """Compare the session bound to a sender with the one on its sample."""
    if bound is not None:
        if sample.session == bound:
            return Attribution.BOUND
        return Attribution.OTHER if sample.session is not None else Attribution.MISSING
    return Attribution.PINNED if sample.session is None and sample.sessionless else Attribution.UNKNOWN


@dataclass(frozen=True, slots=True)
class PeerInfo:
    """One row; ``since`` and ``seen`` time its first and last heartbeat.

    ``older`` is a peer of a 0.5 release.
    """

    peer_id: str
    peer_type: str
    hostname: str
    seen: float
    caps: dict[str, Any] = field(default_factory=dict)
    session: str | None = None
    certificate: tuple[str, str] | None = None
    gone: bool = False
    since: float = 0.0
    older: bool = False

    def living(self, now: float) -> bool:
        """True while the peer counts as there."""
        return not self.gone and now - self.seen <= PEER_TIMEOUT

    def to_dict(self, now: float) -> dict[str, Any]:
        """Return the presence fields, and over them those that are decided here."""
        age = max(0.0, now - self.seen)
        return {
            **self.caps,
            "peer_id": self.peer_id,
            "type": self.peer_type,
            "hostname": self.hostname,
            "age": round(age, 3),
            "reachable": self.living(now),
            **({"older": True} if self.older else {}),
        }


OURS_ANNOUNCE = frozenset({"robot_kind", "locked"})
"""Fields of the heartbeat of a robot of ours that no 0.5 release has."""


class PeerRegistry:
    """Rows by peer id, bounded; thread-safe.

    Args:
        clock: monotonic seconds.
        most: returns the bound on rows. A silent row makes place, the longest silent first; a living one never does,
            so a newcomer to a full table is left out.
        retention: returns the seconds for which a silent peer stays listed as out of reach.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        most: Callable[[], int] = lambda: 1024,
        retention: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self._clock = clock
        self._most = most
        self._retention = retention
        self._lock = threading.Lock()
        self._rows: dict[str, PeerInfo] = {}
        self._past: dict[str, tuple[float, float]] = {}
        self._older: set[str] = set()

    def update(
        self,
        peer_id: str,
        peer_type: str,
        hostname: str,
        caps: dict[str, Any],
        *,
        session: str | None = None,
        certificate: tuple[str, str] | None = None,
        older: bool = False,
        anonymous: bool = False,
    ) -> bool:
        """Insert or refresh a row; True when the peer is new and has a row now.

        A living peer that states no session or no certificate keeps the one that it is bound to. ``older`` is a peer of
        a 0.5 release, towards which messages are paced. ``anonymous`` is one without a session on a transport that has
        them; all of these are bounded together, as those of one session are.
        """
        now = self._clock()
        with self._lock:
            known = self._rows.get(peer_id)
            if known is None and not self._has_place(session, now, anonymous=anonymous):
                return False
            # Taken out and put in again, so that the rows are in the order of their last heartbeat.
            self._rows.pop(peer_id, None)
            since = self._past.pop(peer_id, (now, now))[1]
            if known is not None:
                since = known.since
                if known.living(now):
                    session = session if session is not None else known.session
                    certificate = certificate if certificate is not None else known.certificate
            # One of ours whose token is not here yet is known by what its heartbeat says.
            is_old = older and OURS_ANNOUNCE.isdisjoint(caps)
            row = PeerInfo(
                peer_id, peer_type, hostname, now, dict(caps), session, certificate, since=since, older=is_old
            )
            self._rows[peer_id] = row
            if older:
                self._older.add(peer_id)
            elif self._older:
                self._older.discard(peer_id)
        return known is None

    def full_for(self, peer_id: str, session: str | None, *, anonymous: bool = False) -> bool:
        """True when a heartbeat of this newcomer would be left out."""
        with self._lock:
            if peer_id in self._rows:
                return False
            return not self._has_place(session, self._clock(), make=False, anonymous=anonymous)

    def _has_place(self, session: str | None, now: float, *, make: bool = True, anonymous: bool = False) -> bool:
        """True when a newcomer of ``session`` fits; silent rows may be dropped for it."""
        bounded = session is not None or anonymous
        of_session = sum(row.session == session for row in self._rows.values()) if bounded else 0
        if of_session >= SESSION_PEERS_MAX:
            return False
        over = len(self._rows) + 1 - max(1, self._most())
        if over <= 0:
            return True
        silent = [peer for peer, row in self._rows.items() if not row.living(now)][:over]
        if len(silent) < over:
            return False
        for peer in silent if make else ():
            self._remember(peer, self._rows.pop(peer))
        return True

    def _remember(self, peer_id: str, row: PeerInfo) -> None:
        """Note a peer whose row is dropped; the shortest stay is forgotten first."""
        self._older.discard(peer_id)
        self._past[peer_id] = (row.seen, row.since)
        if len(self._past) > PAST_MAX:
            del self._past[min(self._past, key=lambda each: self._past[each][0] - self._past[each][1])]

    def conflicts(self, peer_id: str, session: str | None, *, certified: bool = False) -> str | None:
        """Return the binding that rules out a heartbeat from ``session``, else None.

        That is the session of a living peer when it is another one, or the certificate (SHA-256) that it announced
        itself with when the heartbeat is not ``certified`` for the peer.
        """
        row = self._row(peer_id)
        if row is None or not row.living(self._clock()):
            return None
        if row.session is not None and row.session != session:
            return row.session
        return row.certificate[0] if row.certificate is not None and not certified else None

    def older(self) -> list[str]:
        """Return the living peers of 0.5 releases."""
        if not self._older:
            return []
        now = self._clock()
        with self._lock:
            return sorted(peer for peer in self._older if self._rows[peer].living(now))

    def is_older(self, peer_id: str) -> bool:
        """Return True for a peer of a 0.5 release, however long it is silent.

        One of ours whose token is not here yet would not be locked by the stop of an older peer.
        """
        row = self._row(peer_id)
        return row is not None and row.older

    def knows_ours(self, peer_id: str) -> bool:
        """Return True for a peer known to read what 0.5 releases refuse."""
        row = self._row(peer_id)
        return row is not None and not row.older

    def session_of(self, peer_id: str) -> str | None:
        row = self._row(peer_id)
        return row.session if row else None

    def left(self, peer_id: str, session: str) -> bool:
        """Return True for a peer that left this session; silence alone is no leave."""
        row = self._row(peer_id)
        return row is None or row.gone or row.session != session

    def of_world(self, peer_id: str, session: str | None) -> bool:
        """True for a robot of a world, which answers by the world.

        The world has to be on the same session: another one's name hides no robot.
        """
        world = peer_id.rpartition("__")[0]
        return bool(world) and session is not None and self.session_of(world) == session

    def certificate_of(self, peer_id: str) -> tuple[str, str] | None:
        row = self._row(peer_id)
        return row.certificate if row else None

    def lost(self, peer_id: str, session: str) -> bool:
        """Note that a session ended; True when the peer was bound to it."""
        with self._lock:
            row = self._rows.get(peer_id)
            if row is None or row.session != session or row.gone:
                return False
            self._rows[peer_id] = replace(row, gone=True)
            return True

    def all(self) -> list[dict[str, Any]]:
        now = self._clock()
        with self._lock:
            return [row.to_dict(now) for row in self._rows.values()]

    def get(self, peer_id: str, max_age_s: float | None = None) -> dict[str, Any] | None:
        now, row = self._clock(), self._row(peer_id)
        if row is None or (max_age_s is not None and now - row.seen > max_age_s):
            return None
        return row.to_dict(now)

    def clear(self) -> None:
        with self._lock:
            self._rows.clear()
            self._past.clear()
            self._older.clear()

    def prune(self, timeout: float = PEER_TIMEOUT) -> list[str]:
        """Drop rows silent for longer than ``timeout`` and the retention; return ids."""
        limit, now = max(timeout, self._retention()), self._clock()
        with self._lock:
            gone = [peer for peer, row in self._rows.items() if now - row.seen > limit]
            for peer in gone:
                self._remember(peer, self._rows.pop(peer))
        return gone

    def seen_within(self, seconds: float) -> set[str]:
        """Ids of peers seen in the last ``seconds``, dropped ones included."""
        now = self._clock()
        with self._lock:
            past = {peer: seen for peer, (seen, _) in self._past.items()}
            seen = {**past, **{peer: row.seen for peer, row in self._rows.items()}}
        return {peer for peer, at in seen.items() if now - at <= seconds}

    def _row(self, peer_id: str) -> PeerInfo | None:
        with self._lock:
            return self._rows.get(peer_id)


logger = logging.getLogger(__name__)

COMMANDS_S = 0.06
"""Between two commands on one link, and between two broadcasts: 0.5.3 keeps the same between its own."""

SAFETY_S = 0.6
"""Between two messages on a safety topic."""

ASK_AGAIN_S = 0.25
"""After which an unanswered stop or read is asked again, under a fresh turn."""

SAFETY = "safety"


class Pacer:
    """Keeps the messages of one kind apart; thread-safe.

    The peers of a process share it, as they share the link.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._last: dict[str, float] = {}
        self._urgent: Counter[str] = Counter()

    def note(self, kind: str) -> None:
        """Note a message that does not wait."""
        self._last[kind] = self._clock()

    @contextmanager
    def turn(self, kind: str, gap_s: float, *, first: bool = False) -> Iterator[None]:
        """Wait until ``gap_s`` after the last message; ``first`` overtakes others."""
        with self._changed:
            self._urgent[kind] += first
            try:
                while (left := self._left(kind, gap_s)) > 0 or (self._urgent[kind] and not first):
                    self._changed.wait(left if left > 0 else None)
            finally:
                self._urgent[kind] -= first
                self._changed.notify_all()
            try:
                yield
            finally:
                # After the put: a thread that is held up before it must not bring the next message closer.
                self._last[kind] = self._clock()

    def _left(self, kind: str, gap_s: float) -> float:
        return self._last.get(kind, -math.inf) + gap_s - self._clock()


@dataclass(slots=True)
class Context:
    """Shared by the parts of one peer.

    Attributes:
        clock: wall-clock seconds, as stated on the wire.
        monotonic: seconds, for ages.
        audit: records refusals; ``audit.always`` records what may never be left out.
        transport: None while the peer is not on the mesh.
        console: signs what moves real hardware; ``consoles`` checks such signatures.
        has_robot: it moves; a peer without a robot remembers those that it hears.
        pacer: keeps messages apart while a peer of a 0.5 release is known.
    """

    peer_id: str
    registry: PeerRegistry
    audit: AuditThrottle
    identity: Identity
    clock: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    transport: Transport | None = field(default=None)
    console: ConsoleSigner = field(default_factory=ConsoleSigner)
    consoles: ConsoleTrust = field(default_factory=ConsoleTrust)
    pacer: Pacer = field(default_factory=Pacer)
    has_robot: bool = False
    began: float = field(init=False)
    _began_at: float = field(init=False)

    def __post_init__(self) -> None:
        self.began, self._began_at = self.clock(), self.monotonic()

    def predates(self, stamp: float) -> bool:
        """True for a message that may have counted before this peer began.

        Args:
            stamp: wall-clock seconds of its sender. Once what was issued before is no longer fresh, all is false.
        """
        return stamp < self.began and self.monotonic() - self._began_at <= wire.FRESH_S + wire.AHEAD_S

    @property
    def age_s(self) -> float:
        """Seconds since this peer began."""
        return self.monotonic() - self._began_at

    def running(self) -> bool:
        return self.transport is not None and self.transport.is_alive()

    def put(self, key: str, payload: Mapping[str, Any]) -> None:
        """Publish; raise TransportError off the mesh, WireError above the size."""
        transport = self.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        transport.put(key, payload)

    def session_id(self) -> str | None:
        return self.transport.session_id if self.transport is not None else None


_NAMES_THE_MESH = (
    "STRANDS_MESH_BACKEND",
    "STRANDS_MESH_PORT",
    "STRANDS_MESH_CONNECT",
    "STRANDS_MESH_LISTEN",
    "ZENOH_CONNECT",
    "ZENOH_LISTEN",
    "STRANDS_MESH_MULTICAST",
    "STRANDS_MESH_NAMESPACE",
    "STRANDS_MESH_AUTH_MODE",
    "STRANDS_MESH_I_KNOW_THIS_IS_INSECURE",
    "STRANDS_MESH_LOCAL_DEV",
    "STRANDS_MESH_TLS_CA",
    "STRANDS_MESH_TLS_CERT",
    "STRANDS_MESH_TLS_KEY",
    "STRANDS_MESH_ACL_FILE",
    "STRANDS_IOT_ENDPOINT",
)

_registry = PeerRegistry(
    most=lambda: settings.integer("STRANDS_MESH_MAX_PEERS"),
    retention=lambda: settings.number("STRANDS_MESH_PEER_RETENTION_S"),
)
_pacer = Pacer()


class _Shared:
    """The one transport of this process, and the number of references to it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.transport: Transport | None = None
        self.opened_with: Mapping[str, str] = {}
        self.references = 0

    def acquire(self) -> Transport | None:
        """Take a reference to the shared transport; None, logged, where there is none."""
        if mesh_env_request() is False:
            return None
        with self.lock:
            if self.transport is None:
                stated = stated_mesh()
                try:
                    transport = make_transport()
                    transport.connect()
                except (TransportError, MissingExtraError) as exc:
                    logger.error("The mesh has no session: %s", exc)  # noqa: TRY400 - one sentence, no trace
                    return None
                self.transport, self.opened_with = transport, stated
            # A robot of this process may become the hub, though the first user of the session only dialled.
            self.transport.take_part()
            self.references += 1
            return self.transport

    def dial(self) -> Transport:
        """Take a reference as a caller without a robot, which never becomes the hub.

        Raises:
            TransportError: the mesh is switched off, or there is no hub, stated endpoint or multicast to reach it by.
            MissingExtraError: the transport's extra is not installed.
        """
        if mesh_env_request() is False:
            raise TransportError("STRANDS_MESH switches the mesh off.")
        with self.lock:
            if self.transport is None:
                stated = stated_mesh()
                transport = make_transport()
                transport.dials_only = True
                transport.connect()
                self.transport, self.opened_with = transport, stated
            self.references += 1
            return self.transport

    def release(self) -> None:
        """Release one reference; the last one closes the session."""
        with self.lock:
            if self.transport is None:
                return
            self.references -= 1
            if self.references > 0:
                return
            transport, self.transport, self.references = self.transport, None, 0
        try:
            transport.close()
        except zenoh_error_types() as exc:
            logger.warning("The mesh's session did not close in good order: %s", exc)
        else:
            logger.info("The mesh's session is closed.")

    def close(self) -> None:
        """Close it whatever the references: Zenoh would hang the interpreter's end."""
        with self.lock:
            self.references = min(self.references, 1)
        self.release()


_shared = _Shared()
atexit.register(_shared.close)
# Before it: a job that publishes then would log a session that is closed.
atexit.register(end_jobs)


acquire = _shared.acquire
dial = _shared.dial
release_session = _shared.release


def get_session() -> Any | None:
    """Take a reference to the shared session, a ``zenoh.Session`` by default."""
    return _session_of(acquire())


def current_session() -> Any | None:
    """Return the session, if it is open, without taking a reference."""
    return _session_of(_shared.transport)


def session_alive() -> bool:
    """True while the session is open."""
    transport = _shared.transport
    return transport is not None and transport.is_alive()


def cut_off() -> bool:
    """True while the session is open, and linked to no hub or broker."""
    transport = _shared.transport
    return transport is not None and transport.cut_off()


def opened_with() -> Mapping[str, str] | None:
    """Return :func:`stated_mesh` of the open session; None without a session."""
    with _shared.lock:
        return None if _shared.transport is None else _shared.opened_with


def stated_mesh(instead: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the settings that say which mesh is joined, equal for the same mesh.

    Args:
        instead: settings by variable that count instead of the environment's; an empty one is the default.
    """
    values = {name: settings.raw(name) for name in _NAMES_THE_MESH}
    values |= {name: value or settings.default(name) for name, value in (instead or {}).items()}
    for way in ("CONNECT", "LISTEN"):
        stated, shared = values.pop(f"STRANDS_MESH_{way}"), values.pop(f"ZENOH_{way}")
        values[way] = "" if stated == settings.NO_ENDPOINT else stated or shared
    if values["CONNECT"] or values["LISTEN"]:
        # The port is where peers without an endpoint meet.
        del values["STRANDS_MESH_PORT"]
    return values


def put(key: str, data: dict[str, Any]) -> None:
    """Publish a JSON object at once; nothing happens while no session is open.

    A message that cannot be sent is logged at WARNING.
    """
    transport = _shared.transport
    if transport is None:
        return
    try:
        transport.put(key, data)
    except (TransportError, WireError) as exc:
        logger.warning("%s was not published: %s", key, exc)


def zenoh_error_types() -> tuple[type[BaseException], ...]:
    """Exception types of a transport's faults; ``ZError`` only with Zenoh."""
    try:
        import zenoh  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        return (OSError, RuntimeError)
    return (zenoh.ZError, OSError, RuntimeError)


def network() -> NetworkKey:
    """Return the key of the mesh that this process joins, from its settings."""
    backend = settings.raw("STRANDS_MESH_BACKEND").lower()
    endpoints = [each for stated in stated_endpoints() for each in stated]
    if backend in ("zenoh", "bridge") and not endpoints:
        endpoints = [f"tcp/127.0.0.1:{settings.integer('STRANDS_MESH_PORT')}"]
    broker = settings.raw("STRANDS_IOT_ENDPOINT")
    if backend == "bridge" and broker:
        endpoints.append(broker)
    elif backend == "iot":
        endpoints = [broker]
    elif backend == "memory":
        endpoints = [f"memory-{os.getpid()}"]
    return NetworkKey.of(MESH, endpoints)


def registry() -> PeerRegistry:
    """Return the registry that every mesh of this process shares."""
    return _registry


def pacer() -> Pacer:
    """Return the pacer that every mesh of this process shares, as it shares the link."""
    return _pacer


def get_peers() -> list[dict[str, Any]]:
    """Return all known peers as plain dicts."""
    return _registry.all()


def get_peer(peer_id: str, max_age_s: float | None = None) -> dict[str, Any] | None:
    """Return one peer, or None when it is unknown or silent for over ``max_age_s`` s.

    Raises:
        ValidationError: ``max_age_s`` is not positive and finite.
    """
    return _registry.get(peer_id, None if max_age_s is None else number("max_age_s", max_age_s, above=0))


def update_peer(peer_id: str, peer_type: str, hostname: str, caps: dict[str, Any]) -> bool:
    """Insert or refresh a peer; True when it is new."""
    return _registry.update(peer_id, peer_type, hostname, caps)


def clear_peers() -> None:
    """Remove every peer, as where the mesh was left."""
    _registry.clear()


def prune_peers(timeout: float = PEER_TIMEOUT) -> list[str]:
    """Remove the peers silent for longer than ``timeout`` s and return their ids."""
    return _registry.prune(number("timeout", timeout, above=0))


def _session_of(transport: Transport | None) -> Any | None:
    # Users of Zenoh expect its own session object.
    return getattr(transport, "session", None) or transport
