"""Stop executor: halts of this process, on ready threads, within a deadline.

The safety plane, an RPC ``stop``, the mesh's ``stop``, ``HardwareRobot.halt`` and a departing process submit to it.
:meth:`StopExecutor.submit` takes no lock that is held during a halt, so a robot that blocks delays no other robot.
What has to be read of a robot for its verdict is read on other threads, so a halt never waits for the doubt of an
earlier one.
"""

from __future__ import annotations

import contextlib
import functools
import heapq
import itertools
import os
import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import cast

from strands_robots import settings
from strands_robots.safety.gate import OrderedStop
from strands_robots.safety.stop_targets import (
    Answered,
    Haltable,
    HaltedVerbs,
    HaltsInParts,
    PendingStops,
    SubmittedStop,
    Target,
    TargetSlot,
    body_of,
    has_parts,
    note_motion,
    revoke_permits,
    target_key,
    void_calls,
)
from strands_robots.safety.stopping import PendingVerdict, StopVerdict
from strands_robots.stop_log import stop_logger
from strands_robots.threads import ReadyThreads

logger = stop_logger(__name__)

RESERVE = 3
"""Threads that stand ready for all targets without a thread of their own."""

READERS = 1
"""Threads that stand ready to read robots after their halts."""

STUCK_MAX = 7
"""Threads of one target that may be given up as blocked; with the one that works there are eight.

The next one that returns serves all stops that wait."""

WATCH_S = 0.05
"""Seconds between two looks for new stops; a deadline that is further away is kept to the millisecond."""

ENDING_S = 2.0
"""Seconds besides the longest deadline after which a halt without an answer is given up: the process is ending."""

DIRECT_SHARE, RETURN_SHARE = 0.9, 0.85
"""Parts of the deadline after which a direct target is answered for, and by which its halt should return.

The rest is for the verdict to reach the caller in time."""


_Wake = queue.SimpleQueue[TargetSlot | None]


