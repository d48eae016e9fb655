"""E-stop listener: one thread that turns emergency stops into halts.

It lives from the first registered device to the last, and shares no event loop, queue, lock, executor or session with
the data plane. A link's thread hands an event to the listener's thread; that one locks every robot and submits each to
the stop executor: two hand-offs.
"""

from __future__ import annotations

import functools
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

from strands_robots.audit import audit_head, own_log_id, queue_safety_event
from strands_robots.safety.awake import AWAKE
from strands_robots.safety.checkin import CheckInAnswers, CheckInRules, HeadWitness
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.missed_stops import ANSWER, QUESTION, MissedStops
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import LISTENER, PARSED_MAX_BYTES, RobotReport, StopOrder, StopRefused, StopRules
from strands_robots.safety.plane import SafetyPlane, plane
from strands_robots.safety.question_ports import Member, RobotsPort
from strands_robots.safety.sighting_file import own_run
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_link import (
    CHECK_IN,
    CHECK_IN_ANSWER,
    ESTOP,
    EVENTS,
    JSON_RPC,
    VERDICT,
    StopCodec,
    StopEvent,
    StopLink,
    notification,
)
from strands_robots.safety.turns import shorten_turns
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)

ANSWER_AGAIN_S = 0.01
"""Seconds between two answers of a robot to the same stop."""

ANSWER_AGAIN_EACH_S = 0.002
"""The same, for each robot of the process, where that is longer: a stop repeated to hundreds is no flood of answers."""

ANSWER_AGAIN_MAX_S = 0.25

REFUSAL_INTERVAL_S = 10.0
SOURCES_MAX = 256
"""Sources remembered; past it the oldest is forgotten or all new ones share an entry, so that names take no memory."""

BUCKETS = 64
BUCKET_CAPACITY = 16
LATER_EVERY = 8
"""Of so many events that are taken from a full bucket one is not urgent, so that a flood of stops starves none."""

VOUCHED_MAX = 16
"""Sources with a share of their own in the queue: the first that signed validly."""

REFUSED_PAUSE_S = 0.0005
"""Seconds that the listener rests after a refused stop of a source that has not signed validly."""

LATCH_ANSWERS_PER_S = 200
LATCH_ANSWERS_REMEMBERED = 4096


