"""Stops and resumes of this peer until each robot that they are for has them.

Zenoh stores nothing for a peer that comes back, and the console that resumed the fleet may be gone by then. So the
issuer of a stop repeats it to those that did not confirm it, and every robot publishes a resume again, for a minute,
when a peer that missed it is back. A peer of ours asks for the stops that it missed; one of the 0.5 releases cannot,
and gets them in the same way.

A stop of robots by name goes to each of them in a ``stop`` command, whose ``estop`` is the envelope that locks it; no
other peer gets it. A stop of a cell is also published for all, with its scope. A peer of a 0.5 release refuses a
command with a key that it does not know, so it gets the plain ``stop``, which does not lock it.
"""

from __future__ import annotations

import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from strands_robots.mesh.rpc import Requester, stop_outcome
from strands_robots.mesh.session import SAFETY_S, Context
from strands_robots.mesh.transport.config import DISCOVERY_S
from strands_robots.safety.scope import KnownRobots, Remembers, Scope, report_widened
from strands_robots.safety.statements import enrolled_peers, lockout_distrust
from strands_robots.safety.stopping import Outcome, explain
from strands_robots.stop_log import stop_logger
from strands_robots.utils import RESERVED_IDS, shown

ESTOP = "estop"
"""Field of a ``stop`` that holds the envelope of an emergency stop."""

Replies = list[dict[str, Any]]


def cells_of(row: Mapping[str, Any] | None) -> frozenset[str]:
    """Return the cell that a peer states, as a set; empty for none."""
    cell = (row or {}).get("cell")
    return frozenset({cell} if isinstance(cell, str) and cell else ())


@dataclass(slots=True)
class ScopedStop:
    """One stop of some robots by a peer of the mesh.

    Args:
        scope: the robots that it is for.
        body: the envelope, signed where stops are.
        publish: publishes the envelope, for a cell.
        spacing_s: seconds between two of these.
    """

    context: Context
    requester: Requester
    epoch: str
    scope: Scope
    body: Mapping[str, Any]
    publish: Callable[[], None]
    spacing_s: float
    widened: bool = False

    def targets(self) -> set[str]:
        """Return the peers that have to answer now."""
        own = {self.context.peer_id}
        if self.scope.only:
            return {*self.scope.only} - own - {*RESERVED_IDS}
        rows = (row for row in self.context.registry.all() if row["reachable"])
        return {row["peer_id"] for row in rows if self.scope.covers(row["peer_id"], cells_of(row))} - own

    def command(self, peer: str) -> dict[str, Any]:
        """Return the command that stops a peer, and locks all but 0.5 releases."""
        plain = {"action": "stop"}
        return plain if self.context.registry.is_older(peer) else {**plain, ESTOP: dict(self.body)}

    def send(self, seconds: float, on_answers: Callable[[Replies], None], remembers: Remembers) -> Replies:
        """Send the stop until all have answered; ``widened`` where nobody in it is there."""
        now = time.monotonic()
        # Until then a peer that is linked to us may not be in the registry yet.
        known_at = now + max(0.0, DISCOVERY_S - self.context.age_s)
        publish_at, answered, inside = now, {("", "")}, False
        known = KnownRobots(self.scope, remembers)

        def goes_on(replies: Replies) -> bool:
            nonlocal publish_at, answered, inside
            now = time.monotonic()
            if self.scope.cell and now >= publish_at:
                publish_at = now + self.spacing_s
                self.publish()
            received = {(str(each["responder_id"]), str(each["type"])) for each in replies}
            if received != answered:
                answered = received
                on_answers([each for each in replies if each["type"] == "response"])
                inside = any(kind == "response" and self._means(name) for name, kind in received)
            if now >= known_at + known.widens_after_s and not inside:
                self.widened = True
                report_widened(self.epoch, self.scope)
                return False
            missing = self.targets() - {name for name, _ in received}
            return bool(missing) or (now < known_at and not self.scope.only) or not inside

        def stops() -> dict[str, dict[str, Any]]:
            return {peer: self.command(peer) for peer in sorted(self.targets())}

        return self.requester.stop_each(stops, seconds + known_at - now, goes_on)

    def _means(self, peer: str) -> bool:
        row = self.context.registry.get(peer)
        return self.scope.names(peer, next(iter(cells_of(row)), ""))