class StopExecutor:
    """Halts of robots on ready threads; one per process, thread-safe.

    A target that was attached owns a thread. All others share :data:`RESERVE` threads, and each that is taken is
    replaced at once, so that blocked halts never use them up. Stops of one target that arrive while a halt of it runs
    share the next halt, which begins after them. When a halt misses its deadline, a fresh thread takes over what waits.
    The same holds of readings for a verdict, which have threads of their own.

    Args:
        start: starts a thread; a test fails it.
    """

    def __init__(self, start: Callable[[threading.Thread], None] = threading.Thread.start) -> None:
        self._start_thread = start
        self._slots: weakref.WeakValueDictionary[Hashable, TargetSlot] = weakref.WeakValueDictionary()
        self._attached: dict[Hashable, tuple[TargetSlot, object]] = {}
        self._creating, self._attaching = threading.Lock(), threading.Lock()
        self._watched: deque[SubmittedStop] = deque()
        self._watch_now: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._watcher: threading.Thread | None = None
        used_up = functools.partial(self._watch_now.put, None)
        self._reserve = ReadyThreads("halt-reserve", RESERVE, self._serve, start, used_up)
        self._readers = ReadyThreads("halt-reading", READERS, self._read, start, used_up)
        self._here = threading.local()
        self._numbers = itertools.count()

    def attach(self, target: Target, name: str) -> None:
        """Give ``target`` a ready thread, until it was detached as often or is garbage.

        Raises:
            RuntimeError: no thread can be started.
        """
        with self._attaching:
            self._watch_deadlines()
            slot, key = self._slot(target, name), target_key(target)
            has_parts(type(target))  # remembered for the first stop
            if slot.owners == 0:
                slot.wake, slot.thread = self._ready_thread(name)
                # What was submitted to the reserve in between waits at the slot.
                slot.wake.put(slot)
                self._attached[key] = (slot, self._end_with(target, key, slot))
            slot.owners += 1

    def detach(self, target: Target, wait: float = 0.0) -> None:
        """End the ready thread with the last detach; wait for ``wait`` seconds.

        A thread that is blocked in a halt is left behind as a daemon.
        """
        with self._attaching:
            slot, end = self._attached.get(target_key(target), (None, None))
            if slot is None:
                return
            slot.owners -= 1
            if slot.owners:
                return
            del self._attached[target_key(target)]
            if isinstance(end, weakref.finalize):
                end.detach()
            inbox, thread = slot.wake, slot.thread
            slot.wake, slot.thread = self._reserve.items, None
            self._reserve.items.put(slot)
            inbox.put(None)
            if slot.halts.running is not None or slot.halts.waiting:
                # What waits behind a halt under way may fall to the reserve, which the watcher fills.
                self._reserve.wanted = True
                self._watch_now.put(None)
        if wait and thread is not None and thread is not threading.current_thread():
            thread.join(wait)

    def prepare(self) -> None:
        """Make the reserve ready for targets that are not attached."""
        with self._attaching:
            self._watch_deadlines()
            self._reserve.prepare()

    def submit(
        self,
        target: Target,
        name: str,
        reason: str,
        *,
        within: float | None = None,
        since: float | None = None,
        answered: Answered | None = None,
        voided: bool = False,
    ) -> Future[StopVerdict]:
        """Void the target's permits, order its halt and return at once.

        Args:
            target: the robot. Wrappers of one robot, and equal frozen dataclasses, are the same target.
            name: what a verdict calls it where its halt names nothing itself.
            within: seconds to halt; ``STRANDS_HALT_DEADLINE_S`` by default.
            since: the moment from which they count, in monotonic seconds; now by default.
            answered: called with the verdict of the future, and again with that of a halt that returns too late for it.
            voided: the caller has had it note what moves and voided its permits, and none is given since.

        Returns:
            A future of the graded verdict. It is set at the latest when the time is over, and never to an exception.
        """
        limit = settings.number("STRANDS_HALT_DEADLINE_S") if within is None else within
        slot = self._slots.get(target_key(target)) or self._slot(target, name)
        stop = SubmittedStop(slot, target, name, reason, limit, time.monotonic() if since is None else since, answered)
        stop.parts = has_parts(type(target))
        stop.direct = stop.parts and hasattr(type(target), "unanswered")
        stop.future.set_running_or_notify_cancel()
        if answered is not None:
            stop.future.add_done_callback(lambda future: answered(future.result()))
        if not voided:
            note_motion(target)
        stop.verbs = void_calls(target, OrderedStop(reason, stop.future))
        if not voided and (stop.direct or slot.halts.running is not None):
            # The halt of any other target voids permits itself, after it has seen what moves, unless it has to wait.
            revoke_permits(target)
        if slot in getattr(self._here, "serving", ()):
            # A halt that asks for itself again: this thread is the one that carries it out.
            self._serve(slot, [stop])
            return stop.future
        slot.halts.waiting.append(stop)
        if not (self._reserve.wanted or slot.owners) and not self._prepared(name):
            self._serve(slot)
            return stop.future
        slot.wake.put(slot)
        # Not woken for it: the watcher looks often enough, and a thread that wakes takes time from the stop's own.
        self._watched.append(stop)
        if not (self._reserve.wanted or slot.owners) and not self._prepared(name):
            # The target was detached meanwhile, and its thread may have ended.
            self._serve(slot)
        return stop.future

    def halt(self, target: Target, name: str, reason: str, *, within: float | None = None) -> StopVerdict:
        """Halt ``target`` and return its verdict, at the latest when ``within`` is over."""
        limit = settings.number("STRANDS_HALT_DEADLINE_S") if within is None else within
        halting = self.submit(target, name, reason, within=limit)
        try:
            return halting.result(2 * limit + ENDING_S)
        except TimeoutError:
            # No thread runs any more while the interpreter ends.
            return StopVerdict(unknown={name: "the process is ending, and no thread answers"})

    def _slot(self, target: Target, name: str) -> TargetSlot:
        key = target_key(target)
        slot = self._slots.get(key)
        if slot is None:
            with self._creating:
                slot = self._slots.get(key)
                if slot is None:
                    slot = self._slots[key] = TargetSlot(name, self._reserve.items)
        return slot

    def _ready_thread(self, name: str) -> tuple[_Wake, threading.Thread]:
        inbox: _Wake = queue.SimpleQueue()
        thread = threading.Thread(target=self._work, args=(inbox,), name=f"halt-{name}", daemon=True)
        self._start_thread(thread)
        return inbox, thread

    def _end_with(self, target: Target, key: Hashable, slot: TargetSlot) -> object:
        """End the thread with the target, or keep a target that cannot be watched."""
        body = body_of(target)
        if isinstance(key, tuple):
            return body
        try:
            end = weakref.finalize(body, _end, self._attached, key, slot, self._reserve.items)
        except TypeError:
            return body
        end.atexit = False
        return end

    def _work(self, inbox: _Wake) -> None:
        while (slot := inbox.get()) is not None:
            self._serve(slot)
            if slot.wake is not inbox:
                return
            del slot

    def _serve(self, slot: TargetSlot, nested: list[SubmittedStop] | None = None) -> None:
        """Carry out requests at ``slot`` until none waits or another thread took over."""
        stops = nested or slot.halts.next()
        while stops is not None:
            outer = getattr(self._here, "serving", ())
            self._here.serving = (*outer, slot)
            answer: object = None
            reason, target = stops[0].reason, stops[0].target
            deadline = max(each.since + RETURN_SHARE * each.within for each in stops)
            verbs = HaltedVerbs(target, [call for each in stops for call in each.verbs], [each.asker for each in stops])
            try:
                # Nested, an overridden halt has called the one of its class.
                if stops[0].parts or (nested and isinstance(target, HaltsInParts)):
                    answer = cast(HaltsInParts, target).halt_here(reason, deadline)
                elif target is not None:
                    answer = cast(Haltable, target).halt(reason)
            except BaseException as exc:  # noqa: BLE001 - a stop that raises is a robot that may be moving
                answer = exc
            finally:
                self._here.serving = outer
            answer = verbs.after(answer, slot.name, deadline)
            del target, verbs
            unread = [stop for stop in stops if not stop.halted(answer)]
            if unread:
                slot.readings.waiting.extend(unread)
                self._have_read(slot)
            del answer, unread
            stops = None if nested else slot.halts.next(stops)

    def _have_read(self, slot: TargetSlot) -> None:
        """Have the robot read on another thread."""
        try:
            if not self._readers.wanted:
                self._readers.prepare()
        except RuntimeError as exc:
            logger.critical("No thread can be started to read %s; it is read on its halt's: %s.", slot.name, exc)
            self._read(slot)
        else:
            self._readers.items.put(slot)

    def _read(self, slot: TargetSlot) -> None:
        """Read the robot of ``slot`` until every stop whose halt is over has its verdict."""
        stops = slot.readings.next()
        while stops is not None:
            _judge(slot.readings, stops)
            stops = slot.readings.next(stops)

    def _prepared(self, name: str) -> bool:
        try:
            self.prepare()
        except RuntimeError as exc:
            logger.critical("No thread can be started to halt %s; its halt runs on the caller's: %s.", name, exc)
            return False
        return True

    def _watch_deadlines(self) -> None:
        if self._watcher is None:
            watcher = threading.Thread(target=self._watch, name="halt-deadlines", daemon=True)
            self._start_thread(watcher)
            self._watcher = watcher

    def _watch(self) -> None:
        """Answer for halts that miss their deadline, and refill the reserve."""
        due: list[tuple[float, int, SubmittedStop]] = []
        without_threads = False
        while True:
            try:
                self._take_new(due)
                self._reserve.refill()
                self._readers.refill()
                if without_threads:
                    logger.warning("The threads that stand ready for stops are complete again.")
                without_threads = False
            except RuntimeError as exc:
                if not without_threads:
                    logger.critical("No thread can be started for stops of robots that block their halts: %s.", exc)
                without_threads = True
            except Exception:
                logger.critical("The deadlines of stops could not be read.", exc_info=True)
            late = []
            while due and due[0][0] <= time.monotonic():
                stop = heapq.heappop(due)[2]
                later = stop.extend()
                if later is not None and later > time.monotonic():
                    heapq.heappush(due, (later, next(self._numbers), stop))
                elif stop.expire():
                    late.append(stop)
            for stop in late:
                self._renew(stop)

    def _take_new(self, due: list[tuple[float, int, SubmittedStop]]) -> None:
        """Wait for a stop, a taken thread of the reserve or the next deadline."""
        timeout = WATCH_S if not due else min(WATCH_S, max(0.0, due[0][0] - time.monotonic()))
        with contextlib.suppress(queue.Empty):
            self._watch_now.get(timeout=timeout)
        while self._watched:
            stop = self._watched.popleft()
            at = stop.moment(DIRECT_SHARE if stop.direct else 1.0)
            heapq.heappush(due, (at, next(self._numbers), stop))

    def _renew(self, stop: SubmittedStop) -> None:
        """Let a fresh thread take over what waits behind a halt that missed its deadline."""
        slot, line = stop.slot, stop.pending_stops()
        if slot is None or line is None:
            return
        halts = line is slot.halts
        if halts and stop.direct:
            return
        what, done = ("halt", "halt it") if halts else ("reading", "read it")
        stuck = line.running
        if stuck is None or not any(each.future.done() for each in stuck):
            return
        if line.stuck >= STUCK_MAX:
            logger.critical("%s is stuck in its %s, and so are %d threads of it.", stop.name, what, line.stuck)
            return
        try:
            with self._attaching:
                fresh = self._ready_thread(stop.name) if halts and slot.owners else None
                if not line.give_up(stuck):
                    if fresh is not None:
                        fresh[0].put(None)
                    return
                if fresh is not None:
                    before = slot.wake
                    slot.wake, slot.thread = fresh
                    # Where a thread of the reserve is the stuck one, the target's own still waits.
                    before.put(None)
            (slot.wake if halts else self._readers.items).put(slot)
        except RuntimeError as exc:
            logger.critical("%s is stuck in its %s and no other thread can %s: %s.", stop.name, what, done, exc)