class _Bucket:
    """Events of the sources that share it: stops, and what is not urgent.

    Only the listener's thread takes; appending is atomic.
    """

    __slots__ = ("_later", "_taken", "_urgent")

    def __init__(self) -> None:
        self._urgent: deque[StopEvent] = deque(maxlen=BUCKET_CAPACITY)
        self._later: deque[StopEvent] = deque(maxlen=BUCKET_CAPACITY // 2)
        self._taken = 0

    def put(self, event: StopEvent, urgent: bool) -> None:
        """Add an event: in place of the oldest stop, or where there is room."""
        if urgent:
            self._urgent.append(event)
        elif len(self._later) < BUCKET_CAPACITY // 2:
            self._later.append(event)

    def take(self) -> StopEvent | None:
        """Remove the newest stop, or in its turn the oldest of the others."""
        if not (self._urgent or self._later):
            return None
        self._taken += 1
        if self._later and (not self._urgent or self._taken % LATER_EVERY == 0):
            return self._later.popleft()
        return self._urgent.pop()


class FairQueue:
    """Bounded queue of the listener: fair between sources, newest first.

    A flood of forged stops must not delay a true one. Sources share a fixed number of buckets by a keyed hash; buckets
    are served in turn, one event each, the newest stop first. What overflows a bucket is its oldest stop; a controller
    repeats its stop, so a true one arrives again. A source that was vouched for has a bucket of its own, and every
    second turn is of such a one: names that are made up share the other turns. No method but :meth:`get` blocks.
    """

    def __init__(self) -> None:
        self._salt = secrets.token_hex(8)
        self._buckets = [_Bucket() for _ in range(BUCKETS)]
        self._vouched: dict[str, _Bucket] = {}
        self._turns: tuple[_Bucket, ...] = ()
        self._waiting = threading.Event()
        self._turn = self._vouched_turn = 0
        self._crowd_next = False
        self._closed = False

    def vouch(self, source: str) -> None:
        """Give a source that signed validly a bucket of its own."""
        if source not in self._vouched and len(self._vouched) < VOUCHED_MAX:
            bucket = _Bucket()
            self._turns = (*self._turns, bucket)
            self._vouched[source] = bucket

    def vouched_for(self, source: str) -> bool:
        """Return True when this source has a bucket of its own."""
        return source in self._vouched

    def put(
        self,
        event: str,
        source: str,
        payload: bytes | int,
        *,
        urgent: bool = True,
        network: str = "",
        codec: StopCodec = JSON_RPC,
    ) -> None:
        """Add an event; of those that are not urgent, a full bucket drops the new."""
        received = StopEvent(event, source, payload, time.monotonic(), network, codec)
        bucket = self._vouched.get(source)
        if bucket is None:
            # Within one text: the hash of a pair keeps the same names together whatever the salt.
            bucket = self._buckets[hash(self._salt + source) % len(self._buckets)]
        # Adding to a bucket and setting an event are atomic; no lock is shared with the listener's thread.
        bucket.put(received, urgent)
        # While it is set, the listener's next look is still to come: most messages of a flood need not wake it.
        if not self._waiting.is_set():
            self._waiting.set()

    def get(self) -> StopEvent | None:
        """Return the next event, waiting for one; None once closed and empty."""
        while True:
            self._crowd_next = not self._crowd_next
            for take in (self._of_crowd, self._of_vouched) if self._crowd_next else (self._of_vouched, self._of_crowd):
                event = take()
                if event is not None:
                    return event
            if self._closed:
                return None
            self._waiting.wait()
            self._waiting.clear()
            # What was put between the look and the clearing is found by the next look; what comes later sets it.

    def _of_crowd(self) -> StopEvent | None:
        for _ in self._buckets:
            self._turn = (self._turn + 1) % len(self._buckets)
            event = self._buckets[self._turn].take()
            if event is not None:
                return event
        return None

    def _of_vouched(self) -> StopEvent | None:
        turns = self._turns
        for _ in turns:
            self._vouched_turn = (self._vouched_turn + 1) % len(turns)
            event = turns[self._vouched_turn].take()
            if event is not None:
                return event
        return None

    def close(self) -> None:
        """Let :meth:`get` return None when nothing is left."""
        self._closed = True
        self._waiting.set()


class FailureBudget:
    """Failed signature checks of each source and of all in a second.

    Without the sum, a flood under made-up names would have each of them checked.
    """

    def __init__(self, per_s: int = 20, in_all_per_s: int = 100) -> None:
        self._per_s, self._in_all_per_s = per_s, in_all_per_s
        self._failures: dict[str, tuple[float, int]] = {}
        self._in_all = (float("-inf"), 0)

    def allows(self, source: str, now: float) -> bool:
        """Return True while one more message of ``source`` may be checked."""
        since, count = self._failures.get(source, (now, 0))
        if count >= self._per_s and now - since < 1.0:
            return False
        since, count = self._in_all
        return count < self._in_all_per_s or now - since >= 1.0

    def record(self, source: str, now: float) -> None:
        """Count a failure of ``source``."""
        since, count = self._failures.pop(source, (now, 0))
        self._failures[source] = (since, count + 1) if now - since < 1.0 else (now, 1)
        _bound(self._failures)
        since, count = self._in_all
        self._in_all = (since, count + 1) if now - since < 1.0 else (now, 1)


class LatchAnswers:
    """Budget of answers to stops beyond those that a robot tells apart.

    Any such stop is answered while fewer than ``per_s`` were in this second. Beyond that, one that comes again is: a
    controller repeats its stop until it is answered, and a flood of fresh ids does not.
    """

    def __init__(self, per_s: int = LATCH_ANSWERS_PER_S) -> None:
        self._per_s = per_s
        self._since, self._count = float("-inf"), 0
        self._unanswered: dict[tuple[str, str], None] = {}

    def allows(self, robot_id: str, epoch: str, now: float) -> bool:
        """Return True when this stop is answered now, else remember it."""
        if now - self._since >= 1.0:
            self._since, self._count = now, 0
        if self._count < self._per_s:
            self._count += 1
            return True
        key = (robot_id, epoch)
        if key in self._unanswered:
            return True
        self._unanswered[key] = None
        if len(self._unanswered) > LATCH_ANSWERS_REMEMBERED:
            del self._unanswered[next(iter(self._unanswered))]
        return False


class RefusalLog:
    """Count of refused messages; each source is reported once in ten seconds."""

    def __init__(self) -> None:
        self._sources: dict[str, list[float]] = {}

    def due(self, source: str) -> bool:
        """Return True when this refusal should be recorded; else count it."""
        entry = self._entry(source)
        if time.monotonic() >= entry[0]:
            return True
        entry[1] += 1
        return False

    def record(self, refused: StopRefused, event: str) -> None:
        """Log and audit a refusal, unless one of this source was recorded a moment ago."""
        if not self.due(refused.source):
            return
        entry = self._entry(refused.source)
        more, entry[:] = int(entry[1]), [time.monotonic() + REFUSAL_INTERVAL_S, 0.0]
        logger.warning("%s of %s does not count: %s.", event, shown(refused.source), refused.why)
        facts = {"event": event, "source": refused.source[:256], "why": refused.why, "more_since": more}
        queue_safety_event("estop_refused", "stop-lane", facts)

    def _entry(self, source: str) -> list[float]:
        name = source if source in self._sources or len(self._sources) < SOURCES_MAX else ""
        return self._sources.setdefault(name, [float("-inf"), 0.0])


class ListenerRegistration:
    """Registration of a device with the listener; the last one closes the link."""

    def __init__(
        self,
        listener: EstopListener,
        robot_id: str,
        key: Hashable,
        link: StopLink,
        identity: Callable[[], SigningIdentity | None],
        *,
        network: NetworkKey | None,
        was_here: bool,
        codec: StopCodec,
        asks: bool,
    ) -> None:
        self.robot_id = robot_id
        self.codec, self.asks = codec, asks
        self.network = network
        self.was_here = was_here
        self.identity = identity
        self.key = key
        self.link = link
        self._listener = listener

    def open(self) -> None:
        """Open the link, unless it is open or this registration has ended."""
        self._listener.open(self)

    def close(self) -> None:
        """Unregister. Safe to call twice."""
        self._listener.unregister(self)


class OpenLink(NamedTuple):
    """An open link: its network, its codec, and the missed stops of its devices."""

    network: str
    codec: StopCodec
    missed: MissedStops


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
        self._refusals = RefusalLog()
        self._budget = FailureBudget()
        self._latch_answers = LatchAnswers()
        self._rules = StopRules(allow=(), keys=())
        self._check_ins = CheckInRules(self._rules)
        self._witness, self._check_in_answers, self._heads = HeadWitness(), CheckInAnswers(), FailureBudget()
        self._answered: dict[tuple[str, str], float] = {}
        self._redundant: dict[tuple[str, str], None] = {}
        self._repeated: dict[Hashable, bytes] = {}
        self._queue: FairQueue | None = None
        self._thread: threading.Thread | None = None
        self._end_short_turns: Callable[[], None] = lambda: None
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
            if self._queue is None:
                self._start()
            link = next((each.link for each in self._registrations if each.key == key), None)
            made = make() if link is None else link
            registration = ListenerRegistration(
                self, robot_id, key, made, identity, network=network, was_here=was_here, codec=codec, asks=asks
            )
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
                registration.link.open(EVENTS, receive, lambda up: missed.link_up() if up else missed.link_down())

    def unregister(self, registration: ListenerRegistration) -> None:
        """Serve a device no longer; the thread ends with the last one."""
        with self._registering:
            if registration not in self._registrations:
                return
            self._registrations = tuple(each for each in self._registrations if each is not registration)
            last_of_link = all(each.key != registration.key for each in self._registrations)
            opened = self._open.pop(registration.key, None) if last_of_link else None
            events, thread = (self._queue, self._thread) if not self._registrations else (None, None)
            if events is not None:
                self._queue = self._thread = None
        if last_of_link:
            registration.link.close()
        if opened is not None:
            opened.missed.close()
        if events is not None:
            self._end_watch()
            self._end_short_turns()
            events.close()
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

    def accept(self, stop: StopEvent, path: str, fields: Mapping[str, Any] | None = None) -> None:
        """Act on an emergency stop of any network; return at once.

        The listener's thread calls it for what its links received. A network that receives stops over a further
        connection calls it there: a source whose signatures keep failing is not checked again on that path for up to a
        second, because its stops arrive at the listener's own link as well.

        Args:
            path: how it arrived.
            fields: of its payload, where they were read already.
        """
        codec, source = stop.codec, stop.source
        stated = codec.fields(stop.payload) if fields is None else fields
        if self._plane.under_way(stated.get("estop_id")):
            return
        events = self._queue if path == LISTENER else None
        if events is None and codec.vouches(self._rules) and not self._budget.allows(source, time.monotonic()):
            return
        order = codec.order(self._rules, stop, stated, path)
        if isinstance(order, StopOrder):
            on_report = self._answer if codec.answers else _no_answer
            codec.begun(order, stated, self._plane.begin(order, on_report))
            if events is not None and codec.vouches(self._rules):
                events.vouch(source)
        elif order is not None:
            if not codec.refused(order):
                self._refusals.record(order, stop.event)
            if events is None:
                self._budget.record(source, time.monotonic())
            elif not events.vouched_for(source):
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
        events = self._queue
        if events is None:
            return
        if not isinstance(payload, int) and len(payload) > PARSED_MAX_BYTES:
            payload = len(payload)
        if event == CHECK_IN_ANSWER:
            # Robots send these; so many a second, which a flood of them does not exceed.
            now = time.monotonic()
            if self._heads.allows("", now):
                self._heads.record("", now)
                events.put(event, source, payload, urgent=False)
            return
        if not codec.names_source or self._rules.source_refusal(source) is None:
            events.put(event, source, payload, urgent=event == ESTOP, network=network, codec=codec)
        elif self._refusals.due(source):
            events.put(event, source, payload, urgent=False, codec=codec)

    def _missed_stops(self, registration: ListenerRegistration) -> MissedStops:
        key, link, codec = registration.key, registration.link, registration.codec

        def members() -> list[Member]:
            here = [each for each in self._registrations if each.key == key and each.asks and each.network is not None]
            return [Member(each.robot_id, self._wire_id(each.robot_id), each.identity, each.was_here) for each in here]

        def publish(event: str, source: str, fields: Mapping[str, Any]) -> bool:
            return link.publish(source, event, codec.encode(event, fields))

        port = RobotsPort(
            self._plane,
            self._rules,
            registration.network,
            members=members,
            publish=publish,
            on_report=self._answer,
            codec=codec,
        )
        return MissedStops(port, codec.fields)

    def _start(self) -> None:
        self._rules = self._make_rules()
        self._rules.require_keys()
        self._check_ins = CheckInRules(self._rules)
        audit_head(), own_log_id(), own_run()  # read from the disk now, so that no stop waits for it
        self._end_short_turns = shorten_turns()
        self._end_watch = AWAKE.watch(self.awake)
        self._queue = FairQueue()
        self._thread = threading.Thread(target=self._run, args=(self._queue,), name="estop-listener", daemon=True)
        self._thread.start()

    def _run(self, events: FairQueue) -> None:
        while (received := events.get()) is not None:
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
            self._refusals.record(StopRefused(source, why), received.event)
            return False
        self._plane.checkin.record(source, received.at)
        self._rules.compare_clock(source, params, received.at)
        # The robots of a process share one audit.
        for first in [each for each in self._registrations if each.codec.answers][:1]:
            name = self._wire_id(first.robot_id)
            answer = self._check_in_answers.answer(name, params.get("estop_id"), first.identity())
            if answer is not None:
                first.link.publish(name, CHECK_IN_ANSWER, first.codec.encode(CHECK_IN_ANSWER, answer))
        return True

    def _wire_id(self, robot_id: str) -> str:
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
                device_id = self._wire_id(report.robot_id)
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
    while len(remembered) > SOURCES_MAX:
        del remembered[next(iter(remembered))]


_LISTENER = EstopListener()


def estop_listener() -> EstopListener:
    """Return the e-stop listener of this process."""
    return _LISTENER
