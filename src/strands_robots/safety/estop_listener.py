"""E-stop listener: one thread that turns emergency stops into halts.

It lives from the first registered device to the last, and shares no event loop, queue, lock, executor or session with
the data plane. A link's thread hands an event to the listener's thread; that one locks every robot and submits each to
the stop executor: two hand-offs.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from strands_robots.audit import audit_head, own_log_id, queue_safety_event
from strands_robots.rate_limits import EventBudget
from strands_robots.safety.checkin import HEADS_PER_S, CheckInAnswers, CheckInRules, HeadWitness
from strands_robots.safety.identity import (
    DEFAULT_TENANT,
    KnownKeys,
    SigningIdentity,
)
from strands_robots.safety.missed_stops import MissedStops, MissedStopsPort
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import (
    LISTENER,
    MISSED,
    PARSED_MAX_BYTES,
    RobotReport,
    StopOrder,
    StopRefused,
    StopRules,
)
from strands_robots.safety.persistence import Original
from strands_robots.safety.plane import SafetyPlane, plane
from strands_robots.safety.process import AWAKE, shorten_time_slices
from strands_robots.safety.sighting_file import own_run
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_link import (
    ANSWER,
    CHECK_IN,
    CHECK_IN_ANSWER,
    ESTOP,
    EVENTS,
    JSON_RPC,
    QUESTION,
    VERDICT,
    FairQueue,
    StopCodec,
    StopEvent,
    StopLink,
    notification,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)

ANSWER_AGAIN_S = 0.01
"""Seconds between two answers of a robot to the same stop."""

ANSWER_AGAIN_EACH_S = 0.002
"""The same, for each robot of the process, where that is longer: a stop repeated to hundreds is no flood of answers."""

ANSWER_AGAIN_MAX_S = 0.25

REFUSAL_INTERVAL_S = 10.0
"""Seconds in which the refusals of one source are recorded once, and the others counted."""

REMEMBERED_MAX = 256

FAILURES_PER_S, FAILURES_IN_ALL_PER_S = 20, 100
"""Failed signature checks of a source, and of all, in a second."""

REFUSED_PAUSE_S = 0.0005
"""Seconds that the listener rests after a refused stop of a source that has not signed validly."""

LATCH_ANSWERS_PER_S = 200
LATCH_ANSWERS_REMEMBERED = 4096


class LatchAnswers:
    """Budget of answers to stops beyond those that a robot tells apart.

    Any such stop is answered while fewer than ``per_s`` were in this second. Beyond that, one that comes again is: a
    controller repeats its stop until it is answered, and a flood of fresh ids does not.
    """

    def __init__(self, per_s: int = LATCH_ANSWERS_PER_S) -> None:
        self._budget = EventBudget(per_s)
        self._unanswered: dict[tuple[str, str], None] = {}

    def allows(self, robot_id: str, epoch: str, now: float) -> bool:
        """Return True when this stop is answered now, else remember it."""
        if self._budget.take("", now):
            return True
        key = (robot_id, epoch)
        if key in self._unanswered:
            return True
        self._unanswered[key] = None
        if len(self._unanswered) > LATCH_ANSWERS_REMEMBERED:
            del self._unanswered[next(iter(self._unanswered))]
        return False


@dataclass(eq=False)
class ListenerRegistration:
    """Registration of a device with the listener; the last one closes the link."""

    listener: EstopListener
    robot_id: str
    key: Hashable
    link: StopLink
    identity: Callable[[], SigningIdentity | None]
    network: NetworkKey | None
    was_here: bool
    codec: StopCodec
    asks: bool

    @property
    def name(self) -> str:
        """The name of the device on its network."""
        return self.listener.wire_id(self.robot_id)

    def open(self) -> None:
        """Open the link, unless it is open or this registration has ended."""
        self.listener.open(self)

    def close(self) -> None:
        """Unregister. Safe to call twice."""
        self.listener.unregister(self)


class RobotsPort(MissedStopsPort):
    """The robots of a process on the network of one link, which no missed stop leaves.

    Args:
        link: a registration with that link; without a network nothing is asked and answered.
        members: returns those that are served there now.
        on_report: answers a stop, as for one that came directly.
    """

    def __init__(
        self,
        of: SafetyPlane,
        rules: StopRules,
        link: ListenerRegistration,
        members: Callable[[], Sequence[ListenerRegistration]],
        on_report: Callable[[RobotReport], None],
    ) -> None:
        self._plane, self._rules, self._network = of, rules, _text(link.network)
        self._link, self._codec = link.link, link.codec
        self._members, self._on_report = members, on_report
        self._keys = KnownKeys(DEFAULT_TENANT if link.network is None else link.network.tenant, rules.keys)

    def was_here(self) -> bool:
        robots = self._plane.robots
        back = [robots.get(each.robot_id) for each in self._members() if each.was_here]
        # A state directory that was reset since is that of a newcomer.
        returned = [each.robot_id for each in back if each is not None and each.returned()]
        return bool(returned)

    def locked(self) -> bool:
        return all(each.locked for each in self._plane.robots.values())

    def devices(self) -> Sequence[str]:
        return [each.name for each in self._members() if each.asks]

    def publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        try:
            payload = self._codec.encode(event, fields)
        except ValueError:  # more than its network carries
            return False
        return self._link.publish(source, event, payload)

    def signer(self) -> tuple[str, SigningIdentity | None]:
        members = self._members()
        # A robot that is locked answers for its process.
        locked = self._plane.lockouts()
        for each in sorted(members, key=lambda each: each.robot_id not in locked)[:1]:
            return each.name, each.identity()
        return "", None

    def originals(self) -> Sequence[Original]:
        return self._plane.originals(self._network) if self._network else ()

    def learn(self, source: str, payload: bytes, age_s: float, answerer: str) -> bool:
        if not self._rules.signed and not self._rules.open:
            # Who says that an allowed source stopped is not that source.
            return False
        if self._rules.source_refusal(source) is not None:
            return False
        codec = self._codec
        fields = codec.fields(payload)
        epoch = codec.epoch(source, fields)
        if not epoch:
            return False
        if all(each.latch.knows(epoch) for each in self._plane.robots.values()):
            self._plane.stated_again(self._network, epoch, payload, age_s)
            return True
        stop = StopEvent(ESTOP, source, payload, time.monotonic(), self._network, codec)
        order = codec.order(self._rules, stop, fields, MISSED, age_s)
        if not isinstance(order, StopOrder):
            return False
        run = self._plane.begin(order, self._on_report)
        for robot_id in run.robot_ids if run is not None else ():
            logger.warning("%s is locked by emergency stop %s, which it had missed.", robot_id, epoch)
            facts = {"epoch": epoch, "source": order.source[:256], "answerer": answerer[:256], "age_s": round(age_s, 3)}
            queue_safety_event("missed_stop_learnt", robot_id, facts)
        return True

    def knows_key(self, source: str, key: bytes) -> bool:
        return self._keys.knows(source, key)

    def hold(self, seconds: float) -> None:
        self._plane.hold(seconds)


class OpenLink(NamedTuple):
    """An open link: its network, its codec, and the missed stops of its devices."""

    network: str
    codec: StopCodec
    missed: MissedStops


class _Inbox(NamedTuple):
    """Events that wait for the listener's thread, and what wakes it."""

    events: FairQueue
    woken: threading.Event


