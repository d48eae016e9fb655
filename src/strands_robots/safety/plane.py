"""Safety plane of a process: its robots, and the end of every emergency stop."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

from strands_robots import settings
from strands_robots.audit import queue_safety_event
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.checkin import CheckIn
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.lockout import Lockout, LockoutLatch
from strands_robots.safety.orders import COMES_UP_LOCKED, LISTENER, MISSED, RobotReport, StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore, Original, Originals, ResumedEpochs, StoredLockout
from strands_robots.safety.process import undisturbed
from strands_robots.safety.reporting import UNPACED, OnReport, Reporter, StopCount, StopRun
from strands_robots.safety.resume import (
    CLEARED,
    LEFT,
    NOT_KEPT,
    NOT_LOCKED,
    REJECTED,
    Admitted,
    ClearanceInbox,
    ResumeVerifier,
)
from strands_robots.safety.sightings import sightings
from strands_robots.safety.stop_executor import StopExecutor, stop_executor
from strands_robots.safety.stop_targets import Stoppable, body_of, holds_several, note_motion
from strands_robots.safety.stopping import StopVerdict
from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, identifier, shown

logger = stop_logger(__name__)

REPORTS_KEPT = 64
HALT_AGAIN_S = 0.25
"""Seconds in which one halt answers for all stops of a robot that is locked by more than it tells apart."""

YIELD_S = 0.00005
"""Seconds that the halts of a stop have to themselves as they begin."""

KEEP_AGAIN_S = 1.0
"""Seconds between two attempts to write a lockout, or its clearing, that could not be written."""

ISSUER_EXCESS = 64
"""Different stops of one source after which the audit says so, once; they still stop."""


READY_MAX = 4
"""Robots of a process that own a halt thread before they have moved."""


class Registered:
    """One robot in the plane. ``close`` takes it out; the lockout on disk stays."""

    def __init__(
        self,
        plane: SafetyPlane,
        robot_id: str,
        robot: Stoppable,
        *,
        key: str | None,
        kept: StoredLockout,
        wire_id: str,
        cells: frozenset[str] = frozenset(),
    ) -> None:
        self.robot_id = robot_id
        self.wire_id = wire_id
        self.cells = cells
        self.robot = robot
        self.key = key
        self.users = 1
        self.gates: tuple[MotionGate, ...] = (robot.gate,)
        resumed = kept.resumed or ResumedEpochs()
        self.latch = LockoutLatch(
            wire_id, kept.state, kept.seen, resumed=resumed.epochs, cleared=resumed.cleared, crowd=kept.crowd
        )
        self.on_disk, self.crowd_on_disk = kept.state, self.latch.crowd
        self.registered_before = kept.resumed is not None
        self._recorded_since, self._here_since = resumed.since, uptime()
        self.resumed_on_disk = None if kept.resumed is None else self.resumed
        self.keep_again = False
        self.verdict = StopVerdict(unknown={robot_id: "its halt has not answered yet"})
        self._halted_at = float("-inf")
        self.verifier = ResumeVerifier([wire_id])
        self.reports: dict[str, RobotReport] = {}
        self._plane = plane
        self._ready, self._readying = False, threading.Lock()
        # A world that has not moved yet shares the threads of the reserve, and so does every robot of a large process
        # until it moves: a hundred of them need no hundred threads.
        if holds_several(robot) or len(plane.robots) >= READY_MAX:
            plane.executor.prepare()
            self._unwatch = robot.gate.watch(self._stand_by)
        else:
            self._stand_by()
            self._unwatch = lambda: None

    @property
    def locked(self) -> bool:
        """True while any emergency stop is held."""
        return self.latch.state.locked

    @property
    def resumed(self) -> ResumedEpochs:
        """The record of the epochs that it was resumed from."""
        return ResumedEpochs(self.latch.resumed, self._recorded_since, self.latch.cleared)

    @property
    def resumed_unsaved(self) -> bool:
        """True while the disk lacks an epoch that it was resumed from."""
        epochs, cleared, stored = self.latch.resumed, self.latch.cleared, self.resumed_on_disk
        return bool(epochs or cleared) and not (stored and stored.holds(epochs, cleared))

    @property
    def unsaved(self) -> bool:
        """True while the disk has an older state or none."""
        return bool(self.key) and (self.latch.state is not self.on_disk or self.resumed_unsaved)

    @property
    def crowd_unsaved(self) -> bool:
        """True while the disk lacks the latest time of a flood."""
        return bool(self.key) and self.crowded and self.latch.crowd is not self.crowd_on_disk

    @property
    def unrecorded(self) -> bool:
        """True until the disk says since when there is this robot."""
        return bool(self.key) and self.resumed_on_disk is None

    @property
    def epochs(self) -> tuple[str, ...]:
        """The epochs held, oldest first."""
        return self.latch.state.epochs

    def resume(self, assertion: object, path: str = "local") -> Envelope:
        """Clear the epoch that a signed assertion names, or refuse without saying why."""
        return self._plane.resume(self.robot_id, assertion, path)

    def close(self) -> None:
        """Take the robot out of the plane."""
        self._plane.unregister(self)

    def adopt(self, key: str, kept: StoredLockout) -> None:
        """Store this robot under ``key``, and take over what is stored there."""
        self.key = key
        if kept.resumed is not None:
            self.registered_before, self._recorded_since = True, kept.resumed.since
            self.latch.forgo(kept.resumed.epochs, kept.resumed.cleared)
        self.latch.inherit(kept.state, kept.crowd)

    def returned(self) -> bool:
        """Count as a robot that was here before its process; False without a record."""
        if self.registered_before:
            self._here_since = min(self._here_since, self._recorded_since)
        return self.registered_before

    def come_up_locked(self) -> None:
        """Halt motion that began before the lock was known; return at once."""
        for gate in self.gates:
            gate.revoke()
        logger.warning("%s comes up locked: epochs %s.", self.robot_id, ", ".join(self.epochs))
        halted = self._plane.executor.submit(self.robot, self.robot_id, COMES_UP_LOCKED)
        halted.add_done_callback(self._came_up)

    def leave_executor(self) -> None:
        """Give up the ready thread; a halt under way is waited for, for a second."""
        self._unwatch()
        with self._readying:
            ready, self._ready = self._ready, True
        if ready:
            self._plane.executor.detach(self.robot, wait=1.0)

    def engage(self, order: StopOrder) -> bool:
        """Lock under the order; True when it has to be carried out.

        A stop is known, or one of a flood that locks nothing more: the latest halt answers for it. A missed one may be
        from before its time.
        """
        latch = self.latch
        lock = functools.partial(latch.engage, order.epoch, order.source, order.reason, order.scope)
        if order.path != MISSED and latch.state.overflow is None:
            return lock()
        received = uptime() - order.age_s - (time.monotonic() - order.received)
        if order.path == MISSED and not self._missed(received):
            return False
        if latch.state.overflow is None:
            return lock()
        latch.crowd_on(received)
        if order.received - self._halted_at < HALT_AGAIN_S or not lock():
            return False
        self._halted_at = order.received
        return True

    def _missed(self, received: float) -> bool:
        """Return False for a stop of before its time, or of a flood it was cleared of."""
        return received >= self._here_since and not self.latch.cleared_of(received)

    @property
    def crowded(self) -> bool:
        """True while more stops lock it than it tells apart."""
        return self.latch.state.overflow is not None

    def report_again(self, order: StopOrder) -> RobotReport | None:
        """Return the report on a stop that is not carried out, None while it is due."""
        state = self.latch.state
        known, held = self.reports.get(order.epoch), state.can_resume(order.epoch)
        if known is not None and (held or self.crowded):
            return replace(known, epochs=state.epochs, repeated=True, late=False)
        if held:
            return None
        if self.crowded:
            persisted = state is self.on_disk if self.key else None
            return RobotReport(
                self.robot_id, order.epoch, self.verdict, state.epochs, 0.0, persisted=persisted, repeated=True
            )
        if self.latch.knows(order.epoch):
            why = {self.robot_id: "this stop was resumed before it came again"}
            return RobotReport(self.robot_id, order.epoch, StopVerdict(unknown=why), state.epochs, 0.0)
        return None

    def _stand_by(self) -> None:
        with self._readying:
            if not self._ready:
                self._plane.executor.attach(self.robot, self.robot_id)
                self._ready = True

    def _came_up(self, halted: Future[StopVerdict]) -> None:
        verdict = self.verdict = halted.result()
        if verdict.stopped is not True:
            logger.critical("%s comes up locked and DID NOT STOP: %s", self.robot_id, verdict.envelope().get("reason"))

    def remember(self, report: RobotReport) -> None:
        """Keep the report for when this stop arrives again."""
        self.verdict = report.verdict
        if not report.names_its_epoch:
            return  # the latest verdict answers for it
        self.reports[report.epoch] = report
        while len(self.reports) > REPORTS_KEPT:
            del self.reports[next(iter(self.reports))]


class SafetyPlane:
    """All robots of the process. Every public method may be called from any thread.

    Args:
        store: where lockouts are kept.
        deadline_s: seconds a robot has to halt; ``STRANDS_HALT_DEADLINE_S`` by default, read at each stop.
        executor: halts the robots; the process's by default.

    Attributes:
        robots: that are registered now, by id; the mapping is never changed, only replaced.
    """

    def __init__(
        self,
        store: LockoutStore | None = None,
        deadline_s: float | None = None,
        executor: StopExecutor | None = None,
    ) -> None:
        self.store = store or LockoutStore()
        self._deadline_s = deadline_s
        self._executor = executor
        self._registering = threading.Lock()
        self._keeping = threading.Lock()
        self._keep_at = 0.0
        self.robots: dict[str, Registered] = {}
        self._reporter: Reporter | None = None
        self._begun: tuple[str, dict[str, Registered]] | None = None
        self._issued: dict[str, int] = {}
        self._counted = StopCount()
        self._originals = Originals()
        self._clearance = ClearanceInbox(lambda: self.robots, self._clear_one)
        self.checkin = CheckIn(settings.number("STRANDS_CHECKIN_TIMEOUT_S"))

    @property
    def executor(self) -> StopExecutor:
        """The executor that halts the robots."""
        return self._executor or stop_executor()

    def register(
        self, robot_id: str, robot: Stoppable, *, key: str | None = None, wire_id: str = "", cell: str = ""
    ) -> Registered:
        """Put ``robot`` under the plane, which locks and halts it.

        Args:
            robot_id: its name in this process.
            wire_id: the name it answers by on its network and that a resume targets; ``robot_id`` by default.
            key: under which its lockout is stored over a restart, from :func:`~.persistence.hardware_key` or
                :func:`~.persistence.simulation_key`. None: it is not kept.
            cell: the cell that it is in, if any; under a second name of its own a further one.

        Registering the same robot again under its name, as its second network does, returns the same entry, which
        lives until it was closed as often.

        Raises:
            ValidationError: no identifier, or another robot has this name.
        """
        settings.warn_at_join()
        identifier("robot_id", robot_id)
        with self._registering:
            known = self.robots.get(robot_id)
            if known is not None:
                if body_of(known.robot) is not body_of(robot):
                    raise ValidationError(f"robot_id {shown(robot_id)} is taken by another robot of this process.")
                known.users += 1
                known.cells |= {cell} if cell else frozenset()
                if robot.gate not in known.gates:
                    robot.gate.attach(known.latch)
                    known.gates = (*known.gates, robot.gate)
                if key and known.key is None:
                    known.adopt(key, self.store.load(key))
                    if known.locked:
                        known.come_up_locked()
                        self._kept([known])
                return known
            kept = self.store.load(key) if key else StoredLockout()
            for each in kept.originals:
                self._originals.add(each)
            entry = Registered(
                self,
                robot_id,
                robot,
                key=key,
                kept=kept,
                wire_id=wire_id or robot_id,
                cells=frozenset({cell} if cell else ()),
            )
            robot.gate.attach(entry.latch)
            self._inherit(entry)
            if not self.robots:
                self.checkin = CheckIn(settings.number("STRANDS_CHECKIN_TIMEOUT_S"))
                self._reporter = Reporter(self._tick, self._chore)
            self.robots = {**self.robots, robot_id: entry}
        if entry.locked:
            entry.come_up_locked()
        return entry

    def unregister(self, entry: Registered) -> None:
        """Take a robot out with its last user; the threads end with the last robot."""
        with self._registering:
            entry.users -= 1
            if entry.users or self.robots.get(entry.robot_id) is not entry:
                return
            self.robots = {name: each for name, each in self.robots.items() if each is not entry}
            self._bequeath(entry)
            # Decided here: a robot that registers meanwhile has a reporter of its own, and this one ends all the same.
            last = None
            if not self.robots:
                last, self._reporter = self._reporter, None
        if last is not None:
            last.close()
        entry.leave_executor()

    def _inherit(self, entry: Registered) -> None:
        """Lock the entry by lockouts with which its robot left the plane."""
        living = [each.latch for each in self.robots.values()]
        for latch in entry.robot.gate.latches:
            if isinstance(latch, LockoutLatch) and latch is not entry.latch and latch not in living:
                entry.latch.inherit(latch.state, latch.crowd)
                entry.robot.gate.detach(latch)

    def _bequeath(self, entry: Registered) -> None:
        """Store the lockouts of a robot that leaves, on disk and in its gate."""
        if entry.locked and entry.latch.state is not entry.on_disk:
            # Its last stop may not be written yet, and the next registration reads it there.
            self._kept([entry])
        for gate in entry.gates:
            heirs = [each for each in self.robots.values() if gate in each.gates]
            for heir in heirs:
                heir.latch.inherit(entry.latch.state, entry.latch.crowd)
            if heirs or not entry.locked:
                gate.detach(entry.latch)

    def begin(self, order: StopOrder, on_report: OnReport = lambda report: None) -> StopRun | None:
        """Lock every robot and start every halt; return before their answers.

        A robot that has seen this stop is not halted again; ``on_report`` gets at once its report of then while this
        stop still holds it, and ``stopped`` None once it was resumed. None when no robot had anything to do, and while
        this stop is :meth:`under_way`: what began it reports every robot.
        """
        if self.under_way(order.epoch):
            return None
        followed = False
        halted = undisturbed(many=len(self.robots) > UNPACED)
        try:
            by_name = self.robots
            fresh, known = self._engage(order, by_name)
            reporter = self._reporter
            if reporter is None:
                # The last robot is leaving; its halt is not reported any more, and it is halted all the same.
                for entry in fresh:
                    self.executor.submit(entry.robot, entry.robot_id, order.reason)
            if not fresh or reporter is None:
                self._repeat(order, known, on_report)
                return None
            by_id = {entry.robot_id: entry for entry in fresh}

            def reported(report: RobotReport) -> None:
                self._begun = None
                by_id[report.robot_id].remember(report)
                on_report(report)

            run = StopRun(
                order,
                tuple(by_id),
                frozenset(name for name, entry in by_id.items() if entry.key),
                settings.number("STRANDS_HALT_DEADLINE_S") if self._deadline_s is None else self._deadline_s,
                lambda name: by_id[name].epochs,
                reported,
                self._record,
                lambda: self._keep(fresh),
                halted,
            )
            if len(fresh) == len(by_name):
                # An answer takes it back, and none is in before the first halt is submitted.
                self._begun = (order.epoch, by_name)
            executor = self._executor or stop_executor()
            for entry in fresh:
                executor.submit(
                    entry.robot,
                    entry.robot_id,
                    order.reason,
                    within=run.deadline_s,
                    since=order.received,
                    answered=functools.partial(reporter.answer, run, entry.robot_id),
                    voided=True,
                )
            # Nothing of what follows is urgent, and it would keep the interpreter from the halts.
            time.sleep(YIELD_S)
            self._note_original(order)
            reporter.begin(run)
            followed = True
            if self._reporter is not reporter:
                # It may have ended before it took the run.
                self._begun = None
                halted()
            self._repeat(order, known, on_report)
            return run
        finally:
            if not followed:
                self._begun = None
                halted()

    def under_way(self, epoch: object) -> bool:
        """Return True while every robot carries out this stop and none is reported.

        A repetition changes nothing then, and the halts need the time that reading it takes.
        """
        begun = self._begun
        return begun is not None and begun[0] == epoch and begun[1] is self.robots

    def _engage(self, order: StopOrder, by_name: dict[str, Registered]) -> tuple[list[Registered], list[Registered]]:
        """Lock the robots in its scope; return those to halt, and those that know it.

        A robot outside of the scope is neither: it remembers nothing of this stop, so that a wider one locks it.
        """
        fresh: list[Registered] = []
        known: list[Registered] = []
        listener, scope = order.path == LISTENER, order.scope
        if listener and scope.everything:
            self._begun = (order.epoch, by_name)
        for entry in by_name.values():
            if not scope.everything and not scope.covers(entry.wire_id, entry.cells):
                continue
            if not listener and self.under_way(order.epoch):
                # It came over another path meanwhile: the e-stop listener's thread halts and reports the others.
                return fresh, []
            if entry.engage(order):
                note_motion(entry.robot)
                for gate in entry.gates:
                    gate.revoke()
                fresh.append(entry)
            else:
                known.append(entry)
        return fresh, known

    def emergency_stop(self, order: StopOrder, on_report: OnReport = lambda report: None) -> dict[str, RobotReport]:
        """Lock and halt every robot; return their answers by robot id.

        Returns within the halt deadline and the time the lockout file takes, whatever the robots do. A robot that
        has seen this stop before answers as in :meth:`begin`; of a stop that is under way there are no answers here.
        """
        answers: dict[str, RobotReport] = {}

        def reported(report: RobotReport) -> None:
            answers[report.robot_id] = report
            on_report(report)

        run = self.begin(order, reported)
        if run is not None:
            run.wait(run.deadline_s + 2.0)
        return dict(answers)

    def resume(self, robot_id: str, assertion: object, path: str) -> Envelope:
        """Check a signed resume for one robot; the answer has no reason."""
        entry = self.robots.get(robot_id)
        if entry is None:
            return error(REJECTED)
        verdict = entry.verifier.check(assertion, entry.latch.state.resumable)
        if not isinstance(verdict, Admitted):
            queue_safety_event("resume_denied", robot_id, {"why": verdict.value, "road": path})
            return error(REJECTED)
        entry.latch.resume(verdict.epoch)
        persisted = self._kept([entry])
        queue_safety_event(
            "resume_ok",
            robot_id,
            {"epoch": verdict.epoch, "road": path, "still_held": list(entry.epochs), "persisted": persisted},
        )
        self._freed()
        left = f"; {len(entry.epochs)} more stops hold it" if entry.locked else " and may move when told to"
        return success(
            f"{robot_id} is free of {verdict.epoch}{left}.",
            epoch=verdict.epoch,
            locked=entry.locked,
            epochs=list(entry.epochs),
        )

    def clear_local(self, who: str, robot_ids: Iterable[str] | None = None) -> dict[str, tuple[Lockout, ...]]:
        """Clear every lockout of these robots, or all, for the operator ``who``."""
        robots = self.robots
        cleared: dict[str, tuple[Lockout, ...]] = {}
        for name in robots.keys() & set(robots if robot_ids is None else robot_ids):
            entry = robots[name]
            gone = entry.latch.clear()
            if not gone:
                continue
            cleared[name] = gone
            persisted = self._kept([entry])
            epochs = [each.epoch for each in gone]
            queue_safety_event("resume_local", name, {"who": who, "epochs": epochs, "persisted": persisted})
            logger.warning("%s was cleared at this machine by %s.", name, who)
        self._freed()
        return cleared

    def lockouts(self) -> dict[str, tuple[Lockout, ...]]:
        """Return the locked robots and their lockouts."""
        return {name: entry.latch.state.all for name, entry in self.robots.items() if entry.locked}

    def originals(self, network: str) -> list[Original]:
        """Return the stops of ``network`` that lock robots here, as they arrived."""
        return self._originals.of(self._held(), network)

    def stated_again(self, network: str, epoch: str, payload: bytes, age_s: float) -> None:
        """Take the age of a missed stop that locks robots here from a further answer."""
        self._originals.younger(network, epoch, payload, uptime() - age_s)

    def hold(self, seconds: float) -> None:
        """Hold the motions of every robot for so long; return at once."""
        for entry in self.robots.values():
            for gate in entry.gates:
                gate.hold(seconds)

    def _clear_one(self, who: str, robot_id: str) -> str:
        entry = self.robots.get(robot_id)
        if entry is None or robot_id not in self.clear_local(who, [robot_id]):
            return NOT_LOCKED if robot_id in self.robots else LEFT
        return NOT_KEPT if entry.key and entry.latch.state is not entry.on_disk else CLEARED

    def _repeat(self, order: StopOrder, robots: Collection[Registered], on_report: OnReport) -> None:
        for entry in robots:
            report = entry.report_again(order)
            # Only a robot that stopped and stays locked: whoever claims to have its answer silences nothing else.
            if report is None or (report.stopped and report.persisted is not False and entry.wire_id in order.answered):
                continue
            on_report(report)
        if any(entry.crowded and order.epoch not in entry.epochs for entry in robots):
            self._counted.add(order.source)
        late = order.original is not None and not self._originals.has(order.epoch, order.network)
        if late and any(entry.latch.state.can_resume(order.epoch) for entry in robots):
            # It came without its bytes first, from the framework or from a device here.
            self._note_original(order)

    def _note_original(self, order: StopOrder) -> None:
        if order.original is not None:
            received = uptime() - (time.monotonic() - order.received) - order.age_s
            learnt = order.path == MISSED
            self._originals.add(Original(order.epoch, order.source, order.original, order.network, received, learnt))

    def _keep(self, entries: Iterable[Registered], *, crowds: bool = False) -> None:
        # One at a time, so that no older state is written over a newer one.
        with self._keeping:
            due = [each for each in entries if each.unsaved or (crowds and each.crowd_unsaved)]
            self._originals.keep(self._held(due))
            kept = {each: self._record_of(each) for each in due}
            try:
                if kept:
                    self.store.save({entry.key: record for entry, record in kept.items() if entry.key})
            except BaseException:
                for entry in kept:
                    entry.keep_again = True
                raise
            for entry, record in kept.items():
                entry.on_disk, entry.crowd_on_disk = record.state, record.crowd
                if record.resumed is not None:
                    entry.resumed_on_disk = record.resumed
                if entry.keep_again:
                    entry.keep_again = False
                    logger.warning("The lockout file of %s is written now.", entry.robot_id)
                    queue_safety_event("lockout_kept", entry.robot_id, {"epochs": list(record.state.epochs)})

    def _record_of(self, entry: Registered) -> StoredLockout:
        latch = entry.latch
        state = latch.state
        return StoredLockout(
            state,
            latch.seen,
            entry.wire_id,
            tuple(self._originals.of(frozenset(state.resumable))),
            entry.resumed if entry.resumed_unsaved else None,
            latch.crowd,
        )

    def _held(self, leaving: Iterable[Registered] = ()) -> frozenset[str]:
        """Return the epochs by which a robot of this process is locked."""
        return frozenset(each for entry in (*self.robots.values(), *leaving) for each in entry.latch.state.resumable)

    def _kept(self, entries: Iterable[Registered]) -> bool:
        try:
            self._keep(entries)
        except OSError as exc:
            logger.critical("The lockout file was not written (%s): until it is, a restart forgets this.", exc)
            return False
        return True

    def _keep_again(self) -> None:
        """Write what could not be written; the log and the audit say when it is."""
        due = [each for each in self.robots.values() if each.keep_again or each.crowd_unsaved]
        new = {each: each.resumed for each in self.robots.values() if each.unrecorded}
        if (due or new) and time.monotonic() >= self._keep_at:
            self._keep_at = time.monotonic() + KEEP_AGAIN_S
            with contextlib.suppress(OSError):  # a lockout that is not written was reported at first
                self._keep(due, crowds=True)
                self._record_new(new)

    def _record_new(self, resumed: Mapping[Registered, ResumedEpochs]) -> None:
        with self._keeping:
            self.store.save_resumed({entry.key: each for entry, each in resumed.items() if entry.key})
            for entry, each in resumed.items():
                entry.resumed_on_disk = each

    def _record(self, run: StopRun) -> None:
        order = run.order
        event = "remote_estop_engaged" if order.remote else "emergency_stop"
        for report in run.reports.values():
            if report.stopped and not report.names_its_epoch:
                self._counted.add(order.source)
                continue
            facts: dict[str, Any] = {
                **report.fields(),
                "source": order.source,
                "reason": order.reason,
                "road": order.path,
                "issued": order.issued,
                "pressed_at": order.pressed,
                "delay_s": order.delay_s(order.received_at),
                "timing": order.timing(order.received_at),
                **order.scope.field(),
            }
            queue_safety_event(event, report.robot_id, facts)
        if len(self._issued) < 1024 or order.source in self._issued:
            self._issued[order.source] = self._issued.get(order.source, 0) + 1
            if self._issued[order.source] == ISSUER_EXCESS:
                queue_safety_event("estop_issuer_excess", order.source or "unnamed", {"stops": ISSUER_EXCESS})

    def _freed(self) -> None:
        if not self.lockouts():
            self.checkin.rearm(time.monotonic())

    def _tick(self) -> None:
        counted = self._counted.take(time.monotonic())
        if counted is not None:
            queue_safety_event("estops_counted", "stop-lane", counted)
        silent = self.checkin.lapsed(time.monotonic())
        if silent is not None:
            names = ", ".join(silent) or "no safety controller was ever heard"
            reason = f"check-in lost: {names}, {self.checkin.timeout_s:g} s"
            self.begin(StopOrder(new_epoch(), "check-in", reason, path="check-in"))

    def _chore(self) -> None:
        self._keep_again()
        sightings().refresh()
        if any(entry.locked for entry in self.robots.values()):
            self._clearance.look()


_PLANE = SafetyPlane()


def plane() -> SafetyPlane:
    """The plane of this process."""
    return _PLANE