logger = stop_logger(__name__)

RETRY_EVERY_S = SAFETY_S
RETRY_ANSWER_S = 1.0
UNANSWERED_MAX = 10
"""Repeats to a peer that is in reach and does not answer; access rules may keep it from us."""


class EstopRetry:
    """Repeats an emergency stop to the peers that missed it, until they stopped.

    A link that parted, or a hub that hangs, loses what is published meanwhile, and Zenoh stores nothing for a peer
    that comes back. So the issuer repeats the stop itself, for as long as it is locked by it.
    """

    def __init__(self, context: Context, requester: Requester) -> None:
        self._context = context
        self._requester = requester
        self._over = threading.Event()

    def begin(
        self,
        epoch: str,
        missing: Iterable[str],
        locked: Callable[[], bool],
        publish: Callable[[], None],
        command: Callable[[str], dict[str, Any]] = lambda peer: {"action": "stop"},
    ) -> None:
        """Repeat the stop until ``missing`` have stopped or the lockout is over.

        Args:
            publish: publishes the stop's envelope once more.
            command: returns the command that stops a peer.
        """
        self._over.set()  # a later stop is answered for an earlier one as well
        over = self._over = threading.Event()
        left = set(missing)
        if left:
            name = f"mesh-{self._context.peer_id}-estop-retry"
            run = partial(self._run, over=over, epoch=epoch, left=left, locked=locked, publish=publish, command=command)
            threading.Thread(target=run, name=name, daemon=True).start()

    def _run(
        self,
        *,
        over: threading.Event,
        epoch: str,
        left: set[str],
        locked: Callable[[], bool],
        publish: Callable[[], None],
        command: Callable[[str], dict[str, Any]],
    ) -> None:
        began, silences = self._context.monotonic(), Counter[str]()
        logged: set[tuple[str, Outcome]] = set()
        while left and not over.wait(RETRY_EVERY_S) and self._context.transport is not None and locked():
            back = sorted(peer for peer in left if self._seen_since(began, peer))
            if back:
                publish()
            for peer in back:
                if over.is_set():
                    return
                reply = self._ask(peer, command(peer))
                outcome = stop_outcome(reply)
                if outcome is Outcome.STOPPED:
                    left.discard(peer)
                    logger.warning("%s has answered emergency stop %s now, and did not at first.", peer, epoch)
                elif outcome is Outcome.TIMED_OUT:
                    silences[peer] += 1
                    if silences[peer] >= UNANSWERED_MAX:
                        left.discard(peer)
                        logger.critical("%s is in reach and does not answer emergency stop %s.", peer, epoch)
                elif (peer, outcome) not in logged:
                    logged.add((peer, outcome))
                    why = explain(reply.get("result")) if "result" in reply else shown(reply.get("error"))
                    logger.critical("%s is in reach and did NOT stop on emergency stop %s: %s", peer, epoch, why)

    def _ask(self, peer: str, stop: dict[str, Any]) -> dict[str, Any]:
        replies = self._requester.stop_each(lambda: {peer: stop}, RETRY_ANSWER_S, lambda replies: not replies)
        return next(iter(replies), {"status": "timeout"})

    def _seen_since(self, began: float, peer: str) -> bool:
        row = self._context.registry.get(peer, self._context.monotonic() - began)
        return row is not None and bool(row["reachable"])


KNOWN_S = 600.0
"""A peer that sent a heartbeat within these seconds gets the stop when it comes back; a newcomer does not."""

