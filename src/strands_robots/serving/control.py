"""Control lease of one robot: its holder, and the motions that it admits.

A robot is free or held. Motion carries the secret ``lease_id`` of the holder. On a free robot a motion without one
holds the robot until it has ended, so that two programs never move one arm in turns. Stops and reads ask for no lease,
and a lockout is separate and stronger. A lease prevents accidents among programs that behave; what keeps out others is
authorization and the operator's approval.

Leases live in memory: a restart of the robot's process ends them all. Their epochs outlive it, see
:mod:`~strands_robots.safety.resume`.

Nothing foreign delays the end of a lease. The stop executor carries out the halt, its verdict and the observers come
afterwards, and a robot whose state cannot be read in time counts as moving.
"""

from __future__ import annotations

import hmac
import math
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, cast

from strands_robots.contract import Observers
from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.authorization import ANONYMOUS, Leave, caller_name
from strands_robots.safety.process import undisturbed
from strands_robots.safety.resume import configured_keys, outdated_take, reserve_epochs, unproven_take
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.workers import UNBOUNDED, BoundedCall
from strands_robots.stop_log import stop_logger
from strands_robots.threads import WokenThread

logger = stop_logger(__name__)

HUMAN, AGENT, POLICY = "human", "agent", "policy"
KINDS = (HUMAN, AGENT, POLICY)

TTL_S = 60.0
"""A lease's time where none is asked for."""

DISPLACED_MAX = 16
"""Former holders of a robot that are still told that they were displaced."""

FOLLOW = "teleop_receive"
"""The motion of a human: a leader's stream."""

STATUS_S = 0.25
"""Longest wait of a call for the robot's own word that its motion has ended. Without it the motion goes on."""

LATE_STATUS_S = 0.03
"""Least time for it at the end of a lease."""

EPOCH_S = 1.0
"""Longest wait of a call for the disk to reserve the first epoch."""

START_WAIT_S = 1.0
"""Longest wait of a motion for the start of another caller's, which the robot may yet refuse."""

LOOK_S = 0.02
"""Seconds between two looks whether a motion has begun."""

AHEAD_S = 0.25
"""Time before the end of a lease in which its robot is read: one at rest by its own word is not halted."""

Halt = Callable[[str], Future[StopVerdict] | None]
"""Orders a halt for a reason, and returns before it is carried out; None where there is no verdict to wait for."""


class NotHolderError(StrandsRobotsError, RuntimeError):
    """Motion of one who does not hold the robot; ``envelope`` is the answer.

    Its ``code`` is ``not_holder``, ``displaced`` or ``lease_over``.
    """

    def __init__(self, text: str, code: str, **facts: Any) -> None:
        super().__init__(text)
        self.envelope: Envelope = error(text, code=code, **facts)

    def naming(self, leader: str) -> NotHolderError:
        """Return it with the leader that drives the robot."""
        facts = {name: value for name, value in self.envelope.items() if name not in ("status", "content", "reason")}
        return NotHolderError(f"{self} {leader} leads it.", **facts, leader=leader)


@dataclass(frozen=True, slots=True)
class Lease:
    """One holder's lease. Times are monotonic seconds.

    Attributes:
        ttl_s: it is over so long after its last use; None for a lease without such a time.
        until: the moment at which it is over.
        one_motion: it is over with the motion that it was made for.
        begun: a motion under it has begun; a lease of one motion without one is given back.
    """

    holder: str
    kind: str
    lease_id: str = field(repr=False)
    ttl_s: float | None = None
    until: float | None = None
    one_motion: bool = False
    begun: bool = False

    def left(self, now: float) -> float | None:
        """Return the seconds left, None for the lease of one motion."""
        return None if self.until is None or self.one_motion else round(max(self.until - now, 0.0), 3)


@dataclass(frozen=True, slots=True)
class ControlChange:
    """A change of the holder, as observers are told.

    Attributes:
        event: ``acquired``, ``released``, ``expired`` or ``taken``.
        reason: the one that a human gave for taking control.
    """

    event: str
    robot: str
    holder: str
    kind: str
    epoch: int
    reason: str = ""


