"""Registry of peers, each bound to its session and its certificate.

Ages are measured here, on a monotonic clock, never taken from the wire. :func:`attribute` compares the session of a
message with the one that its stated sender is bound to.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from strands_robots.mesh.transport import Sample

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

    @property
    def proven(self) -> bool:
        """True where a motion counts; a topic that anyone may write to is no proof."""
        return self is Attribution.BOUND


def attribute(bound: str | None, sample: Sample) -> Attribution:
    """Compare the session bound to a sender with the one on its sample."""
    if bound is not None:
        if sample.session == bound:
            return Attribution.BOUND
        return Attribution.OTHER if sample.session is not None else Attribution.MISSING
    return Attribution.PINNED if sample.session is None and sample.sessionless else Attribution.UNKNOWN


@dataclass(frozen=True, slots=True)
class PeerInfo:
    """One row; ``since`` and ``seen`` time its first and last heartbeat."""

    peer_id: str
    peer_type: str
    hostname: str
    seen: float
    caps: dict[str, Any] = field(default_factory=dict)
    session: str | None = None
    certificate: tuple[str, str] | None = None
    gone: bool = False
    since: float = 0.0

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
        }


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
            row = PeerInfo(peer_id, peer_type, hostname, now, dict(caps), session, certificate, since=since)
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

    def session_of(self, peer_id: str) -> str | None:
        row = self._row(peer_id)
        return row.session if row else None

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