SETTLE_S = 1.0
"""A heartbeat this much younger than the stop reports what the stop did to its sender."""

AGAIN_S = 2.0
SPREAD_S = 1.0
TRIES_MAX = 10
"""Repeats to a peer that goes on reporting the same; access rules may keep them from it."""

OLDER_TRIES = 1
"""Repeats of a resume to a peer of a 0.5 release in reach: it drops one within half a second of a stop, and cannot say.

Five of another stop's epoch make it refuse every resume for 30 s.
"""

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
        self.overtaken()
        self._note(epoch, float("inf"), known, lambda peers: publish(), locks=True)

    def resumed(self, epoch: str, targets: Iterable[str], publish: Publish) -> None:
        """Note a resume that we admitted; ``publish`` repeats it."""
        self._note(epoch, RESUME_S, targets, lambda peers: publish(), locks=False)

    def renewable(self, epoch: str, targets: Iterable[str], renew: Renew) -> None:
        """Note a resume that is signed anew for the next ten minutes."""
        self._note(epoch, KNOWN_S, targets, lambda peers: renew(epoch, peers), locks=False)

    def repeated(self, epoch: str) -> None:
        """Note that another peer published the stop of this epoch just now."""
        missing = self._missing.get((epoch, True))
        if missing is not None:
            missing.due = time.monotonic() + AGAIN_S + self._delay_s

    def overtaken(self) -> None:
        """Repeat no resume to older peers in reach, because another stop followed."""
        for missing in list(self._missing.values()):
            self._told(missing)

    def relayed(self, epoch: str) -> None:
        """Note that another peer published the resume of this epoch again just now."""
        missing = self._missing.get((epoch, False))
        if missing is not None:
            self._told(missing)

    @staticmethod
    def _told(missing: _Missing) -> None:
        """Repeat a resume to no peer of a 0.5 release that was in reach of it."""
        if not missing.locks:
            for peer in missing.pending.keys() - missing.absent:
                missing.pending[peer] = max(missing.pending[peer], OLDER_TRIES)

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
                missed = {*back} - ({*self._context.registry.older()} - missing.absent)
                if missed:
                    logger.warning(
                        "%s missed the %s of %s: it is published again.",
                        ", ".join(sorted(missed)),
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
        older = self._context.registry.older()
        passed = self._context.monotonic() - missing.since
        for peer, tries in list(missing.pending.items()):
            row = self._context.registry.get(peer)
            if row is None or not row["reachable"] or row["age"] > passed - SETTLE_S:
                continue
            asks = missing.locks and peer not in older
            unsure = not missing.locks and peer in older and tries < OLDER_TRIES
            if asks or tries >= TRIES_MAX or (not unsure and self._reached(row, missing, keys)):
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


class Closings:
    """Publishes the closing envelopes of e-stops late, in the background.

    Such a peer locks on that envelope alone. One whose ``status`` says that it is not locked is named.

    Args:
        name: of the threads.
        status: asks a peer for its status; returns the result, or None.
    """

    def __init__(self, name: str, status: Callable[[str], object]) -> None:
        self._name = name
        self._status = status
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def begin(self, publish: Callable[[], None], peers: Iterable[str]) -> None:
        """Publish, which waits for its turn, then ask the peers; return at once."""

        def run() -> None:
            publish()
            for peer in peers:
                result = None if self._over.is_set() else self._status(peer)
                if isinstance(result, Mapping) and result.get("locked") is False:
                    logger.critical("%s is NOT LOCKED after the emergency stop: it may be started again.", peer)

        thread = threading.Thread(target=run, name=self._name, daemon=True)
        self._threads = [each for each in self._threads if each.is_alive()] + [thread]
        thread.start()

    def close(self, timeout: float) -> None:
        """Wait for envelopes that are not out yet, at most ``timeout`` seconds."""
        self._over.set()
        deadline = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
