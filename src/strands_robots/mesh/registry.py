"""Who is there: the peers heard of, bound to the session and the certificate they announced themselves with.

Ages are measured here, on a monotonic clock, never taken from the wire.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

PEER_TIMEOUT = 10.0
"""Seconds of silence after which a peer is out of reach."""

PAST_MAX = 1024


@dataclass(frozen=True, slots=True)
class PeerInfo:
    """One row. ``seen`` is on the monotonic clock; ``gone`` says that its session is known to have ended."""

    peer_id: str
    peer_type: str
    hostname: str
    seen: float
    caps: dict[str, Any] = field(default_factory=dict)
    session: str | None = None
    certificate: tuple[str, str] | None = None
    gone: bool = False

    def to_dict(self, now: float) -> dict[str, Any]:
        """Presence fields, then what is decided here: id, type, host, age in seconds, whether it is in reach."""
        age = max(0.0, now - self.seen)
        return {
            **self.caps,
            "peer_id": self.peer_id,
            "type": self.peer_type,
            "hostname": self.hostname,
            "age": round(age, 3),
            "reachable": age <= PEER_TIMEOUT and not self.gone,
        }


class PeerRegistry:
    """Rows by peer id, bounded; thread-safe.

    Args:
        clock: monotonic seconds.
        most: gives the most rows that are kept; the longest silent leaves first.
        retention: gives the seconds for which a silent peer stays listed as out of reach.
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
        self._past: dict[str, float] = {}

    def update(
        self,
        peer_id: str,
        peer_type: str,
        hostname: str,
        caps: dict[str, Any],
        *,
        session: str | None = None,
        certificate: tuple[str, str] | None = None,
    ) -> bool:
        """Insert or refresh a row; True when the peer is new.

        Who says no session of a living peer leaves it bound as it was, and so it is with its certificate.
        """
        now = self._clock()
        with self._lock:
            # Taken out and put in again, so that the order of the rows is the order of their last word.
            known = self._rows.pop(peer_id, None)
            if known is not None and not known.gone and now - known.seen <= PEER_TIMEOUT:
                session = session if session is not None else known.session
                certificate = certificate if certificate is not None else known.certificate
            row = PeerInfo(peer_id, peer_type, hostname, now, dict(caps), session, certificate)
            self._past.pop(peer_id, None)
            self._rows[peer_id] = row
            while len(self._rows) > max(1, self._most()):
                del self._rows[next(iter(self._rows))]
        return known is None

    def conflicts(self, peer_id: str, session: str | None, *, certified: bool = False) -> str | None:
        """What already speaks for the living ``peer_id`` and bars this heartbeat of it, else None.

        That is its session when it is another than ``session``, or the certificate (SHA-256) that it announced itself
        with when this heartbeat is not ``certified`` for the peer.
        """
        row = self._row(peer_id)
        if row is None or row.gone or self._clock() - row.seen > PEER_TIMEOUT:
            return None
        if row.session is not None and row.session != session:
            return row.session
        return row.certificate[0] if row.certificate is not None and not certified else None

    def session_of(self, peer_id: str) -> str | None:
        row = self._row(peer_id)
        return row.session if row else None

    def certificate_of(self, peer_id: str) -> tuple[str, str] | None:
        row = self._row(peer_id)
        return row.certificate if row else None

    def lost(self, peer_id: str, session: str) -> bool:
        """Note that the session of a peer ended; True when it was the one the peer is bound to."""
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

    def prune(self, timeout: float = PEER_TIMEOUT) -> list[str]:
        """Drop the rows that were silent for longer than ``timeout`` and the retention; their ids."""
        limit, now = max(timeout, self._retention()), self._clock()
        with self._lock:
            gone = [peer for peer, row in self._rows.items() if now - row.seen > limit]
            for peer in gone:
                self._past[peer] = self._rows.pop(peer).seen
            while len(self._past) > PAST_MAX:
                del self._past[next(iter(self._past))]
        return gone

    def heard_within(self, seconds: float) -> set[str]:
        """Every peer heard of in the last ``seconds``, also those that were dropped for their silence."""
        now = self._clock()
        with self._lock:
            seen = {**self._past, **{peer: row.seen for peer, row in self._rows.items()}}
        return {peer for peer, at in seen.items() if now - at <= seconds}

    def _row(self, peer_id: str) -> PeerInfo | None:
        with self._lock:
            return self._rows.get(peer_id)
