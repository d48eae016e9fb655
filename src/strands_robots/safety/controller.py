"""Safety controller: a stop, repeated until each expected robot has answered.

:class:`SafetyController` owns a link that carries stops, check-ins and verdicts and nothing else, so that no call
and no telemetry of its process stands before a stop.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from strands_robots.audit import log_witness
from strands_robots.rate_limits import EventBudget
from strands_robots.safety import ed25519
from strands_robots.safety.answers import (
    ANSWERS_MAX,
    Answers,
    OnProgress,
    Press,
    Presses,
    Progress,
    Received,
    StopReport,
)
from strands_robots.safety.checkin import HEADS_PER_S, HeadWitness
from strands_robots.safety.identity import (
    KeyFileError,
    SigningIdentity,
)
from strands_robots.safety.missed_stops import MissedStops, MissedStopsPort
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import (
    REASON_MAX,
    answered_field,
    new_epoch,
    params_of,
    signed_stop,
)
from strands_robots.safety.persistence import ORIGINAL_MAX_BYTES, STOPS_MAX, Original, Originals
from strands_robots.safety.process import shorten_time_slices
from strands_robots.safety.roster import OnReport, RosterInbox, Sending
from strands_robots.safety.scope import (
    EVERY_ROBOT,
    WIDEN_S,
    KnownRobots,
    Remembers,
    Scope,
    none_known,
    report_widened,
)
from strands_robots.safety.statements import Proof, Purpose, proof_of
from strands_robots.safety.stop_link import (
    ANSWER,
    CHECK_IN,
    CHECK_IN_ANSWER,
    ESTOP,
    QUESTION,
    STOP_ROSTER,
    VERDICT,
    OnEvent,
    RenewableLink,
    ReportingLink,
    StopLink,
    notification,
)
from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, device_id, duration, number, shown

logger = stop_logger(__name__)

REPEAT_S = (0.005, 0.005, 0.01, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Pauses between repetitions; the last one goes on. Quick at first, for what is lost at once."""

REPEAT_SIGNED_S = (0.005, 0.005, *[0.01] * 19, *[0.02] * 15, 0.05, 0.1, 0.2)
"""Pauses of a signed stop: every 10 to 20 ms in its first half second. Robots check signatures one by one, so that of
many forged stops in the controller's name and the true ones only a share is served."""

REPEAT_EACH_S = 0.00005
"""Pause for each robot that has to answer, where that is longer: hundreds of halts are under way meanwhile."""

REPEAT_EACH_MAX_S = 0.05
REPEAT_EACH_SIGNED_MAX_S = 0.02
"""The longest pause by number, unsigned and signed, however many robots are said to exist."""

UNCONFIRMED_S = 0.1
RENEW_S = 6.0
"""A stop, or one after another, that someone expected left unanswered for so long makes the connection anew."""

SETTLE_S = 1.0
"""A stop goes on for at least so long before it has the connection made anew."""

DEADLINE_S = 3.0
INBOX_PER_ROBOT = 16
"""Answers of one robot that wait to be graded; a robot answers again at each repetition."""


