"""The stop lane: one thread for the process, with connections of its own, from the first device to the last.

It shares no event loop, queue, lock, executor or session with the data plane. A link's thread hands a stop to the
lane's thread, that one locks every robot and hands each to the thread that halts it: two hand-offs.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any

from strands_robots.audit import log_safety_event
from strands_robots.safety.budget import Budget
from strands_robots.safety.decision import Decision, Refused, params_of
from strands_robots.safety.intake import Heard, Intake
from strands_robots.safety.links import CHECK_IN, ESTOP, VERDICT, StopLink, notification
from strands_robots.safety.orders import RobotReport
from strands_robots.safety.plane import SafetyPlane, plane
from strands_robots.utils import shown

logger = logging.getLogger(__name__)

ANSWER_AGAIN_S = 0.01
REFUSALS_TOLD_S = 10.0
SOURCES_TOLD = 256
CHECK_IN_AGE_S = 60.0

SWITCH_S = 0.0005
"""How long a busy Python thread may keep the interpreter from the stop's threads, while there is a lane; Python's own
default is ten times that, and a stop wakes three threads."""


class Seat:
    """One device's place on the lane. ``leave`` gives it up; the last one of a link closes the link."""

    def __init__(self, lane: StopLane, robot_id: str, key: Hashable, link: StopLink) -> None:
        self.robot_id = robot_id
        self.key = key
        self.link = link
        self._lane = lane

    def leave(self) -> None:
        """Leave the lane. Safe to call twice."""
        self._lane.leave(self)