def _judge(line: PendingStops, stops: list[SubmittedStop]) -> None:
    """Read the robot until ``stops``, and what comes meanwhile, have their verdicts."""
    unread: list[SubmittedStop] = []
    fresh: list[SubmittedStop] | None = list(stops)
    while fresh is not None:
        unread += [each for each in fresh if not _resolved(each, lambda pending: pending.known())]
        if not unread:
            return
        newest = unread[-1].pending
        reading = _reading(newest)
        fresh = line.more(stops)
        # A thread that was given up looks no more.
        last, now = fresh is None, time.monotonic()
        unread = [each for each in unread if not _resolved(each, functools.partial(_judged, reading, last, now))]
        if unread and not fresh and newest is not None:
            time.sleep(newest.pause_s)


def _judged(reading: object, last: bool, now: float, pending: PendingVerdict) -> StopVerdict | None:
    return pending.judged(reading, last=last or now >= pending.until)


def _reading(pending: PendingVerdict | None) -> object:
    try:
        return None if pending is None else pending.read()
    except BaseException as exc:  # noqa: BLE001 - whatever a robot raises is judged
        return exc


def _resolved(stop: SubmittedStop, judge: Callable[[PendingVerdict], StopVerdict | None]) -> bool:
    """Resolve a stop by what ``judge`` says; False where that is nothing yet."""
    pending = stop.pending
    try:
        verdict = None if pending is None else judge(pending)
    except BaseException as exc:  # noqa: BLE001 - an answer that cannot be read is a robot that may be moving
        verdict = StopVerdict(unknown={stop.name: f"its answer cannot be read ({type(exc).__name__})"})
    if verdict is not None:
        stop.resolve(verdict)
    return verdict is not None or pending is None


def _end(attached: dict[Hashable, tuple[TargetSlot, object]], key: Hashable, slot: TargetSlot, reserve: _Wake) -> None:
    # Called by the garbage collector, on any thread: it may take no lock.
    attached.pop(key, None)
    inbox, slot.wake, slot.owners = slot.wake, reserve, 0
    inbox.put(None)


class _OfProcess:
    executor = StopExecutor()

    @classmethod
    def renew(cls) -> None:
        """Start anew in a forked child, which has none of its parent's threads."""
        cls.executor = StopExecutor()


os.register_at_fork(after_in_child=_OfProcess.renew)


def stop_executor() -> StopExecutor:
    """Return the executor of this process."""
    return _OfProcess.executor