class SafetyController:
    """Sender of emergency stops and check-ins that collects the answers.

    Args:
        controller_id: the source that robots see; their allowlist must admit it.
        make_link: gives the connection of its own.
        signing_key: Ed25519 private key, for fleets that ask for signed stops.
        on_link: called at once when the link is lost or back.
        enrolled: gives the public keys of robots, read when this is made and once each stop has left.
        require_signed: count a robot that is not enrolled as *claimed* only.
        stands: receive the stops of other controllers, too, for :meth:`hear_others`.
        network: of its stops, whose roster must answer them; None where that is not known.
        remembers: says whether this machine knows a robot in a scope; asked on a thread once such a stop has left.
    """

    def __init__(
        self,
        controller_id: str,
        make_link: Callable[[], StopLink],
        *,
        signing_key: Any = None,
        on_link: Callable[[bool], None] = lambda up: None,
        enrolled: Callable[[], Mapping[str, bytes]] = dict,
        require_signed: bool = False,
        stands: bool = False,
        network: NetworkKey | None = None,
        remembers: Remembers = none_known,
    ) -> None:
        self.controller_id, self.network = device_id("controller_id", controller_id), network
        self._key = signing_key
        self._enrolled, self._require_signed = enrolled, require_signed
        self._remembers = remembers
        self._keys: Mapping[str, bytes] = {}
        self._load_keys()
        self._on_link = on_link
        self._changed = threading.Condition()
        self._stops: dict[str, _Running] = {}
        self._ended: _Running | None = None
        self._presses = Presses()
        self._closing = threading.Event()
        self._check_in: threading.Thread | None = None
        self._unanswered_s = 0.0
        self._witness, self._heads = HeadWitness(always=True), EventBudget(HEADS_PER_S)
        self._reports = RosterInbox()
        self._others: OnEvent | None = None
        self._link, self._linked = make_link(), False
        self._end_short_slices = shorten_time_slices()
        self._sent = ControllerPort(self.controller_id, signing_key, lambda: self._keys, self._publish)
        self._missed = MissedStops(self._sent)
        events = (VERDICT, CHECK_IN_ANSWER, QUESTION, ANSWER, STOP_ROSTER, *((ESTOP,) if stands else ()))
        self._link.open(events, self._receive, self._link_changed)

    @property
    def link_up(self) -> bool:
        """True while the link reaches a peer."""
        return self._link.up

    @property
    def sending(self) -> Sending:
        """The way its stops leave: signed or not, and the broker's refusal."""
        tells = isinstance(self._link, ReportingLink)
        denied = self._link.denied if isinstance(self._link, ReportingLink) else ""
        return Sending(signed=self._key is not None, denied=denied, tells=tells)

    @property
    def signing_key(self) -> Any:
        """The key that signs its stops, or None."""
        return self._key

    def hear_others(self, hear: OnEvent) -> None:
        """Give the stops of others, and the answers of robots, to ``hear``.

        It is called on a thread of the link: it returns at once, parses nothing and may not raise.
        """
        self._others = hear

    def publish(self, event: str, payload: bytes) -> bool:
        """Send an event under this controller's name; False when the link is down."""
        return self._link.publish(self.controller_id, event, payload)

    def wait_link(self, timeout: float) -> bool:
        """True when the link is up within ``timeout`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self._link.up, timeout)

    def stop(
        self,
        expected: Collection[str] = (),
        reason: str = "",
        *,
        deadline_s: float = DEADLINE_S,
        estop_id: str = "",
        more: bool = False,
        on_progress: OnProgress = lambda progress: None,
        on_report: OnReport = lambda report: None,
        scope: Scope = EVERY_ROBOT,
    ) -> StopReport:
        """Stop every robot of the tenant, or those of ``scope``; wait for answers.

        The stop is sent at once and again until each ``expected`` robot has answered or ``deadline_s`` is over; while
        the link is down it waits for it and is sent in the moment it is back. Without ``expected`` it is repeated to
        the deadline, and every robot that answers is in the report.

        A stop for some robots of which none has answered ``WIDEN_S`` after it left, and none is known here, becomes a
        stop of every robot: a name may be mistyped.

        Args:
            expected: ids of the robots that must answer.
            reason: for the robots and their logs, at most 200 characters.
            deadline_s: seconds until silence is reported as silence.
            estop_id: 32 hex digits; a fresh one by default.
            more: :meth:`expect` will name further robots, so the stop goes on until then.
            on_progress: called at each answer, when the link changes, and once 100 ms have passed.
            on_report: called with what standing controllers say they miss, on a thread of its own.
            scope: the robots that it is for; those that read no scope stop all the same.
        """
        duration("deadline_s", deadline_s)
        if isinstance(expected, str):
            raise ValidationError(f"expected must be a collection of robot ids, not the text {expected!r}.")
        estop_id = estop_id or new_epoch()
        press = self.press(estop_id)
        run = _Running(
            estop_id, frozenset(expected) | scope.only, time.monotonic(), press, reason[:REASON_MAX], scope, more=more
        )
        with self._changed:
            self._stops[run.estop_id] = run
        try:
            # The first one is sent before anything else is done.
            self._send(run)
            self._reports.open(run.estop_id, on_report)
            if not scope.everything:
                run.known = KnownRobots(scope, self._remembers)
            self._load_keys()
            run.graded = Answers(self._keys, required=self._require_signed, pressed_at=press.wall)
            self._repeat(run, deadline_s, on_progress)
        finally:
            with self._changed:
                del self._stops[run.estop_id]
                self._ended = run
            self._reports.close(run.estop_id)
            if run.complete:
                self._sent.answered(run.estop_id)
        return self._report(run)

    def review(self, report: StopReport) -> StopReport:
        """Return ``report`` of the latest stop with the answers since, else as it is.

        A robot corrects its answer when it finds later that it did not stop.
        """
        with self._changed:
            run = self._ended
            if run is None or run.estop_id != report.estop_id or not run.inbox:
                return report
            inbox, run.inbox = run.inbox, {}
        known = run.changes
        run.grade(inbox)
        return report if run.changes == known else replace(self._report(run), elapsed_ms=report.elapsed_ms)

    def press(self, estop_id: str) -> Press:
        """Record the press of a stop, once; every later call gives the same moment.

        ``stop`` does so by itself. A caller that waits between the press and ``stop`` calls this first.
        """
        return self._presses.note(estop_id)

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer ``estop_id``; False when it is over.

        Args:
            more: further ones will be named, so the stop goes on until then.
        """
        with self._changed:
            run = self._stops.get(estop_id)
            if run is not None:
                run.expected |= frozenset(names)
                run.more = more
                self._changed.notify_all()
        return run is not None

    def check_in_every(self, interval_s: float) -> None:
        """Check in with the robots that need a live controller, from now until ``close``."""
        number("interval_s", interval_s, low=0.02, high=60)
        if self._check_in is None:
            self._check_in = threading.Thread(
                target=self._check_in_loop, args=(interval_s,), name="check-in", daemon=True
            )
            self._check_in.start()

    def check_in(self) -> bool:
        """Check in once; False when the link is down."""
        payload = self._signed(CHECK_IN, Purpose.CHECK_IN, {"estop_id": new_epoch()})
        return self._link.publish(self.controller_id, CHECK_IN, payload)

    def close(self) -> None:
        """Stop checking in and close the link. Safe to call twice."""
        self._closing.set()
        if self._check_in is not None:
            self._check_in.join(2.0)
        self._link.close()
        self._reports.end()
        self._missed.close()
        self._end_short_slices()

    def _send(self, run: _Running) -> None:
        """Send the stop, issued now and pressed at its press."""
        fields: dict[str, Any] = {"estop_id": run.estop_id, "reason": run.reason, "pressed_at": run.press.wall}
        fields |= {} if run.widened else run.scope.field()
        # Expected ones first: a flood of answers in invented names crowds none of them out.
        fields |= answered_field(sorted(run.graded.final(), key=lambda name: name not in run.expected))
        payload, now = self._signed(ESTOP, Purpose.EMERGENCY_STOP, fields), time.monotonic()
        if self._link.publish(self.controller_id, ESTOP, payload) and run.left is None:
            run.left = now
        if run.sent != run.widened:
            run.sent = run.widened
            self._sent.sent(run.estop_id, payload)

    def _repeat(self, run: _Running, deadline_s: float, on_progress: OnProgress) -> None:
        quick_first = REPEAT_S if self._key is None else REPEAT_SIGNED_S
        pauses, reported = iter(quick_first), -1
        longest_s = REPEAT_EACH_MAX_S if self._key is None else REPEAT_EACH_SIGNED_MAX_S
        pause, next_send, again = 0.0, run.started, 0
        renew_at = run.started + max(SETTLE_S, RENEW_S - self._unanswered_s)
        while True:
            with self._changed:
                inbox, run.inbox = run.inbox, {}
            run.grade(inbox)
            now = time.monotonic()
            late = now - run.started >= UNCONFIRMED_S
            with self._changed:
                ends_at = run.ends_at(deadline_s)
                finished = (run.complete and run.scope_is_sure(now)) or now >= ends_at
                if run.widens_at <= now and not run.settled_scope:
                    run.widened, run.widened_at = True, now
                    report_widened(run.estop_id, run.scope)
                    pauses, next_send, finished = iter(quick_first), 0.0, False
                state = hash((run.changes, len(run.expected), late, run.widened, self._link.up))
            if state != reported or finished:
                reported = state
                on_progress(run.progress(self._link.up, now))
            if finished:
                self._unanswered_s = self._unanswered_s + now - run.started if run.unanswered else 0.0
                return
            if now >= renew_at and run.unanswered and self._link.up:
                renew_at, self._unanswered_s = now + RENEW_S, run.started - now
                if isinstance(self._link, RenewableLink):
                    self._link.renew()
            if now >= next_send:
                if again or run.left is None:
                    self._send(run)
                again += 1
                pause = next(pauses, pause)
                next_send = now + max(pause, min(REPEAT_EACH_S * len(run.expected), longest_s))
            marks = [next_send, ends_at, *([] if late else [run.started + UNCONFIRMED_S])]
            marks += [at for at in (run.widens_at, run.widened_at + WIDEN_S) if at > now]
            with self._changed:
                seen = (self._link.up, len(run.expected), run.more)
                self._changed.wait_for(
                    lambda seen=seen: run.inbox or seen != (self._link.up, len(run.expected), run.more),  # type: ignore[misc]
                    max(0.0, min(marks) - time.monotonic()),
                )
                if self._link.up and not seen[0]:
                    # Back on the network: now, not at the next turn.
                    next_send = 0.0

    def _load_keys(self) -> None:
        try:
            self._keys = self._enrolled()
        except (KeyFileError, OSError) as exc:
            # Nothing can be proven: every answer is a claim, and the stop goes out all the same.
            self._require_signed, self._keys = True, {}
            logger.critical("The enrolled keys cannot be used, so no answer counts as a robot's own: %s", exc)

    def _report(self, run: _Running) -> StopReport:
        answers, alarms = dict(run.graded.by_robot), dict(run.graded.alarms)
        refused = {name: each for name, each in answers.items() if each.refused}
        report = StopReport(
            run.estop_id,
            {name: each for name, each in answers.items() if each.stopped is True and not each.claimed},
            {name: each for name, each in answers.items() if each.stopped is not True and name not in refused},
            refused,
            tuple(sorted(run.expected - answers.keys() - alarms.keys())),
            run.left is not None,
            run.since_press_ms(time.monotonic()),
            run.left_ms,
            {name: each for name, each in answers.items() if each.stopped is True and each.claimed},
            alarms,
            run.scope,
            run.widened,
        )
        for name, each in {**report.not_stopped, **refused}.items():
            logger.critical("%s DID NOT STOP: %s", name, each.why or each.facts)
        for name, why in alarms.items():
            logger.critical("ALARM: %s: %s.", name, why)
        if report.claimed:
            logger.critical("CLAIMED, and not signed by the robot: %s", ", ".join(report.claimed))
        if report.silent:
            logger.critical("NO ANSWER to emergency stop %s from: %s", run.estop_id, ", ".join(report.silent))
        if not report.link:
            logger.critical("Emergency stop %s never left: the link of %s is down.", run.estop_id, self.controller_id)
        for name, each in answers.items():
            signed = each.proof is Proof.SIGNED
            # A flood in invented names must not fill the audit.
            if signed or name in run.expected:
                log_witness(self.controller_id, name, each.facts.get("audit"), signed=signed)
        return report

    def _receive(self, event: str, source: str, payload: bytes | int) -> None:
        at, wall = time.monotonic(), time.time()
        if event == STOP_ROSTER:
            self._reports.put(source, payload)
            return
        if self._others is not None and event in (ESTOP, VERDICT) and source != self.controller_id:
            self._others(event, source, payload)
        if event in (QUESTION, ANSWER):
            self._missed.receive(event, source, payload)
            return
        if event == ESTOP:
            return
        params = params_of(payload)
        if "estop_id" not in params:
            logger.warning("An answer of %s is not to be read; it counts as none.", shown(source))
            return
        estop_id = params["estop_id"]
        if event == CHECK_IN_ANSWER:
            self._witness_head(source, params)
            return
        with self._changed:
            run, ended = self._stops.get(estop_id) if isinstance(estop_id, str) else None, self._ended
            if run is None and ended is not None and ended.estop_id == estop_id and ended.knows(source):
                run = ended
            if run is not None:
                run.receive(source, Received(params, run.since_press_ms(at), wall))
                self._changed.notify_all()

    def _witness_head(self, source: str, params: Any) -> None:
        """Write down the head in an answer to a check-in; a flood is left out."""
        if not isinstance(params, dict) or not self._heads.take("", time.monotonic()):
            return
        proof = proof_of(Purpose.CHECK_IN_ANSWER, source, params, self._keys.get(source))
        if proof is not Proof.WRONG:
            self._witness.receive(source, params, by=self.controller_id, proven=proof is Proof.SIGNED)

    def _link_changed(self, up: bool) -> None:
        with self._changed:
            self._changed.notify_all()
            changed, self._linked = up != self._linked, up
        if changed:
            self._on_link(up)

    def _check_in_loop(self, interval_s: float) -> None:
        due = time.monotonic()
        while not self._closing.wait(max(0.0, due - time.monotonic())):
            due = max(due + interval_s, time.monotonic())
            self.check_in()

    def _publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        return self._link.publish(source, event, notification(event, fields))

    def _signed(self, event: str, purpose: Purpose, params: Mapping[str, Any]) -> bytes:
        stated: dict[str, Any] = {**params, "purpose": purpose, "t": time.time(), "nonce": secrets.token_hex(16)}
        if self._key is not None:
            stated = signed_stop(self._key, purpose, self.controller_id, stated)
        return notification(event, stated)