class StopLane:
    """Hears every ``emergencyStop`` of the tenant and has the plane act on it.

    Args:
        of: the plane whose robots are stopped.
        decide: makes the rules; they are read when the first device joins.
    """

    def __init__(self, of: SafetyPlane | None = None, decide: Callable[[], Decision] = Decision) -> None:
        self._plane = of or plane()
        self._decide = decide
        self._joining = threading.Lock()
        self._seats: tuple[Seat, ...] = ()
        self._refusals = Refusals()
        self._budget = Budget()
        self._decision = Decision(allow=(), keys=())
        self._checked_in: dict[str, float] = {}
        self._answered: dict[tuple[str, str], float] = {}
        self._redundant: dict[tuple[str, str], None] = {}
        self._intake: Intake | None = None
        self._thread: threading.Thread | None = None
        self._switch_s = sys.getswitchinterval()

    @property
    def seats(self) -> tuple[Seat, ...]:
        """Who is on the lane."""
        return self._seats

    def join(self, robot_id: str, key: Hashable, make: Callable[[], StopLink]) -> Seat:
        """Serve a robot of the plane over the link that ``key`` names, made and opened if nobody uses it yet."""
        with self._joining:
            if self._intake is None:
                self._start()
            link = next((seat.link for seat in self._seats if seat.key == key), None)
            if link is None:
                link = make()
                link.open((ESTOP, CHECK_IN), self._hear, lambda up: None)
            seat = Seat(self, robot_id, key, link)
            self._seats = (*self._seats, seat)
            return seat

    def leave(self, seat: Seat) -> None:
        """Take a device off the lane."""
        with self._joining:
            if seat not in self._seats:
                return
            self._seats = tuple(each for each in self._seats if each is not seat)
            last_of_link = all(each.key != seat.key for each in self._seats)
            intake, thread = (self._intake, self._thread) if not self._seats else (None, None)
            if intake is not None:
                self._intake = self._thread = None
        if last_of_link:
            seat.link.close()
        if intake is not None:
            sys.setswitchinterval(self._switch_s)
            intake.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(2.0)

    def hear_params(self, source: str, params: Mapping[str, Any], road: str) -> None:
        """Act on an emergency stop that another road has parsed; returns at once, whichever road was first.

        A source whose signatures keep failing is not checked again here for up to a second: the lane hears it too.
        """
        if self._decision.signed and not self._budget.left(source, time.monotonic()):
            return
        order = self._decision.order(source, params, road)
        if isinstance(order, Refused):
            self._budget.spend(source, time.monotonic())
            self._refusals.tell(order, ESTOP)
        else:
            self._plane.begin(order, self._answer)

    def _start(self) -> None:
        self._decision = self._decide()
        if not self._decision.signed:
            logger.warning(
                "The source of an emergency stop is what it says it is: DEVICE_CONNECT_ESTOP_PUBLIC_KEYS is not set, "
                "and only a broker's access rules can vouch for it."
            )
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(min(self._switch_s, SWITCH_S))
        self._intake = Intake()
        self._thread = threading.Thread(target=self._run, args=(self._intake,), name="stop-lane", daemon=True)
        self._thread.start()

    def _hear(self, event: str, source: str, payload: bytes) -> None:
        intake = self._intake
        if intake is None:
            return
        why = self._decision.source_refusal(source)
        if why is None:
            intake.offer(event, source, payload, urgent=event == ESTOP)
        elif self._refusals.worth_telling(source):
            intake.offer(event, source, payload, urgent=False)

    def _run(self, intake: Intake) -> None:
        while (heard := intake.take()) is not None:
            try:
                if heard.event == ESTOP:
                    self._stop(heard)
                else:
                    self._check_in(heard)
            except Exception:
                logger.critical("The stop lane could not act on an event of %s.", shown(heard.source), exc_info=True)

    def _stop(self, heard: Heard) -> None:
        order = self._decision.heard(heard.source, heard.payload, "lane", heard.at)
        if isinstance(order, Refused):
            self._refusals.tell(order, heard.event)
        else:
            self._plane.begin(order, self._answer)

    def _check_in(self, heard: Heard) -> None:
        params = params_of(heard.payload)
        why = self._decision.source_refusal(heard.source) or self._decision.signature_refusal(heard.source, params)
        t = params.get("t")
        if why is None and self._decision.signed and isinstance(t, int | float):
            # A recorded check-in played again must not keep a robot moving.
            if t <= self._checked_in.get(heard.source, 0.0) or abs(time.time() - t) > CHECK_IN_AGE_S:
                why = "it was checked in before, or its clock is a minute off"
            elif len(self._checked_in) < SOURCES_TOLD or heard.source in self._checked_in:
                self._checked_in[heard.source] = t
        if why is not None:
            self._refusals.tell(Refused(heard.source, why), heard.event)
        else:
            self._plane.checkin.heard(heard.source, heard.at)

    def _answer(self, report: RobotReport) -> None:
        key, now = (report.robot_id, report.epoch), time.monotonic()
        if report.repeated and now - self._answered.get(key, 0.0) < ANSWER_AGAIN_S:
            return
        if report.repeated and key not in self._redundant:
            # Once for each stop: a controller repeats until it has heard everybody.
            self._redundant[key] = None
            log_safety_event("remote_estop_redundant", report.robot_id, {"epoch": report.epoch})
            while len(self._redundant) > SOURCES_TOLD:
                del self._redundant[next(iter(self._redundant))]
        self._answered[key] = now
        while len(self._answered) > SOURCES_TOLD:
            del self._answered[next(iter(self._answered))]
        for seat in self._seats:
            if seat.robot_id == report.robot_id:
                entry = self._plane.robots.get(report.robot_id)
                device_id = entry.wire_id if entry else report.robot_id
                told = {**report.fields(), "device_id": device_id}
                seat.link.publish(device_id, VERDICT, notification(VERDICT, told))


class Refusals:
    """Counts what did not count, and tells of each source once in ten seconds, however many it sends."""

    def __init__(self) -> None:
        self._seen: dict[str, list[float]] = {}

    def worth_telling(self, source: str) -> bool:
        """True when this refusal should reach the record; else it is only counted."""
        entry = self._entry(source)
        if time.monotonic() >= entry[0]:
            return True
        entry[1] += 1
        return False

    def tell(self, refused: Refused, event: str) -> None:
        """Log and record a refusal, unless this source was told of a moment ago."""
        if not self.worth_telling(refused.source):
            return
        entry = self._entry(refused.source)
        more, entry[:] = int(entry[1]), [time.monotonic() + REFUSALS_TOLD_S, 0.0]
        logger.warning("%s of %s does not count: %s.", event, shown(refused.source), refused.why)
        facts = {"event": event, "source": refused.source[:256], "why": refused.why, "more_since": more}
        log_safety_event("estop_refused", "stop-lane", facts)

    def _entry(self, source: str) -> list[float]:
        name = source if source in self._seen or len(self._seen) < SOURCES_TOLD else ""
        return self._seen.setdefault(name, [float("-inf"), 0.0])


_LANE = StopLane()


def lane() -> StopLane:
    """The stop lane of this process."""
    return _LANE
