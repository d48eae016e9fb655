"""Stop executor: halts of this process, on ready threads, within a deadline.

The safety plane, an RPC ``stop``, the mesh's ``stop``, ``HardwareRobot.halt`` and a departing process submit to it.
:meth:`StopExecutor.submit` takes no lock that is held during a halt, so a robot that blocks delays no other robot.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import logging
import os
import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, TypeGuard, TypeVar, cast, runtime_checkable

from strands_robots import settings
from strands_robots.contract import Haltable, body_of
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.stopping import StopVerdict, graded

logger = logging.getLogger(__name__)

RESERVE = 3
"""Threads that stand ready for all targets without a thread of their own."""

WAITING_MAX = 4096
"""Stops of one target that wait for its next halt. Beyond it the oldest is answered by its deadline alone."""

STUCK_MAX = 8
"""Threads that one target may keep blocked in its halts before no further thread is given to it."""

WATCH_S = 0.05
"""Seconds between two looks for new stops; a deadline that is further away is kept to the millisecond."""

ENDING_S = 2.0
"""Seconds besides the longest deadline after which a halt without an answer is given up: the process is ending."""

DIRECT_SHARE, RETURN_SHARE = 0.9, 0.85
"""Parts of the deadline after which a direct target is answered for, and by which its halt should return.