@dataclass(eq=False)
class _Running:
    estop_id: str
    expected: frozenset[str]
    started: float
    press: Press
    reason: str
    scope: Scope = EVERY_ROBOT
    known: KnownRobots | None = None
    widened: bool = False
    widened_at: float = float("-inf")
    inbox: dict[str, deque[Received]] = field(default_factory=dict)
    graded: Answers = field(default_factory=lambda: Answers({}, required=True, pressed_at=0.0))
    left: float | None = None
    sent: bool | None = None
    changes: int = 0
    more: bool = False

    def receive(self, source: str, received: Received) -> None:
        """Take a verdict; a flood in a robot's name pushes out only that robot's own."""
        if source in self.inbox or len(self.inbox) < ANSWERS_MAX:
            self.inbox.setdefault(source, deque(maxlen=INBOX_PER_ROBOT)).append(received)

    def knows(self, source: str) -> bool:
        """Return True for a robot that is expected or has answered."""
        return source in self.expected or source in self.graded.by_robot

    def grade(self, inbox: Mapping[str, Iterable[Received]]) -> None:
        """Grade what was received, on the thread of the stop."""
        for source, received in inbox.items():
            if self.knows(source) or len(self.graded.by_robot) < ANSWERS_MAX:
                self.changes += sum(self.graded.take(source, each) for each in received)

    @property
    def widens_at(self) -> float:
        """Monotonic s at which it widens, unless a robot in its scope answers."""
        if self.left is None or self.scope.everything or self.widened:
            return float("inf")
        return self.left + (WIDEN_S if self.known is None else self.known.widens_after_s)

    @property
    def settled_scope(self) -> bool:
        """A robot in the scope has answered.

        Where robots are enrolled, only a signed answer shows that one is there: anyone can claim a name or a cell.
        """
        return any(
            self.scope.names(name, each.facts.get("cell")) and self.graded.shows(each)
            for name, each in self.graded.by_robot.items()
        )

    def scope_is_sure(self, now: float) -> bool:
        """Return True once it will not widen, or was repeated as a stop of every robot."""
        return (self.widens_at == float("inf") or self.settled_scope) and now >= self.widened_at + WIDEN_S

    def ends_at(self, deadline_s: float) -> float:
        """Return the monotonic s of its deadline, with time to widen once it has left."""
        widens_at = self.widened_at if self.widened else self.widens_at
        return max(self.started + deadline_s, widens_at + WIDEN_S if widens_at < float("inf") else 0.0)

    @property
    def complete(self) -> bool:
        return bool(self.expected) and not self.more and not self.graded.unsettled(self.expected)

    @property
    def unanswered(self) -> bool:
        """An expected robot, or every robot, has not answered yet."""
        return not self.graded.settled() or bool(self.graded.unsettled(self.expected))

    @property
    def left_ms(self) -> float:
        """Milliseconds from the press to the first sending that left; 0 while none did."""
        return 0.0 if self.left is None else self.since_press_ms(self.left)

    def since_press_ms(self, now: float) -> float:
        """Milliseconds from the press to ``now``."""
        return (now - self.press.at) * 1000

    def progress(self, link_up: bool, now: float) -> Progress:
        late = now - self.started >= UNCONFIRMED_S
        open_ = self.graded.unsettled(self.expected) if late or not link_up else ()
        elapsed_ms = self.since_press_ms(now)
        answers, alarms = dict(self.graded.by_robot), dict(self.graded.alarms)
        return Progress(
            self.estop_id, answers, open_, link_up, elapsed_ms, self.left_ms, alarms, self.scope, self.widened
        )