class EstopListener:
    """Receives every ``emergencyStop`` of the tenant and has the plane act on it.

    Args:
        of: the plane that stops its robots.
        rules: makes the rules by which a stop counts; they are read when the first device registers.
    """

    def __init__(self, of: SafetyPlane | None = None, rules: Callable[[], StopRules] = StopRules) -> None:
        self._plane = of or plane()
        self._make_rules = rules
        self._registering = threading.Lock()
        self._registrations: tuple[ListenerRegistration, ...] = ()
        self._open: dict[Hashable, OpenLink] = {}
        self._refusals = EventBudget(1, window_s=REFUSAL_INTERVAL_S, pooled=True)
        self._budget = EventBudget(FAILURES_PER_S, FAILURES_IN_ALL_PER_S)
        self._latch_answers = LatchAnswers()
        self._rules = StopRules(allow=(), keys=())
        self._check_ins = CheckInRules(self._rules)
        self._witness, self._check_in_answers, self._heads = HeadWitness(), CheckInAnswers(), EventBudget(HEADS_PER_S)
        self._answered: dict[tuple[str, str], float] = {}
        self._redundant: dict[tuple[str, str], None] = {}
        self._repeated: dict[Hashable, bytes] = {}
        self._inbox: _Inbox | None = None
        self._thread: threading.Thread | None = None
        self._end_short_slices: Callable[[], None] = lambda: None
        self._end_watch: Callable[[], None] = lambda: None

    @property
    def registrations(self) -> tuple[ListenerRegistration, ...]:
        """The devices that are registered now."""
        return self._registrations

    def register(
        self,
        robot_id: str,
        key: Hashable,
        make: Callable[[], StopLink],
        identity: Callable[[], SigningIdentity | None] = lambda: None,
        *,
        opened: bool = True,
        network: NetworkKey | None = None,
        was_here: bool = False,
        codec: StopCodec = JSON_RPC,
        asks: bool = True,
    ) -> ListenerRegistration:
        """Serve a robot over the link of ``key``; ``make`` the link if it is new.

        Args:
            network: of the link; missed stops are asked for and answered within it alone, and not without one.
            was_here: the robot was served from this machine in the ten minutes before.
            codec: of the link's network; that of the first device counts for the link.
            asks: False for what moves nothing, which asks for no missed stops and has no verdict to send.
            identity: returns what signs the robot's verdicts; None leaves them unsigned.
            opened: False to have a new link opened by :meth:`ListenerRegistration.open` only.
        """
        with self._registering:
            rules = self._make_rules() if self._inbox is None else self._rules
            if asks:
                rules.require_keys()  # what only sends stops needs none
            if self._inbox is None:
                self._start(rules)
            link = next((each.link for each in self._registrations if each.key == key), None)
            made = make() if link is None else link
            registration = ListenerRegistration(self, robot_id, key, made, identity, network, was_here, codec, asks)
            self._registrations = (*self._registrations, registration)
        if opened:
            registration.open()
        return registration

    def open(self, registration: ListenerRegistration) -> None:
        """Open the link of a registration, unless it is open."""
        with self._registering:
            if registration in self._registrations and registration.key in self._open:
                self._open[registration.key].missed.started()
            elif registration in self._registrations:
                missed = self._missed_stops(registration)
                link = OpenLink(_text(registration.network), registration.codec, missed)
                self._open[registration.key] = link
                receive = functools.partial(self.receive, link=link)
                try:
                    registration.link.open(EVENTS, receive, lambda up: missed.link_up() if up else missed.link_down())
                except Exception:
                    del self._open[registration.key]
                    missed.close()
                    raise

    def unregister(self, registration: ListenerRegistration) -> None:
        """Serve a device no longer; the thread ends with the last one."""
        with self._registering:
            if registration not in self._registrations:
                return
            self._registrations = tuple(each for each in self._registrations if each is not registration)
            last_of_link = all(each.key != registration.key for each in self._registrations)
            opened = self._open.pop(registration.key, None) if last_of_link else None
            inbox, thread = (None, None) if self._registrations else (self._inbox, self._thread)
            if inbox is not None:
                self._inbox = self._thread = None
        if last_of_link:
            registration.link.close()
        if opened is not None:
            opened.missed.close()
        if inbox is not None:
            self._end_watch()
            self._end_short_slices()
            inbox.woken.set()
        if thread is not None and thread is not threading.current_thread():
            thread.join(2.0)

    @property
    def signed(self) -> bool:
        """True when a stop needs a signature; else its source is what it says it is."""
        return self._rules.signed

    def awake(self) -> None:
        """Ask which stops were missed, after a time in which the process did not run."""
        for link in tuple(self._open.values()):
            link.missed.ask("the process did not run for a while")

    def accept(
        self, stop: StopEvent, path: str, fields: Mapping[str, Any] | None = None, *, only_way: bool = False
    ) -> None:
        """Act on an emergency stop of any network; return at once.

        The listener's thread calls it for what its links received. A network that receives stops over a further
        connection calls it there: a source whose signatures keep failing is not checked again on that path for up to a
        second, because its stops arrive at the listener's own link as well.

        Args:
            path: how it arrived.
            fields: of its payload, where they were read already.
            only_way: it cannot arrive at the listener's own link.
        """
        codec, source = stop.codec, stop.source
        stated = codec.fields(stop.payload) if fields is None else fields
        if self._plane.under_way(stated.get("estop_id")):
            return
        events = self._inbox.events if self._inbox is not None and path == LISTENER else None
        further = events is None and not only_way
        if further and codec.vouches(self._rules) and not self._budget.allows(source, time.monotonic()):
            return
        order = codec.order(self._rules, stop, stated, path)
        if isinstance(order, StopOrder):
            on_report = self._answer if codec.answers else _no_answer
            codec.begun(order, stated, self._plane.begin(order, on_report))
            if events is not None and codec.vouches(self._rules):
                events.vouch(source)
        elif order is not None:
            if not codec.refused(order):
                self._record_refusal(order, stop.event)
            if further:
                self._budget.count(source, time.monotonic())
            elif events is not None and not events.vouched_for(source):
                # In a flood the link's thread needs the interpreter to receive what comes behind it.
                time.sleep(REFUSED_PAUSE_S)

    def stop_here(self, order: StopOrder) -> None:
        """Act on a stop that a device of this process raises; return at once."""
        self._plane.begin(order, self._answer)

    def receive(
        self,
        event: str,
        source: str,
        payload: bytes | int,
        link: OpenLink | None = None,
    ) -> None:
        """Take an event from a link's thread; returns at once."""
        if link is not None and event in (QUESTION, ANSWER):
            link.missed.receive(event, source, payload)
            return
        network, codec = ("", JSON_RPC) if link is None else (link.network, link.codec)
        inbox = self._inbox
        if inbox is None:
            return
        events, woken = inbox
        if not isinstance(payload, int) and len(payload) > PARSED_MAX_BYTES:
            payload = len(payload)
        if event == CHECK_IN_ANSWER:
            if self._heads.take("", time.monotonic()):
                events.put(event, source, payload, urgent=False)
                woken.set()
            return
        counts = not codec.names_source or self._rules.source_refusal(source) is None
        if counts or self._refusal_due(source):
            events.put(event, source, payload, urgent=counts and event == ESTOP, network=network, codec=codec)
            # While it is set, the next look is still to come: most messages of a flood need not wake the thread.
            if not woken.is_set():
                woken.set()

    def _refusal_due(self, source: str) -> bool:
        """Return True when a refusal of this source should be recorded; else count it."""
        now = time.monotonic()
        due = self._refusals.allows(source, now)
        if not due:
            self._refusals.count(source, now)
        return due

    def _record_refusal(self, refused: StopRefused, event: str) -> None:
        """Log and audit a refusal, unless one of this source was recorded a moment ago."""
        if not self._refusal_due(refused.source):
            return
        more = self._refusals.count(refused.source, time.monotonic())
        logger.warning("%s of %s does not count: %s.", event, shown(refused.source), refused.why)
        facts = {"event": event, "source": refused.source[:256], "why": refused.why, "more_since": more}
        queue_safety_event("estop_refused", "stop-lane", facts)

    def _missed_stops(self, registration: ListenerRegistration) -> MissedStops:
        def members() -> list[ListenerRegistration]:
            there = (each for each in self._registrations if each.key == registration.key)
            return [each for each in there if each.network is not None]

        port = RobotsPort(self._plane, self._rules, registration, members, self._answer)
        return MissedStops(port, registration.codec.fields)

    def _start(self, rules: StopRules) -> None:
        self._rules = rules
        self._check_ins = CheckInRules(self._rules)
        audit_head(), own_log_id(), own_run()  # read from the disk now, so that no stop waits for it
        self._end_short_slices = shorten_time_slices()
        self._end_watch = AWAKE.watch(self.awake)
        self._inbox = _Inbox(FairQueue(), threading.Event())
        self._thread = threading.Thread(target=self._run, args=(self._inbox,), name="estop-listener", daemon=True)
        self._thread.start()

    def _run(self, inbox: _Inbox) -> None:
        events, woken = inbox
        while True:
            received = events.take()
            if received is None and self._inbox is not inbox:
                return
            if received is None:
                woken.wait()
                # What was put between the look and the clearing is found by the next look; what comes later sets it.
                woken.clear()
                continue
            try:
                if received.event == CHECK_IN_ANSWER:
                    for first in self._registrations[:1]:
                        fields = received.codec.fields(received.payload)
                        self._witness.receive(received.source, fields, by=first.robot_id)
                    continue
                if received.event == CHECK_IN:
                    if self._check_in(received) and self._rules.signed:
                        events.vouch(received.source)
                    continue
                self.accept(received, LISTENER)
            except Exception:
                logger.critical("The e-stop listener failed on an event of %s.", shown(received.source), exc_info=True)

    def _check_in(self, received: StopEvent) -> bool:
        """Record a check-in; False when it does not count."""
        source, params = received.source, received.codec.fields(received.payload)
        why = self._check_ins.refusal(source, params)
        if why is not None:
            self._record_refusal(StopRefused(source, why), received.event)
            return False
        self._plane.checkin.record(source, received.at)
        self._rules.compare_clock(source, params, received.at)
        # The robots of a process share one audit.
        for first in [each for each in self._registrations if each.codec.answers][:1]:
            name = self.wire_id(first.robot_id)
            answer = self._check_in_answers.answer(name, params.get("estop_id"), first.identity())
            if answer is not None:
                first.link.publish(name, CHECK_IN_ANSWER, first.codec.encode(CHECK_IN_ANSWER, answer))
        return True

    def wire_id(self, robot_id: str) -> str:
        """Return the name by which a robot answers on its network."""
        entry = self._plane.robots.get(robot_id)
        return entry.wire_id if entry else robot_id

    def _cell(self, report: RobotReport) -> dict[str, str]:
        """Return the field ``cell``, which robots that read scopes have."""
        entry = self._plane.robots.get(report.robot_id)
        cells = frozenset[str]() if entry is None else entry.cells
        return {"cell": report.scope.cell if report.scope.cell in cells else min(cells, default="")}

    def _answer(self, report: RobotReport) -> None:
        key, now = (report.robot_id, report.epoch), time.monotonic()
        if not report.names_its_epoch and not self._latch_answers.allows(report.robot_id, report.epoch, now):
            return
        # Robots, not registrations: one on two networks has two.
        again_s = min(max(ANSWER_AGAIN_S, ANSWER_AGAIN_EACH_S * len(self._plane.robots)), ANSWER_AGAIN_MAX_S)
        if report.repeated and now - self._answered.get(key, 0.0) < again_s:
            return
        if report.repeated and report.names_its_epoch and key not in self._redundant:
            # Once for each stop: a controller repeats until every robot has answered.
            self._redundant[key] = None
            queue_safety_event("remote_estop_redundant", report.robot_id, {"epoch": report.epoch})
            _bound(self._redundant)
        self._answered[key] = now
        _bound(self._answered)
        for each in self._registrations:
            if each.robot_id == report.robot_id and each.codec.answers:
                device_id = self.wire_id(report.robot_id)
                each.link.publish(device_id, VERDICT, self._verdict(report, device_id, each.identity()))

    def _verdict(self, report: RobotReport, device_id: str, identity: SigningIdentity | None) -> bytes:
        """Encode a verdict and sign it.

        One that repeats, or that says no more than *resumed before*, is signed once: repetitions arrive on the
        listener's thread, and may be a flood.
        """
        same = (report.robot_id, report.epoch, report.stopped, report.epochs, identity and identity.public)
        halted_now = report.received_at is not None and not report.repeated
        payload = None if halted_now else self._repeated.get(same)
        if payload is None:
            fields = {**report.fields(), "device_id": device_id, "run": own_run(), "audit": audit_head()}
            fields |= self._cell(report)
            payload = notification(VERDICT, signed(identity, Purpose.STOP_VERDICT, device_id, fields))
            if not halted_now:
                self._repeated[same] = payload
                _bound(self._repeated)
        return payload


def _text(network: NetworkKey | None) -> str:
    return "" if network is None else network.text


def _no_answer(report: RobotReport) -> None:
    """Its network asks each robot for its verdict."""


def _bound(remembered: dict[Any, Any]) -> None:
    while len(remembered) > REMEMBERED_MAX:
        del remembered[next(iter(remembered))]


_LISTENER = EstopListener()


def estop_listener() -> EstopListener:
    """Return the e-stop listener of this process."""
    return _LISTENER