OnChange = Callable[[ControlChange], None]


class FirstEpoch:
    """First epoch of the leases of one robot, 0 until it is reserved; thread-safe.

    Args:
        reserve: returns it; :func:`reserve_epochs` by default.
    """

    def __init__(self, reserve: Callable[[], int] = reserve_epochs) -> None:
        self._reserve = BoundedCall(reserve)
        self._changing = threading.Lock()
        self.value = 0

    def reserved(self, within: float) -> str | None:
        """Reserve it unless that is done; return what prevents it, or None.

        A disk that hangs is waited for at most ``within`` seconds.
        """
        if self.value:
            return None
        try:
            value = self._reserve(within)
        except (OSError, ValueError, RuntimeError) as exc:
            return f"{type(exc).__name__}: {exc}"
        with self._changing:
            self.value = self.value or value
        return None


class StartingMotions:
    """The motions that are about to begin, and those that wait for their start.

    Args:
        changing: the lock of the robot's lease.
    """

    def __init__(self, changing: threading.RLock) -> None:
        self._closed = threading.Condition(changing)
        self.begun: dict[object, Callable[[], bool]] = {}
        """The motions that are about to begin, each with what is true once it has begun."""
        self.waiting: list[object] = []

    @property
    def undecided(self) -> bool:
        """True while the robot may yet refuse one of them."""
        return any(not begun() for begun in self.begun.values())

    def close(self, motion: object) -> None:
        """Note that it has begun or was refused; who waits looks anew."""
        self.begun.pop(motion, None)
        self._closed.notify_all()

    def wait(self, undecided: Callable[[], bool], free: Callable[[], bool]) -> None:
        """Wait for the start of another's motion, in the order of arrival.

        A call that the robot refuses would keep others from it otherwise, again and again.

        Args:
            undecided: whether the motion of another holds the robot, and may yet be refused.
            free: whether nobody holds it.
        """
        if not undecided() and not (self.waiting and free()):
            return
        turn = object()
        self.waiting.append(turn)
        deadline = time.monotonic() + START_WAIT_S
        while not (self.waiting[0] is turn if free() else not undecided()) and time.monotonic() < deadline:
            # A motion that begins tells nobody.
            self._closed.wait(LOOK_S)
        self.waiting.remove(turn)
        self._closed.notify_all()


class TimedLease(Protocol):
    """A lease that ends by itself."""

    @property
    def due(self) -> float | None:
        """The monotonic moment at which it is over; None where there is none."""

    def expire(self, ahead: float) -> None:
        """End it in its time; return at once where that is more than ``ahead`` s away."""


class LeaseWatch:
    """One thread that ends leases in time."""

    def __init__(self) -> None:
        self._changing = threading.Lock()
        self._leases: set[TimedLease] = set()
        self._thread = WokenThread("control-leases", self._end_due, self._due_in)

    @property
    def running(self) -> bool:
        """True while there is a lease to end."""
        return bool(self._leases)

    def add(self, lease: TimedLease) -> None:
        """Watch a lease until it is over.

        Raises:
            RuntimeError: no thread can be started.
        """
        with self._changing:
            self._leases.add(lease)
        self._thread.wake()

    def _due_in(self) -> float:
        with self._changing:
            moments = [at for each in self._leases if (at := each.due) is not None]
        return min(moments, default=math.inf) - AHEAD_S - time.monotonic()

    def _end_due(self) -> None:
        now = time.monotonic()
        with self._changing:
            due = {each: at for each in self._leases if (at := each.due) is not None}
            ending = [each for each, at in due.items() if at - AHEAD_S <= now]
            self._leases = set(due).difference(ending)
        for each in ending:
            UNBOUNDED.submit(partial(self._end, each))

    def _end(self, lease: TimedLease) -> None:
        # A whole collection at this moment would hold the halts back.
        calm = undisturbed(many=False)
        try:
            lease.expire(AHEAD_S)
        except Exception:
            logger.critical("What the holder of a lease moved was not halted at its end.", exc_info=True)
        finally:
            calm()
            # It may have been renewed meanwhile.
            if lease.due is not None:
                self.add(lease)


