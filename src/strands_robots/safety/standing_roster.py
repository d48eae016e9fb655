"""Answer of a standing controller to a stop of another one: whom it misses."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.errors import StrandsRobotsError
from strands_robots.rate_limits import EventBudget
from strands_robots.safety import ed25519
from strands_robots.safety.answers import ANSWERS_MAX, Answers, Received
from strands_robots.safety.estop_listener import FAILURES_IN_ALL_PER_S, FAILURES_PER_S
from strands_robots.safety.identity import SigningIdentity, console_key
from strands_robots.safety.orders import StopRules, params_of, stated_epoch
from strands_robots.safety.roster import Roster, report_fields
from strands_robots.safety.scope import EVERY_ROBOT, SCOPE, Scope
from strands_robots.safety.sightings import Known, RosterRow
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_link import ESTOP
from strands_robots.stop_log import stop_logger
from strands_robots.threads import WokenThread

logger = stop_logger(__name__)

REPORT_AT_S = (0.12, 0.4, 0.8, 1.5)
"""Seconds from a stop's receipt to the reports on it; one that says what the last one said is not sent."""

SPREAD_S = 0.06
"""Longest random delay of a report, so that many controllers do not send at once."""

SOURCES_MAX = 16
"""Controllers of which a stop is followed at a time, one of each. Half of the places are for those whose signature is
valid, or that the roster knows; a new stop takes the place of any."""

PENDING_MAX = 64
STOP_MAX_BYTES = 16 * 2**10
"""A stop that is longer stops robots, and is not followed."""

PAUSE_S = 0.02
VERDICT_MAX_BYTES = 8 * 2**10
VERDICTS_MAX_BYTES = 4 * 2**20
"""Answers of robots that are kept while a stop is followed, in all."""

EACH_MAX = 4

Unanswered = Callable[[str, Mapping[str, RosterRow]], Collection[str]]
"""Returns those of the rows that are not known to have received the stop of this id."""

ReadStop = Callable[[str, bytes], tuple[str, Mapping[str, Any]]]

Publish = Callable[[Mapping[str, Any]], object]
"""Sends the fields of a report under the controller's name."""


@dataclass(eq=False)
class _Followed:
    """A stop of another controller."""

    estop_id: str
    due: list[float]
    scope: Scope = EVERY_ROBOT
    known: bool = False
    last: Mapping[str, Any] = field(default_factory=dict)