class ControllerPort(MissedStopsPort):
    """A safety controller, which answers with the stops that it sent.

    A stop is told until each robot that must answer it has; one without such robots for as long as there is the
    controller.

    Args:
        key: the private key that signs its stops, if any.
        enrolled: returns the public keys of robots by name.
    """

    def __init__(
        self,
        name: str,
        key: Any,
        enrolled: Callable[[], Mapping[str, bytes]],
        publish: Callable[[str, str, Mapping[str, Any]], bool],
    ) -> None:
        self._name, self._enrolled, self._publish = name, enrolled, publish
        self._identity = None if key is None else SigningIdentity(name, ed25519.public_half(key), key)
        self._originals = Originals()
        self._open: dict[str, None] = {}

    def sent(self, estop_id: str, payload: bytes) -> None:
        """Note a stop that leaves; return at once."""
        if len(payload) <= ORIGINAL_MAX_BYTES:
            self._open[estop_id] = None
            self._originals.add(Original(estop_id, self._name, payload, "", uptime()))
            while len(self._open) > STOPS_MAX:
                self._open.pop(next(iter(self._open)), None)

    def answered(self, estop_id: str) -> None:
        """Note that every robot that must answer this stop has."""
        self._open.pop(estop_id, None)

    def publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        return self._publish(event, source, fields)

    def signer(self) -> tuple[str, SigningIdentity | None]:
        return self._name, self._identity

    def originals(self) -> Sequence[Original]:
        epochs = frozenset(tuple(self._open))
        self._originals.keep(epochs)
        return self._originals.of(epochs)

    def knows_key(self, source: str, key: bytes) -> bool:
        own = self._identity is not None and self._identity.public == key
        return own or self._enrolled().get(source) == key

    def hold(self, seconds: float) -> None:
        """It moves nothing."""