watch: Callable[[ControlLease], None] = LeaseWatch().add
"""Ends a lease when its time is over."""


class ControlLease:
    """The lease of one robot, or of one robot of a world; thread-safe.

    Args:
        robot: its name in messages.
        halt: stops what the robot does, without a lockout.
        moving: whether it moves now, None where its state is unknown; asked only while the lease of one motion is in
            the way, on a thread of its own. It may hang.
        led_by: the leader at the robot's own machine that drives it, empty without one.
        end_pauses: ends the streams of remote leaders that pause; it waits for nothing.
        hardware: False for a simulation, which a human may take without a key where none is configured.
        clock: monotonic seconds.
        wall: wall-clock seconds, against which an assertion's age is held.
        watched: has :meth:`expire` called at :attr:`due`.
        first_epoch: where :attr:`epoch` begins when an operator's key is configured; at 0 by default.
    """

    def __init__(
        self,
        robot: str,
        halt: Halt,
        moving: Callable[[], bool | None],
        *,
        led_by: Callable[[], str] = lambda: "",
        end_pauses: Callable[[], None] = lambda: None,
        hardware: bool = True,
        keys: Callable[[], Sequence[bytes]] = configured_keys,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
        watched: Callable[[ControlLease], None] = watch,
        first_epoch: FirstEpoch | None = None,
    ) -> None:
        self._robot = robot
        self._halt = halt
        self._moving = BoundedCall(moving)
        self._fault = ""
        self._led_by, self._end_pauses = led_by, end_pauses
        self.hardware = hardware
        self._keys = keys
        self._clock, self._wall, self._watched = clock, wall, watched
        self._changing = threading.RLock()
        self._lease: Lease | None = None
        self._starting = StartingMotions(self._changing)
        self._displaced: dict[str, str] = {}
        self._observers = Observers[ControlChange]()
        self._first_epoch = first_epoch
        self._holders = 0

    @property
    def epoch(self) -> int:
        """Number that rises with every new holder, over restarts of the process as well."""
        return self._holders + (0 if self._first_epoch is None else self._first_epoch.value)

    @property
    def due(self) -> float | None:
        """The monotonic moment at which the lease is over; None where there is none."""
        lease = self._lease
        return None if lease is None else lease.until

    def observe(self, observer: OnChange) -> Callable[[], None]:
        """Tell ``observer`` of every change of the holder; return what ends that."""
        return self._observers.subscribe(observer)

    def facts(self) -> dict[str, Any]:
        """Return the holder as everyone may read it."""
        self._settle()
        if self._keys():
            self._unreserved()
        lease = self._lease
        if lease is None:
            return {"held": False, "epoch": self.epoch}
        return {
            "held": True,
            "holder": lease.holder,
            "kind": lease.kind,
            "epoch": self.epoch,
            "for_one_motion": lease.one_motion,
            "expires_in_s": lease.left(self._clock()),
        }

    def acquire(self, caller: object, kind: str, ttl_s: float, lease_id: str = "") -> Envelope:
        """Give the free robot to ``caller``; its holder gets a lease anew.

        Raises:
            NotHolderError: another holds it.
        """
        holder = caller_name(caller) or ANONYMOUS
        self._give_way(holder)
        self._settle()
        leader = self._led_by()
        with self._changing:
            lease = self._lease
            if lease is not None and not _owns(lease, holder, lease_id):
                raise self._not_holder("acquireControl", lease)
            if leader:
                # Whoever sits at the robot must not be halted by a lease that ends.
                text = f"acquireControl is refused: {leader} ({HUMAN}) leads it."
                raise NotHolderError(text, "not_holder", holder=leader, kind=HUMAN)
            given = self._give(holder, kind, ttl_s)
            answer = self._answer(given, self.epoch)
        self._tell("acquired", given)
        return answer

    def renew(self, lease_id: str) -> Envelope:
        """Start the lease's time anew.

        Raises:
            NotHolderError: the lease is not held any more.
        """
        self._settle()
        with self._changing:
            lease = self._used("renewControl", lease_id)
            return success(f"{lease.holder} holds control.", epoch=self.epoch, expires_in_s=lease.left(self._clock()))

    def release(self, lease_id: str) -> Envelope:
        """Free the robot; what it does goes on to its own end.

        Raises:
            NotHolderError: the lease is not held any more.
        """
        self._settle()
        with self._changing:
            lease = self._used("releaseControl", lease_id)
            self._lease = None
        self._tell("released", lease)
        return success(f"{lease.holder} has released control.", epoch=self.epoch)

    def take(self, caller: object, reason: str, robot: str, assertion: object) -> Envelope:
        """Give the robot to a human; its motion is halted before the answer.

        Args:
            robot: the name that the assertion has to bear.
            assertion: of :func:`~strands_robots.safety.resume.sign_take`.
        """
        holder, keys = caller_name(caller) or ANONYMOUS, self._keys()
        problem = self._unproven(robot, assertion, keys)
        with self._changing:
            if problem is None and keys:
                problem = outdated_take(cast("dict[str, Any]", assertion), self.epoch, self._wall())
            before = self._lease
            lease = self._give(holder, HUMAN, TTL_S) if problem is None else None
            epoch = self.epoch
            if lease is not None and before is not None:
                self._displaced[before.lease_id] = holder
                while len(self._displaced) > DISPLACED_MAX:
                    del self._displaced[next(iter(self._displaced))]
        if lease is None:
            logger.warning("%s: takeControl of %s refused: %s.", robot, holder, problem)
            return error(f"takeControl is refused: {problem}.", code="not_proven", epoch=epoch)
        # Before the answer: whoever took control must not meet the last write of the one who lost it.
        halting = self._halt(f"control taken by {holder}: {reason}")
        self._tell("taken", lease, reason)
        return self._answer(lease, epoch, None if halting is None else halting.result())

    def admit(
        self,
        verb: str,
        caller: object,
        lease_id: str,
        ttl_s: float = 0.0,
        *,
        hold: bool = True,
        begun: Callable[[], bool] = lambda: False,
    ) -> Leave:
        """Admit a motion of the holder, or hold a free robot for it.

        Args:
            ttl_s: on a free robot ``lease_id`` is a secret of the caller's own, and the motion is halted so long after
                the last renewal; 0 for a motion that needs none. A held lease lasts no longer than that from then on.
            hold: False to ask and change nothing.
            begun: returns whether something moves by it already, before the leave is settled.

        Raises:
            NotHolderError: another holds the robot, or the lease is over.
        """
        holder = caller_name(caller) or ANONYMOUS
        self._give_way(holder)
        if self._lease is not None:
            self._settle()
        with self._changing:
            if self._lease is not None or self._starting.waiting:
                if hold:
                    self._starting.wait(partial(self._undecided, holder, lease_id), lambda: self._lease is None)
                elif self._undecided(holder, lease_id):
                    return Leave()
            before = self._lease
            if lease_id and (before is not None or not ttl_s):
                self._required(verb, lease_id)
            elif before is not None and not _owns(before, holder):
                raise self._not_holder(verb, before)
            if not hold:
                return Leave()
            if before is not None:
                after = self._used(verb, lease_id, ttl_s) if lease_id else before
            else:
                # Without a time it is known by its holder's name alone, and nobody can renew it.
                kind, secret = HUMAN if verb == FOLLOW else AGENT, lease_id if ttl_s else secrets.token_hex(16)
                until = self._clock() + ttl_s if ttl_s else None
                after = Lease(holder, kind, secret, ttl_s or None, until, one_motion=True)
                if ttl_s:
                    self._hold(after)
                else:
                    self._lease = after
            motion = object()
            if after.one_motion:
                self._starting.begun[motion] = begun
            return Leave(lambda begun: self._admitted(motion, begun, before, after))

    def _undecided(self, holder: str, lease_id: str) -> bool:
        """True while the robot may yet refuse the motion of another that holds it."""
        lease = self._lease
        if lease is None or lease.begun or not (lease.one_motion and self._starting.undecided):
            return False
        return not _owns(lease, holder, lease_id)

    def _admitted(self, motion: object, begun: bool, before: Lease | None, after: Lease) -> None:
        """Note that a motion has begun, or take back what it changed."""
        with self._changing:
            self._starting.close(motion)
            lease = self._lease
            if lease is None or lease.lease_id != after.lease_id:
                return
            if begun:
                self._lease = lease if lease.begun else replace(lease, begun=True)
            elif lease.one_motion and not lease.begun and not self._starting.begun:
                self._lease = None
            elif lease is after is not before and before is not None:
                self._hold(before)  # the watch may wait for a later moment

    def refuse_others(self, verb: str, caller: object, lease_id: str) -> None:
        """Refuse a motion of the whole world, unless it is the holder's.

        Raises:
            NotHolderError: another holds the robot.
        """
        self._give_way(caller_name(caller) or ANONYMOUS)
        self._settle()
        with self._changing:
            lease = self._lease
            if lease is not None and not _owns(lease, caller_name(caller) or ANONYMOUS, lease_id):
                raise self._not_holder(verb, lease)

    def expire(self, ahead: float = 0.0) -> None:
        """End a lease whose time is over, and order the halt of what its holder began.

        Args:
            ahead: seconds before that time from which the robot's state may be read. The call then lasts until it.
        """
        lease = self._lease
        if lease is None or lease.until is None or (left := lease.until - self._clock()) > ahead:
            return
        # An unknown state is no rest: what cannot be read is halted.
        moves, fault = True, ""
        if lease.one_motion and not self._starting.begun:
            state, fault = self._state(max(left, LATE_STATUS_S) if ahead else STATUS_S)
            moves = state is not False
        # A motion that is admitted meanwhile renews the lease, so a robot that was at rest still is.
        time.sleep(max(0.0, lease.until - self._clock()))
        with self._changing:
            if self._lease is not lease:  # renewed or given to another meanwhile
                return
            self._lease = None
        try:
            if moves:
                self._halt(f"the control lease of {lease.holder} is over")
        finally:
            self._note(fault)
            if moves:
                logger.warning("%s: the control lease of %s is over; its motion is halted.", self._robot, lease.holder)
                self._tell("expired", lease)

    def _state(self, within: float) -> tuple[bool | None, str]:
        """Return whether it moves, None if unknown, and why it could not be read."""
        try:
            return self._moving(within), ""
        except Exception as exc:  # noqa: BLE001 - a foreign status raises what it likes
            return True, f"{type(exc).__name__}: {exc}"

    def _note(self, fault: str) -> None:
        """Log a fault of the robot's state, unless it is the last one still."""
        last, self._fault = self._fault, fault
        if fault and fault != last:
            logger.error("%s: its state could not be read, so it counts as moving: %s", self._robot, fault)

    def _settle(self) -> None:
        """End a lease that is over, by its time or with its motion."""
        self.expire()
        lease = self._lease
        if lease is None or not lease.one_motion or self._starting.begun:
            return
        moves, fault = self._state(STATUS_S)
        self._note(fault)
        if moves:
            return
        with self._changing:
            if self._lease is lease and not self._starting.begun:
                self._lease = None

    def _give_way(self, holder: str) -> None:
        """Let the robot of a leader that pauses be free for another caller."""
        lease = self._lease
        if lease is None or (lease.one_motion and lease.holder != holder):
            self._end_pauses()

    def _hold(self, lease: Lease) -> Lease:
        """Make it the robot's lease, which ends in its time from now on."""
        before, self._lease = self._lease, lease
        try:
            self._watched(self)
        except RuntimeError:  # no thread can be started
            self._lease = before
            raise
        return lease

    def _give(self, holder: str, kind: str, ttl_s: float) -> Lease:
        lease = self._hold(Lease(holder, kind, secrets.token_hex(16), ttl_s, self._clock() + ttl_s))
        self._holders += 1
        return lease

    def _answer(self, lease: Lease, epoch: int, verdict: StopVerdict | None = None) -> Envelope:
        held = f"{lease.holder} holds control for {lease.ttl_s:g} s"
        text = f"{held}; give lease_id with every motion, each one renews it."
        if verdict is not None and not verdict.stopped:
            text = f"{text} {self._robot} may still move: {doubts(verdict)}"
        return success(
            text,
            lease_id=lease.lease_id,
            epoch=epoch,
            kind=lease.kind,
            expires_in_s=lease.ttl_s,
        )

    def _used(self, verb: str, lease_id: str, at_most_s: float = 0.0) -> Lease:
        lease = self._required(verb, lease_id)
        if lease.ttl_s is not None:
            ttl_s = min(lease.ttl_s, at_most_s or lease.ttl_s)
            lease = replace(lease, ttl_s=ttl_s, until=self._clock() + ttl_s)
            if at_most_s:
                return self._hold(lease)  # the watch may wait for a later moment
            self._lease = lease
        return lease

    def _required(self, verb: str, lease_id: str) -> Lease:
        lease = self._lease
        if lease is not None and _is(lease, lease_id):
            return lease
        taker = self._displaced.get(lease_id)
        if taker is not None:
            text = f"{verb} is refused: {taker} has taken control. Acquire it anew when it is free."
            raise NotHolderError(text, "displaced", holder=taker)
        if lease is not None:
            raise self._not_holder(verb, lease)
        raise NotHolderError(f"{verb} is refused: this lease is over. Acquire control anew.", "lease_over")

    def _not_holder(self, verb: str, lease: Lease) -> NotHolderError:
        left = lease.left(self._clock())
        until = "until its motion ends" if left is None else f"for {left:.1f} s more"
        return NotHolderError(
            f"{verb} is refused: {lease.holder} ({lease.kind}) holds control {until}.",
            "not_holder",
            holder=lease.holder,
            kind=lease.kind,
            expires_in_s=left,
        )

    def _unproven(self, robot: str, assertion: object, keys: Sequence[bytes]) -> str | None:
        """Return why the robot is not shown to be taken by an operator, or None."""
        if not keys:
            setting = "STRANDS_MESH_RESUME_PUBLIC_KEY; strands-robots keys resume"
            return f"no operator's key is configured here ({setting})" if self.hardware else None
        problem = unproven_take(assertion, robot, keys)
        if problem is not None:
            return problem
        unreserved = self._unreserved()
        if unreserved is not None:
            return f"it could be taken again with this assertion after a restart, because {unreserved}"
        return None

    def _unreserved(self) -> str | None:
        """Reserve the first epoch; return what prevents it, or None."""
        problem = None if self._first_epoch is None else self._first_epoch.reserved(EPOCH_S)
        return None if problem is None else f"its epoch cannot be kept in the state directory ({problem})"

    def _tell(self, event: str, lease: Lease, reason: str = "") -> None:
        change = ControlChange(event, self._robot, lease.holder, lease.kind, self.epoch, reason)
        self._observers.notify(change)


def doubts(verdict: StopVerdict) -> str:
    """Return why a robot may still move, by what was asked to stop."""
    reasons = {**verdict.unknown, **verdict.not_stopped}
    return "; ".join(f"{name}: {why}" for name, why in reasons.items())


def _owns(lease: Lease, holder: str, lease_id: str = "") -> bool:
    """Return whether it is the caller's: a name is enough where it has no secret."""
    return _is(lease, lease_id) or (lease.one_motion and lease.ttl_s is None and lease.holder == holder)


def _is(lease: Lease, lease_id: str) -> bool:
    return bool(lease_id) and hmac.compare_digest(lease.lease_id.encode(), lease_id.encode())
