"""Resumes for peers that were out of reach, and stops for those of 0.5 releases.

Zenoh stores nothing for a peer that comes back, and the console that resumed the fleet may be gone by then. So every
robot publishes a resume again, for a minute, when a peer that missed it is back. A peer of ours asks for the stops that
it missed (:mod:`~strands_robots.mesh.missed`); one of the 0.5 releases cannot, and gets them in the same way.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.mesh.context import Context
from strands_robots.safety.statements import enrolled_peers, lockout_distrust

logger = logging.getLogger(__name__)

KNOWN_S = 600.0
"""A peer that sent a heartbeat within these seconds gets the stop when it comes back; a newcomer does not."""

SETTLE_S = 1.0
"""A heartbeat this much younger than the stop reports what the stop did to its sender."""

AGAIN_S = 2.0
SPREAD_S = 1.0
TRIES_MAX = 10
"""Repeats to a peer that goes on reporting the same; access rules may keep them from it."""

RESUME_S = 50.0
"""Seconds for which a recorded resume is passed on: a robot refuses one older than 60 s."""

STORED_MAX = 64

Publish = Callable[[], None]
Renew = Callable[[str, Iterable[str]], None]
"""Signs and publishes a resume of an epoch for these peers."""


@dataclass(slots=True)
class _Missing:
    """Peers that a stop or a resume has to reach, with the attempts so far."""

    epoch: str
    since: float
    lasts_s: float
    locks: bool
    pending: dict[str, int]
    absent: frozenset[str]
    publish: Callable[[list[str]], None]
    due: float = field(default_factory=time.monotonic)


class LatePeers:
    """Tells peers that are back of the stops and resumes that they missed.

    Args:
        epochs: returns those that lock this peer's own robot.
    """

    def __init__(self, context: Context, epochs: Callable[[], tuple[str, ...]]) -> None:
        self._context = context
        self._epochs = epochs
        self._missing: dict[tuple[str, bool], _Missing] = {}
        # Robots of one fleet look at the same time; the first one that publishes spares the others the work.
        self._delay_s = SPREAD_S * (zlib.crc32(context.peer_id.encode()) % 1000) / 1000

    def stopped(self, epoch: str, publish: Publish) -> None:
        """Note a stop that locked us; ``publish`` repeats it to peers of 0.5 releases."""
        known = self._context.registry.seen_within(KNOWN_S)
        self._note(epoch, float("inf"), known, lambda peers: publish(), locks=True)

    def resumed(self, epoch: str, targets: Iterable[str], publish: Publish) -> None:
        """Note a resume that we admitted; ``publish`` repeats it."""
        self._note(epoch, RESUME_S, targets, lambda peers: publish(), locks=False)

    def renewable(self, epoch: str, targets: Iterable[str], renew: Renew) -> None:
        """Note a resume that is signed anew for the next ten minutes."""
        self._note(epoch, KNOWN_S, targets, lambda peers: renew(epoch, peers), locks=False)

    def heard(self, epoch: str) -> None:
        """Note that another peer published the stop of this epoch just now."""
        missing = self._missing.get((epoch, True))
        if missing is not None:
            missing.due = time.monotonic() + AGAIN_S + self._delay_s

    @property
    def waits(self) -> bool:
        """True while a stop or a resume may have to be published again."""
        return bool(self._missing)

    def look(self) -> None:
        """Publish again for each peer that is back and reports that it missed it."""
        held, now = self._epochs(), time.monotonic()
        for key, missing in list(self._missing.items()):
            over = missing.locks and missing.epoch not in held
            if over or not missing.pending or self._context.monotonic() - missing.since > missing.lasts_s:
                self._missing.pop(key, None)
            elif now >= missing.due and (back := self._back(missing, enrolled_peers())):
                missing.due = now + AGAIN_S + self._delay_s
                for peer in back:
                    missing.pending[peer] += 1
                logger.warning(
                    "%s missed the %s of %s: it is published again.",
                    ", ".join(back),
                    "emergency stop" if missing.locks else "resume",
                    missing.epoch,
                )
                missing.publish(back)

    def _note(
        self,
        epoch: str,
        lasts_s: float,
        peers: Iterable[str],
        publish: Callable[[list[str]], None],
        *,
        locks: bool,
    ) -> None:
        registry, now = self._context.registry, self._context.monotonic()
        pending = dict.fromkeys(set(peers) - {self._context.peer_id}, 0)
        reachable = {row["peer_id"] for row in registry.all() if row["reachable"]}
        self._missing.pop((epoch, locks), None)
        self._missing[epoch, locks] = _Missing(
            epoch,
            now,
            lasts_s,
            locks,
            pending,
            frozenset(pending) - reachable,
            publish,
            time.monotonic() + SETTLE_S + self._delay_s,
        )
        while len(self._missing) > STORED_MAX:
            del self._missing[next(iter(self._missing))]

    def _back(self, missing: _Missing, keys: Mapping[str, bytes] | None) -> list[str]:
        """Return peers in reach that missed it; forget those that it reached."""
        back: list[str] = []
        older = self._context.registry.older() if missing.locks else ()
        passed = self._context.monotonic() - missing.since
        for peer, tries in list(missing.pending.items()):
            row = self._context.registry.get(peer)
            if row is None or not row["reachable"] or row["age"] > passed - SETTLE_S:
                continue
            asks = missing.locks and peer not in older
            if asks or tries >= TRIES_MAX or self._reached(row, missing, keys):
                del missing.pending[peer]
            else:
                back.append(peer)
        return back

    @staticmethod
    def _reached(row: Mapping[str, Any], missing: _Missing, keys: Mapping[str, bytes] | None) -> bool:
        epochs = row.get("epochs")
        if isinstance(epochs, list):
            if lockout_distrust(str(row["peer_id"]), row, epochs, keys):
                return False
            return (missing.epoch in epochs) is missing.locks
        # A peer that reports no lockout, such as one of the 0.5 releases, is told when it was away.
        return row["peer_id"] not in missing.absent