class StandingRoster:
    """Follows the stops of others and reports the robots that did not answer.

    Nothing is parsed, verified or read from the disk on the thread of the link. Stops count as they do for a robot of
    this machine: where ``DEVICE_CONNECT_ESTOP_PUBLIC_KEYS`` is set, only those that one of these keys signed.

    Args:
        source: the controller's name.
        publish: sends a report.
        roster: reads the roster of the network.
        keys: reads the enrolled public keys by robot.
        identity: signs the reports; None where there is no key.
        also: names that the controller shows besides.
        read: returns the source and the fields of a stop, from what the topic names and the message.
        unanswered: where the answers of robots are not for all to hear; by default they are.
    """

    def __init__(
        self,
        source: str,
        publish: Publish,
        *,
        roster: Callable[[], Roster],
        keys: Callable[[], Mapping[str, bytes]],
        identity: Callable[[], SigningIdentity | None],
        also: Callable[[], Collection[str]] = tuple,
        read: ReadStop = lambda source, payload: (source, params_of(payload)),
        unanswered: Unanswered | None = None,
    ) -> None:
        self._source, self._publish = source, publish
        self._roster, self._keys, self._identity, self._also = roster, keys, identity, also
        self._read, self._unanswered = read, unanswered
        self._pending: dict[str, bytes] = {}
        self._answers: dict[str, tuple[bytes, ...]] = {}
        self._bytes = 0
        self._followed: dict[str, _Followed] = {}
        self._done: dict[tuple[str, Scope], None] = {}
        self._worker = WokenThread("standing roster", self._step, self._due_in)
        self._rules = StopRules(allow=())
        self._failures = EventBudget(FAILURES_PER_S, FAILURES_IN_ALL_PER_S)
        self._signers_failures = EventBudget(FAILURES_PER_S, FAILURES_IN_ALL_PER_S)
        self._signers: dict[str, None] = {}
        self._names: frozenset[str] = frozenset()

    def hear(self, event: str, source: str, payload: bytes | int) -> None:
        """Take a stop of another controller, or a robot's answer; returns at once."""
        if isinstance(payload, int) or len(payload) > STOP_MAX_BYTES or source == self._source:
            return
        if event == ESTOP:
            pending = self._pending
            if source in pending or len(pending) < PENDING_MAX or random.random() < 0.5:
                if source not in pending and len(pending) >= PENDING_MAX:
                    # Any of them: the names of a flood do not keep the true one out.
                    pending.pop(random.choice(tuple(pending)), None)
                pending[source] = payload
            self._worker.wake()
        elif (self._pending or self._followed) and len(payload) <= VERDICT_MAX_BYTES:
            kept = self._answers.get(source, ())
            if (kept or len(self._answers) < ANSWERS_MAX) and self._bytes + len(payload) <= VERDICTS_MAX_BYTES:
                self._bytes += len(payload)
                self._answers[source] = (*kept, payload)[-EACH_MAX:]

    def close(self) -> None:
        """End the thread."""
        self._worker.close()

    def _due_in(self) -> float:
        due = min((each.due[0] for each in self._followed.values()), default=math.inf)
        return due - time.monotonic()

    def _step(self) -> None:
        try:
            self._take_stops()
            self._report_due()
        except Exception:
            # Whatever a message or a disk does, the next stop is followed again.
            logger.critical("The stops of other controllers are not followed.", exc_info=True)
            self._followed.clear()
        # Repetitions of a stop come every few milliseconds.
        time.sleep(PAUSE_S)

    def _take_stops(self) -> None:
        pending, self._pending = self._pending, {}
        now = time.monotonic()
        for sender, payload in list(pending.items()):
            source, params = self._read(sender, payload)
            if source == self._source:
                continue
            estop_id = stated_epoch(source, params)
            last = self._followed.get(source)
            # A stop of some robots may be widened to one of all, under its id.
            if not estop_id or (estop_id, Scope.read(params.get(SCOPE))) in self._done:
                continue
            # What strangers send uses up nothing of those that signed before.
            budget = self._signers_failures if source in self._signers else self._failures
            if self._rules.signed and not budget.allows(source, now):
                continue
            if self._rules.signature_refusal(source, params, Purpose.EMERGENCY_STOP) is not None:
                budget.count(source, now)
                continue
            scope = self._rules.scope(source, params) if SCOPE in params else EVERY_ROBOT
            mark = (estop_id, scope)
            if mark in self._done or (last is not None and (last.estop_id, last.scope) == mark):
                budget.count(source, now)  # replayed with another scope
                continue
            if self._rules.signed:
                self._signers[source] = None
                while len(self._signers) > PENDING_MAX:
                    del self._signers[next(iter(self._signers))]
            known = self._rules.signed or source in self._names
            if last is None:
                self._make_place(known)
            self._note_done(mark)
            spread = random.random() * SPREAD_S
            self._followed[source] = _Followed(estop_id, [now + at + spread for at in REPORT_AT_S], scope, known)

    def _make_place(self, known: bool) -> None:
        """Give up a stop at random where no place is left."""
        strangers = [source for source, each in self._followed.items() if not each.known]
        full = len(self._followed) >= SOURCES_MAX or (not known and len(strangers) >= SOURCES_MAX // 2)
        if full:
            lost = self._followed.pop(random.choice(strangers or tuple(self._followed)))
            # It is repeated, and followed again.
            self._done.pop((lost.estop_id, lost.scope), None)

    def _note_done(self, mark: tuple[str, Scope]) -> None:
        self._done[mark] = None
        while len(self._done) > 4 * SOURCES_MAX:
            del self._done[next(iter(self._done))]

    def _report_due(self) -> None:
        now = time.monotonic()
        due = [source for source, each in self._followed.items() if each.due[0] <= now]
        if not due:
            return
        roster, keys, identity = self._roster(), self._keys(), self._identity()
        self._names = frozenset(row.name for row in roster.rows if row.known is not Known.HEARD)
        for source in due:
            followed = self._followed[source]
            while followed.due and followed.due[0] <= now:
                followed.due.pop(0)
            fields = report_fields(followed.estop_id, self._missing(followed, roster, keys))
            # A controller that missed robots says when it misses none any more.
            if fields != followed.last and (fields["missing"] or followed.last):
                followed.last = fields
                self._publish(signed(identity, Purpose.STOP_ROSTER, self._source, fields))
            if not followed.due:
                del self._followed[source]
        if not self._followed:
            self._answers, self._bytes = {}, 0

    def _missing(self, followed: _Followed, roster: Roster, keys: Mapping[str, bytes]) -> list[RosterRow]:
        rows = {row.name: row for row in roster.rows if row.stoppable is not False or roster.counts(row)}
        marked = {row.name for row in roster.exempt}
        rows |= {name: RosterRow(name, Known.HEARD) for name in self._also() if name not in rows and name not in marked}
        scope = followed.scope
        rows = {name: row for name, row in rows.items() if row.within(scope, row.last_cell)}
        if self._unanswered is not None:
            return [rows[name] for name in self._unanswered(followed.estop_id, rows)]
        graded = Answers(keys, required=False, pressed_at=0.0)
        for name in rows:
            for payload in self._answers.get(name, ()):
                params = params_of(payload)
                if params.get("estop_id") == followed.estop_id:
                    graded.take(name, Received(params, 0.0, 0.0))
        return [rows[name] for name in graded.unsettled(rows)]


def controllers_identity(source: str, signing_key: Any) -> SigningIdentity | None:
    """Return the key of a controller's reports: its e-stop key, else the console's."""
    if signing_key is not None:
        return SigningIdentity(source, ed25519.public_half(signing_key), signing_key)
    try:
        return console_key().load_or_make()
    except (StrandsRobotsError, OSError) as exc:
        logger.error("The reports of %s leave here without a signature: %s", source, exc)  # noqa: TRY400 - one sentence
        return None