The rest is for the verdict to reach the caller in time."""


@runtime_checkable
class NotesMotion(Protocol):
    """Target that notes its motions before its permits are void."""

    def halt_ordered(self) -> None:
        """Note what moves. Must not block."""


@runtime_checkable
class DirectTarget(NotesMotion, Protocol):
    """Target whose ``halt`` goes through the executor to :meth:`halt_here`.

    It says itself what is known while its halt blocks, and no second thread is started for it meanwhile: whatever
    blocks the first, such as its bus, would block the second.
    """

    def halt_here(self, reason: str, deadline: float) -> StopVerdict:
        """Halt on this thread by ``deadline`` (monotonic s), unless the device blocks."""

    def unanswered(self, why: str) -> StopVerdict:
        """Return the verdict while :meth:`halt_here` has not returned. Must not block."""


Target = Haltable | DirectTarget
H = TypeVar("H", bound=Callable[..., StopVerdict])


def through_executor(halt: H) -> H:
    """Mark a public ``halt`` that only submits its target.

    A subclass that overrides it loses the mark, and is halted by its own.
    """
    vars(halt)["through_executor"] = True
    return halt


def note_motion(target: object) -> None:
    """Let a target note what moves, before its permits are void.

    Never raises: a stop follows.
    """
    # A check of a protocol costs more than a stop may.
    note = getattr(target, "halt_ordered", None)
    if note is not None:
        try:
            note()
        except Exception:
            logger.exception("A robot could not note what moves before its stop.")


def _is_direct(target: object) -> TypeGuard[DirectTarget]:
    kind = type(target)
    halt = getattr(kind, "halt", None)
    return hasattr(kind, "halt_here") and (halt is None or getattr(halt, "through_executor", False))


Answered = Callable[[StopVerdict], None]


@dataclass(eq=False, slots=True)
class _Stop:
    """One submitted stop. Times are monotonic seconds."""

    slot: _Slot | None
    target: Target | None
    name: str
    reason: str
    within: float
    since: float
    answered: Answered | None
    direct: bool = False
    extended: bool = False
    begun: float | None = None
    submitted: float = field(default_factory=time.monotonic)
    future: Future[StopVerdict] = field(default_factory=Future)
    answering: threading.Lock = field(default_factory=threading.Lock)

    def moment(self, part: float) -> float:
        """Return the moment at which ``part`` of the time to halt has passed."""
        return self.since + part * self.within

    def resolve(self, answer: object) -> None:
        """Hand out the graded answer of the halt, marked if it is late."""
        verdict, late = graded(answer, self.name), self.answered
        # Watched until the deadline, an answered stop must not keep its robot alive.
        self.slot = self.target = self.answered = None
        if not self._set(verdict) and late is not None:
            late(verdict)

    def extend(self) -> float | None:
        """Return the later deadline of a stop that waited behind another's halt.

        None where it has had it, or did not wait.
        """
        slot = self.slot
        running = None if slot is None else slot.running
        if self.direct or self.extended or not running or self.future.done():
            return None
        self.extended = True
        if self.begun is not None:
            return self.begun + self.within
        return None if any(each.future.done() for each in running) else self.moment(2.0)

    def expire(self) -> bool:
        """Answer for the target that did not; False where it has answered."""
        target = self.target
        if target is None or self.future.done():
            return False
        why = f"no answer in {self.within:g} s"
        verdict = StopVerdict(not_stopped={self.name: why})
        if _is_direct(target):
            try:
                verdict = graded(target.unanswered(why), self.name)
            except Exception:
                logger.exception("%s could not say what it does while its halt blocks.", self.name)
        return self._set(verdict)

    def _set(self, verdict: StopVerdict) -> bool:
        elapsed_ms = (time.monotonic() - self.submitted) * 1000
        # The callbacks of the first answer have returned before a late one is handed out.
        with self.answering:
            try:
                self.future.set_result(replace(verdict, elapsed_ms=elapsed_ms))
            except InvalidStateError:
                return False
            return True


class _Slot:
    """Halts of one target: waiting, running, and the thread that is woken.

    It does not refer to the target; only its stops do.
    """

    def __init__(self, name: str, wake: queue.SimpleQueue[_Slot | None]) -> None:
        self.name = name
        self.wake = wake
        self.waiting: deque[_Stop] = deque(maxlen=WAITING_MAX)
        self.running: list[_Stop] | None = None
        self.changing = threading.Lock()
        self.owners = 0
        self.stuck = 0
        self.thread: threading.Thread | None = None

    def next(self, done: list[_Stop] | None = None) -> list[_Stop] | None:
        """Take all waiting requests for one halt, or None.

        Args:
            done: what the calling thread took before.
        """
        with self.changing:
            if self.running is not done:
                self.stuck -= 1
                if self.running is not None:
                    return None
                # It was given up as stuck and is back; what could have no further thread goes on with it.
            taken = []
            while self.waiting:
                taken.append(self.waiting.popleft())
                taken[-1].begun = time.monotonic()
            self.running = taken or None
            return self.running

    def give_up(self, stuck: list[_Stop]) -> bool:
        """Abandon the thread that carries out ``stuck``; False if it has returned."""
        with self.changing:
            if self.running is not stuck:
                return False
            self.running = None
            self.stuck += 1
            return True


_Wake = queue.SimpleQueue[_Slot | None]


class StopExecutor:
    """Halts of robots on ready threads; one per process, thread-safe.

    A target that was attached owns a thread. All others share :data:`RESERVE` threads, and each that is taken is
    replaced at once, so that blocked halts never use them up. Stops of one target that arrive while a halt of it runs
    share the next halt, which begins after them. When a halt misses its deadline, a fresh thread takes over what waits.

    Args:
        start: starts a thread; a test fails it.
    """

    def __init__(self, start: Callable[[threading.Thread], None] = threading.Thread.start) -> None:
        self._start_thread = start
        self._slots: weakref.WeakValueDictionary[Hashable, _Slot] = weakref.WeakValueDictionary()
        self._attached: dict[Hashable, tuple[_Slot, object]] = {}
        self._creating, self._attaching, self._counting = threading.Lock(), threading.Lock(), threading.Lock()
        self._reserve: _Wake = queue.SimpleQueue()
        self._idle = 0
        self._reserved = False
        self._watched: deque[_Stop] = deque()
        self._watch_now: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._watcher: threading.Thread | None = None
        self._here = threading.local()
        self._numbers = itertools.count()

    def attach(self, target: Target, name: str) -> None:
        """Give ``target`` a ready thread, until it was detached as often or is garbage.

        Raises:
            RuntimeError: no thread can be started.
        """
        with self._attaching:
            self._watch_deadlines()
            slot, key = self._slot(target, name), _key(target)
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
            slot, end = self._attached.get(_key(target), (None, None))
            if slot is None:
                return
            slot.owners -= 1
            if slot.owners:
                return
            del self._attached[_key(target)]
            if isinstance(end, weakref.finalize):
                end.detach()
            inbox, thread = slot.wake, slot.thread
            slot.wake, slot.thread = self._reserve, None
            self._reserve.put(slot)
            inbox.put(None)
            if slot.running is not None or slot.waiting:
                # What waits behind a halt under way may fall to the reserve, which the watcher fills.
                self._reserved = True
                self._watch_now.put(None)
        if wait and thread is not None and thread is not threading.current_thread():
            thread.join(wait)

    def prepare(self) -> None:
        """Make the reserve ready for targets that are not attached."""
        with self._attaching:
            self._watch_deadlines()
            self._reserved = True
            try:
                self._refill()
            except RuntimeError:
                self._reserved = self._idle > 0
                raise

    def submit(
        self,
        target: Target,
        name: str,
        reason: str,
        *,
        within: float | None = None,
        since: float | None = None,
        answered: Answered | None = None,
    ) -> Future[StopVerdict]:
        """Void the target's permits, order its halt and return at once.

        Args:
            target: the robot. Wrappers of one robot, and equal frozen dataclasses, are the same target.
            name: what a verdict calls it where its halt names nothing itself.
            within: seconds to halt; ``STRANDS_HALT_DEADLINE_S`` by default.
            since: the moment from which they count, in monotonic seconds; now by default.
            answered: called with the verdict of the future, and again with that of a halt that returns too late for it.

        Returns:
            A future of the graded verdict. It is set at the latest when the time is over, and never to an exception.
        """
        limit = settings.number("STRANDS_HALT_DEADLINE_S") if within is None else within
        slot = self._slot(target, name)
        stop = _Stop(slot, target, name, reason, limit, time.monotonic() if since is None else since, answered)
        stop.direct = _is_direct(target)
        stop.future.set_running_or_notify_cancel()
        if answered is not None:
            stop.future.add_done_callback(lambda future: answered(future.result()))
        note_motion(target)
        gate = getattr(target, "gate", None)
        if isinstance(gate, MotionGate) and (stop.direct or slot.running is not None):
            # The halt of any other target voids permits itself, after it has seen what moves, unless it has to wait.
            gate.revoke()
        if slot in getattr(self._here, "serving", ()):
            # A halt that asks for itself again: this thread is the one that carries it out.
            self._serve(slot, [stop])
            return stop.future
        slot.waiting.append(stop)
        if not (self._reserved or slot.owners) and not self._prepared(name):
            self._serve(slot)
            return stop.future
        slot.wake.put(slot)
        # Not woken for it: the watcher looks often enough, and a thread that wakes takes time from the stop's own.
        self._watched.append(stop)
        if not (self._reserved or slot.owners) and not self._prepared(name):
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

    def _slot(self, target: Target, name: str) -> _Slot:
        key = _key(target)
        slot = self._slots.get(key)
        if slot is None:
            with self._creating:
                slot = self._slots.get(key)
                if slot is None:
                    slot = self._slots[key] = _Slot(name, self._reserve)
        return slot

    def _ready_thread(self, name: str) -> tuple[_Wake, threading.Thread]:
        inbox: _Wake = queue.SimpleQueue()
        thread = threading.Thread(target=self._work, args=(inbox,), name=f"halt-{name}", daemon=True)
        self._start_thread(thread)
        return inbox, thread

    def _end_with(self, target: Target, key: Hashable, slot: _Slot) -> object:
        """End the thread with the target, or keep a target that cannot be watched."""
        body = body_of(target)
        if isinstance(key, tuple):
            return body
        try:
            end = weakref.finalize(body, _end, self._attached, key, slot, self._reserve)
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

    def _work_in_reserve(self) -> None:
        while True:
            slot = self._reserve.get()
            with self._counting:
                self._idle -= 1
                used_up = self._idle == 0
            if used_up:
                self._watch_now.put(None)
            if slot is not None:
                self._serve(slot)
            del slot
            with self._counting:
                if self._idle >= RESERVE:
                    return
                self._idle += 1

    def _serve(self, slot: _Slot, nested: list[_Stop] | None = None) -> None:
        """Carry out requests at ``slot`` until none waits or another thread took over."""
        stops = nested or slot.next()
        while stops is not None:
            outer = getattr(self._here, "serving", ())
            self._here.serving = (*outer, slot)
            answer: object = None
            try:
                reason, target = stops[0].reason, stops[0].target
                # Nested, an overridden halt has called the one of its class.
                if _is_direct(target) or (nested and isinstance(target, DirectTarget)):
                    answer = target.halt_here(reason, max(each.moment(RETURN_SHARE) for each in stops))
                elif target is not None:
                    answer = cast(Haltable, target).halt(reason)
            except BaseException as exc:  # noqa: BLE001 - a stop that raises is a robot that may be moving
                answer = exc
            finally:
                self._here.serving = outer
            del target
            for stop in stops:
                stop.resolve(answer)
            stops = None if nested else slot.next(stops)

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

    def _refill(self) -> None:
        while True:
            # Counted first: a thread that has served a target meanwhile must not stay as one too many.
            with self._counting:
                if self._idle >= RESERVE or not self._reserved:
                    return
                self._idle += 1
            name = f"halt-reserve-{next(self._numbers)}"
            try:
                self._start_thread(threading.Thread(target=self._work_in_reserve, name=name, daemon=True))
            except BaseException:
                with self._counting:
                    self._idle -= 1
                raise

    def _watch(self) -> None:
        """Answer for halts that miss their deadline, and refill the reserve."""
        due: list[tuple[float, int, _Stop]] = []
        without_threads = False
        while True:
            try:
                self._take_new(due)
                self._refill()
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

    def _take_new(self, due: list[tuple[float, int, _Stop]]) -> None:
        """Wait for a stop, a taken thread of the reserve or the next deadline."""
        timeout = WATCH_S if not due else min(WATCH_S, max(0.0, due[0][0] - time.monotonic()))
        with contextlib.suppress(queue.Empty):
            self._watch_now.get(timeout=timeout)
        while self._watched:
            stop = self._watched.popleft()
            at = stop.moment(DIRECT_SHARE if stop.direct else 1.0)
            heapq.heappush(due, (at, next(self._numbers), stop))

    def _renew(self, stop: _Stop) -> None:
        """Let a fresh thread take over what waits behind a halt that missed its deadline."""
        slot = stop.slot
        if slot is None or stop.direct:
            return
        stuck = slot.running
        if stuck is None or not any(each.future.done() for each in stuck):
            return
        if slot.stuck >= STUCK_MAX:
            logger.critical("%s is stuck in its halt, and so are %d threads of it.", stop.name, slot.stuck)
            return
        try:
            with self._attaching:
                fresh = self._ready_thread(stop.name) if slot.owners else None
                if not slot.give_up(stuck):
                    if fresh is not None:
                        fresh[0].put(None)
                    return
                if fresh is not None:
                    before = slot.wake
                    slot.wake, slot.thread = fresh
                    # Where a thread of the reserve is the stuck one, the target's own still waits.
                    before.put(None)
            slot.wake.put(slot)
        except RuntimeError as exc:
            logger.critical("%s is stuck in its halt and no other thread can halt it: %s.", stop.name, exc)


def _key(target: Target) -> Hashable:
    """Return an identity that is equal for the same target."""
    body = body_of(target)
    params = getattr(type(body), "__dataclass_params__", None)
    if params is None or not (params.frozen and params.eq):
        return id(body)
    # By the identity of its parts, which may be robots without a hash, and by the value of a name.
    parts = (getattr(body, each.name) for each in fields(cast(Any, body)))
    return (type(body), *(part if isinstance(part, str) else id(part) for part in parts))


def _end(attached: dict[Hashable, tuple[_Slot, object]], key: Hashable, slot: _Slot, reserve: _Wake) -> None:
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
