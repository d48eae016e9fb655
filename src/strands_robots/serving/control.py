"""Control lease of one robot: its holder, and the motions that it admits.

A robot is free or held. Motion carries the secret ``lease_id`` of the holder. On a free robot a motion without one
holds the robot until it has ended, so that two programs never move one arm in turns. Stops and reads ask for no lease,
and a lockout is separate and stronger. A lease prevents accidents among programs that behave; what keeps out others is
authorization and the operator's approval.

Leases live in memory: a restart of the robot's process voids them all.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol
from weakref import WeakKeyDictionary

from strands_robots.contract import AT_REST, RUNNING, Robot, WorldRobot, body_of
from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety import ed25519
from strands_robots.safety.authorization import ANONYMOUS, caller_name
from strands_robots.safety.resume import NEWEST_S, NONCES_MAX, OLDEST_S, configured_keys
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.serving.admissions import Admission, Admissions
from strands_robots.serving.control_changes import ControlChange, Observers, OnChange
from strands_robots.utils import shown

logger = logging.getLogger(__name__)

HUMAN, AGENT, POLICY = "human", "agent", "policy"
KINDS = (HUMAN, AGENT, POLICY)

TTL_S = 60.0
"""A lease's time where none is asked for."""

DISPLACED_MAX = 16
"""Former holders of a robot that are still told that they were displaced."""

FOLLOW = "teleop_receive"
"""The motion of a human: a leader's stream."""

PURPOSE = "take-control"
TAKE_FIELDS = frozenset({"v", "purpose", "robot", "epoch", "t", "nonce", "sig"})
"""Fields of the operator's assertion; ``sig`` is the Ed25519 signature over the canonical JSON of the others."""

VERSION = 1


class NotHolderError(StrandsRobotsError, RuntimeError):
    """Motion of one who does not hold the robot; ``envelope`` is the answer.

    Its ``code`` is ``not_holder``, ``displaced`` or ``lease_over``.
    """

    def __init__(self, text: str, code: str, **facts: Any) -> None:
        super().__init__(text)
        self.envelope: Envelope = error(text, code=code, **facts)


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


def sign_take(signing_key: Any, robot: str, epoch: int, *, clock: Callable[[], float] = time.time) -> dict[str, Any]:
    """Return the operator's assertion that takes ``robot`` from its holder."""
    body = {
        "v": VERSION,
        "purpose": PURPOSE,
        "robot": robot,
        "epoch": epoch,
        "t": clock(),
        "nonce": secrets.token_hex(16),
    }
    return {**body, "sig": ed25519.encode(signing_key.sign(ed25519.canonical(body)))}


class LeaseWatch:
    """One thread that ends leases in time; it lives as long as there is one."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._leases: set[ControlLease] = set()
        self._thread: threading.Thread | None = None

    @property
    def running(self) -> bool:
        """True while there is a lease to end."""
        return self._thread is not None

    def add(self, lease: ControlLease) -> None:
        """Watch a lease until it is over."""
        with self._changed:
            self._leases.add(lease)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="control-leases", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._leases = {each for each in self._leases if each.due is not None}
                if not self._leases:
                    self._thread = None
                    return
                due = [(at, each) for each in self._leases if (at := each.due) is not None]
                wait = min((at for at, _ in due), default=time.monotonic()) - time.monotonic()
                if wait > 0:
                    self._changed.wait(wait)
                    continue
            for at, each in due:
                if at <= time.monotonic():
                    try:
                        each.expire()
                    except Exception:
                        # The other leases must still end in time.
                        logger.critical("What the holder of a lease moved was not halted at its end.", exc_info=True)


watch: Callable[[ControlLease], None] = LeaseWatch().add
"""Ends a lease when its time is over."""


class ControlLease:
    """The lease of one robot, or of one robot of a world; thread-safe.

    Args:
        robot: its name in messages.
        halt: stops what the robot does, without a lockout.
        moving: whether it moves now, None where its state is unknown; asked only while the lease of one motion is in
            the way, and under no lock.
        led_by: the leader at the robot's own machine that drives it, empty without one.
        hardware: False for a simulation, which a human may take without a key where none is configured.
        clock: monotonic seconds.
        wall: wall-clock seconds, against which an assertion's age is held.
        watched: has :meth:`expire` called at :attr:`due`.
    """

    def __init__(
        self,
        robot: str,
        halt: Callable[[str], object],
        moving: Callable[[], bool | None],
        *,
        led_by: Callable[[], str] = lambda: "",
        hardware: bool = True,
        keys: Callable[[], Sequence[bytes]] = configured_keys,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
        watched: Callable[[ControlLease], None] = watch,
    ) -> None:
        self._robot = robot
        self._halt = halt
        self._moving = moving
        self._led_by = led_by
        self._hardware = hardware
        self._keys = keys
        self._clock, self._wall, self._watched = clock, wall, watched
        self._changing = threading.RLock()
        self._lease: Lease | None = None
        self._starting = Admissions(self._changing)
        self._displaced: dict[str, str] = {}
        self._nonces: dict[str, float] = {}
        self._observers = Observers()
        self.epoch = 0
        """Rises with every new holder."""

    @property
    def due(self) -> float | None:
        """The monotonic moment at which the lease is over; None where there is none."""
        lease = self._lease
        return None if lease is None else lease.until

    def observe(self, observer: OnChange) -> Callable[[], None]:
        """Tell ``observer`` of every change of the holder; return what ends that."""
        return self._observers.add(observer)

    def facts(self) -> dict[str, Any]:
        """Return the holder as everyone may read it."""
        self._settle()
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
        holder = _name(caller)
        self._settle()
        leader = self._led_by()
        if leader:
            # Whoever sits at the robot must not be halted by a lease that ends.
            text = f"acquireControl is refused: {leader} ({HUMAN}) leads it at its own machine."
            raise NotHolderError(text, "not_holder", holder=leader, kind=HUMAN)
        with self._changing:
            lease = self._lease
            if lease is not None and not _owns(lease, holder, lease_id):
                raise self._not_holder("acquireControl", lease)
            return self._give(holder, kind, ttl_s, "acquired")

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
            assertion: of :func:`sign_take`.
        """
        holder = _name(caller)
        with self._changing:
            problem = self._unproven(robot, assertion)
            if problem is not None:
                logger.warning("%s: takeControl of %s refused: %s.", robot, holder, problem)
                return error(f"takeControl is refused: {problem}.", code="not_proven", epoch=self.epoch)
            before = self._lease
            if before is not None:
                self._displaced[before.lease_id] = holder
                while len(self._displaced) > DISPLACED_MAX:
                    del self._displaced[next(iter(self._displaced))]
            answer = self._give(holder, HUMAN, TTL_S, "taken", reason)
        # Before the answer: whoever took control must not meet the last write of the one who lost it.
        self._halt(f"control taken by {holder}: {reason}")
        return answer

    def admit(self, verb: str, caller: object, lease_id: str, ttl_s: float = 0.0, *, hold: bool = True) -> Admission:
        """Admit a motion of the holder, or hold a free robot for it.

        Args:
            ttl_s: on a free robot ``lease_id`` is a secret of the caller's own, and the motion is halted so long after
                the last renewal; 0 for a motion that needs none. A held lease lasts no longer than that from then on.
            hold: False to ask and change nothing.

        Raises:
            NotHolderError: another holds the robot, or the lease is over.
        """
        self._settle()
        with self._changing:
            holder = _name(caller)
            if hold:
                self._starting.wait(partial(self._undecided, holder, lease_id), lambda: self._lease is None)
            elif self._undecided(holder, lease_id):
                return Admission()
            before = self._lease
            self._refuse(verb, holder, lease_id, ttl_s)
            if not hold:
                return Admission()
            if before is None:
                after = self._hold_for_motion(holder, HUMAN if verb == FOLLOW else AGENT, lease_id, ttl_s)
            else:
                after = self._used(verb, lease_id, ttl_s) if lease_id else before
            admission = Admission(lambda each, begun: self._admitted(each, begun, before, after))
            if after.one_motion:
                self._starting.add(admission)
            return admission

    def _refuse(self, verb: str, holder: str, lease_id: str, ttl_s: float) -> None:
        lease = self._lease
        if lease_id and (lease is not None or not ttl_s):
            self._required(verb, lease_id)
        elif lease is not None and not _owns(lease, holder):
            raise self._not_holder(verb, lease)

    def _undecided(self, holder: str, lease_id: str) -> bool:
        """True while the robot may yet refuse the motion of another that holds it."""
        lease = self._lease
        if lease is None or lease.begun or not (lease.one_motion and self._starting):
            return False
        return not _owns(lease, holder, lease_id)

    def _admitted(self, admission: Admission, begun: bool, before: Lease | None, after: Lease) -> None:
        """End an admission; one that began nothing takes back what it changed."""
        with self._changing:
            self._starting.close(admission)
            lease = self._lease
            if lease is None or lease.lease_id != after.lease_id:
                return
            if begun:
                self._lease = lease if lease.begun else replace(lease, begun=True)
            elif lease.one_motion and not lease.begun and not self._starting:
                self._lease = None
            elif lease is after is not before and before is not None:
                self._lease = before
                self._watched(self)  # which may wait for a later moment

    def _hold_for_motion(self, holder: str, kind: str, lease_id: str, ttl_s: float) -> Lease:
        if not ttl_s:
            # Known by its name alone; without a lease_id nobody can renew it.
            lease = self._lease = Lease(holder, kind, secrets.token_hex(16), one_motion=True)
            return lease
        lease = self._lease = Lease(holder, kind, lease_id, ttl_s, self._clock() + ttl_s, one_motion=True)
        self._watched(self)
        return lease

    def refuse_others(self, verb: str, caller: object, lease_id: str) -> None:
        """Refuse a motion of the whole world, unless it is the holder's.

        Raises:
            NotHolderError: another holds the robot.
        """
        self._settle()
        with self._changing:
            lease = self._lease
            if lease is not None and not _owns(lease, _name(caller), lease_id):
                raise self._not_holder(verb, lease)

    def expire(self) -> None:
        """End a lease whose time is over, and halt what its holder began."""
        lease = self._lease
        if lease is None or lease.until is None or self._clock() < lease.until:
            return
        # An unknown state is no rest: what cannot be read is halted.
        moves = not lease.one_motion or bool(self._starting) or self._activity() is not False
        with self._changing:
            if self._lease is not lease:  # renewed or given to another meanwhile
                return
            self._lease = None
        if not moves:
            return
        logger.warning("%s: the control lease of %s is over; what it moved is halted.", self._robot, lease.holder)
        try:
            self._halt(f"the control lease of {lease.holder} is over")
        finally:
            self._tell("expired", lease)

    def _activity(self) -> bool | None:
        """Return whether it moves, None if unknown; an error counts as motion."""
        try:
            return self._moving()
        except Exception:
            logger.exception("%s: its state could not be read, so it counts as moving.", self._robot)
            return True

    def _settle(self) -> None:
        """End a lease that is over, by its time or with its motion."""
        self.expire()
        lease = self._lease
        if lease is None or not lease.one_motion or self._starting or self._activity():
            return
        with self._changing:
            if self._lease is lease and not self._starting:
                self._lease = None

    def _give(self, holder: str, kind: str, ttl_s: float, event: str, reason: str = "") -> Envelope:
        lease = self._lease = Lease(holder, kind, secrets.token_hex(16), ttl_s, self._clock() + ttl_s)
        self.epoch += 1
        self._watched(self)
        self._tell(event, lease, reason)
        return success(
            f"{holder} holds control for {ttl_s:g} s; give lease_id with every motion, each one renews it.",
            lease_id=lease.lease_id,
            epoch=self.epoch,
            kind=kind,
            expires_in_s=ttl_s,
        )

    def _used(self, verb: str, lease_id: str, at_most_s: float = 0.0) -> Lease:
        lease = self._required(verb, lease_id)
        if lease.ttl_s is not None:
            ttl_s = min(lease.ttl_s, at_most_s or lease.ttl_s)
            lease = self._lease = replace(lease, ttl_s=ttl_s, until=self._clock() + ttl_s)
            if at_most_s:
                self._watched(self)  # which may wait for a later moment
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

    def _unproven(self, robot: str, assertion: object) -> str | None:
        keys = self._keys()
        if not keys:
            if not self._hardware:
                return None
            return "no operator's key is configured here (STRANDS_MESH_RESUME_PUBLIC_KEY; strands-robots keys resume)"
        if not assertion:
            return "it needs the operator's signature (assertion; strands-robots take --key FILE)"
        if not isinstance(assertion, Mapping) or set(assertion) != TAKE_FIELDS:
            return f"assertion must have exactly the fields {', '.join(sorted(TAKE_FIELDS))}"
        body = {name: value for name, value in assertion.items() if name != "sig"}
        signature = ed25519.decode(assertion["sig"], 64)
        try:
            signed = signature is not None and ed25519.signed_by_one_of(keys, signature, ed25519.canonical(body))
        except (ValueError, TypeError, RecursionError):
            signed = False
        if not signed:
            return "no configured key made the signature"
        if (body["v"], body["purpose"], body["robot"]) != (VERSION, PURPOSE, robot):
            return f"the assertion is for something else than taking control of {robot}"
        if body["epoch"] != self.epoch or isinstance(body["epoch"], bool):
            return f"the assertion names epoch {shown(body['epoch'])}, and the lease has epoch {self.epoch}"
        return self._stale(body["t"], body["nonce"])

    def _stale(self, at: object, nonce: object) -> str | None:
        if isinstance(at, bool) or not isinstance(at, int | float) or not -NEWEST_S < self._wall() - at < OLDEST_S:
            return "the assertion is not fresh"
        now = self._clock()
        self._nonces = {key: used for key, used in self._nonces.items() if now - used <= OLDEST_S + NEWEST_S}
        if not isinstance(nonce, str) or nonce in self._nonces or len(self._nonces) >= NONCES_MAX:
            return "the assertion was used before"
        self._nonces[nonce] = now
        return None

    def _tell(self, event: str, lease: Lease, reason: str = "") -> None:
        change = ControlChange(event, self._robot, lease.holder, lease.kind, self.epoch, reason)
        self._observers.tell(change)


class InputStreams(Protocol):
    """Streams of remote leaders, which move the first robot of a world."""

    def leading(self) -> bool:
        """Return True while a leader moves the robot."""

    def void(self) -> None:
        """Let no frame move the robot from now on; wait for nothing."""


class ControlLeases:
    """The leases of one robot, one for each robot of a world.

    They keep no robot alive: they refer to what its networks serve, as long as that lives.
    """

    def __init__(self) -> None:
        self._hardware = False
        self._served: list[weakref.ref[Robot]] = []
        self._by_name: dict[str, ControlLease] = {}
        self._changing = threading.Lock()
        self._observers = Observers()
        self._streams: weakref.WeakSet[InputStreams] = weakref.WeakSet()

    def attach(self, streams: InputStreams) -> None:
        """Count the motions of these streams as long as they live."""
        self._streams.add(streams)

    def only(self, name: str) -> ControlLeases:
        """Return the same leases, for a network peer that is one robot of the world."""
        return _OneOf(self, name)

    def serve(self, robot: Robot, *, hardware: bool) -> None:
        """Add the robot as one of its networks serves it."""
        with self._changing:
            self._hardware = self._hardware or hardware
            self._served = [*(each for each in self._served if each() is not None), weakref.ref(robot)]

    def observe(self, observer: OnChange) -> Callable[[], None]:
        """Tell ``observer`` of every change of a holder; return what ends that."""
        return self._observers.add(observer)

    def of(self, name: str = "") -> ControlLease:
        """Return the lease of the robot, or of the named robot of the world."""
        robot = self._robot()
        if not isinstance(robot, WorldRobot):
            name = ""
        elif not name:
            name = next(iter(robot.list_robots()), "")
        with self._changing:
            lease = self._by_name.get(name)
            if lease is None:
                shown_as = name or ("" if robot is None else robot.tool_name_str)
                lease = self._by_name[name] = ControlLease(
                    shown_as,
                    lambda reason: self._halt(name, reason),
                    lambda: self._moves(name),
                    led_by=lambda: self._led_by(name),
                    hardware=self._hardware,
                )
                lease.observe(self._observers.tell)
        return lease

    def admit(
        self, command: str, caller: object, lease_id: str, name: str | None, ttl_s: float = 0.0, *, hold: bool = True
    ) -> Admission:
        """Admit a motion of the named robot; with None of all robots of the world.

        Raises:
            NotHolderError: another holds the robot, or the lease is over.
        """
        if name is not None or not isinstance(self._robot(), WorldRobot):
            return self.of(name or "").admit(command, caller, lease_id, ttl_s, hold=hold)
        for each in tuple(self._by_name.values()):
            each.refuse_others(command, caller, lease_id)
        return Admission()

    def facts(self) -> dict[str, Any]:
        """Return the holder of the robot; by name for the robots of a world."""
        robot = self._robot()
        if not isinstance(robot, WorldRobot) or len(robot.list_robots()) < 2:
            return self.of().facts()
        return {name: self.of(name).facts() for name in robot.list_robots()}

    def _robot(self) -> Robot | None:
        return next((robot for each in self._served if (robot := each()) is not None), None)

    def _streams_of(self, name: str) -> list[InputStreams]:
        robot = self._robot()
        first = next(iter(robot.list_robots()), "") if isinstance(robot, WorldRobot) else name
        return list(self._streams) if name == first else []

    def _led_by(self, name: str) -> str:
        """Return the leader at this machine that drives the robot, empty without one."""
        robot = self._robot()
        led = getattr(body_of(robot), "teleoperated_by", None)
        return str(led(name or getattr(robot, "tool_name_str", ""))) if callable(led) else ""

    def _moves(self, name: str) -> bool | None:
        if any(each.leading() for each in self._streams_of(name)):
            return True
        robot = self._robot()
        if isinstance(robot, WorldRobot):
            return any(row.get("robot") == name for row in robot.list_policies_running())
        # A robot whose motions are gestures has no task; its motion ends the lease with the call that began it.
        status = getattr(robot, "get_task_status", None)
        if not callable(status):
            return False
        state = str(status().get("task_status", "")).lower()
        return state in RUNNING if state in RUNNING | AT_REST else None

    def _halt(self, name: str, reason: str) -> None:
        for each in self._streams_of(name):
            each.void()
        robot = self._robot()
        if isinstance(robot, WorldRobot):
            robot.stop_policy(name)
        elif robot is not None:
            stop_executor().halt(robot, robot.tool_name_str, reason)


_LEASES: WeakKeyDictionary[Any, ControlLeases] = WeakKeyDictionary()


def leases_of(robot: Robot, *, hardware: bool) -> ControlLeases:
    """Return the leases of a robot, the same on every network that serves it."""
    body = body_of(robot)
    try:
        leases = _LEASES.setdefault(body, ControlLeases())
        leases.serve(robot, hardware=hardware)
    except TypeError:  # no weak reference to it, or no hash
        leases = _Strong(robot, hardware=hardware)
    return leases


class _OneOf(ControlLeases):
    """The leases of a world as one of its robots has them."""

    def __init__(self, world: ControlLeases, name: str) -> None:
        super().__init__()
        self._world = world
        self._name = name

    def of(self, name: str = "") -> ControlLease:
        """Return the lease of this robot."""
        return self._world.of(self._name)

    def admit(
        self, command: str, caller: object, lease_id: str, name: str | None, ttl_s: float = 0.0, *, hold: bool = True
    ) -> Admission:
        """Admit a motion of this robot."""
        return self._world.admit(command, caller, lease_id, self._name, ttl_s, hold=hold)

    def facts(self) -> dict[str, Any]:
        """Return the holder of this robot."""
        return self.of().facts()


class _Strong(ControlLeases):
    """Leases of a robot without weak references; they live with its pipeline."""

    def __init__(self, robot: Robot, *, hardware: bool) -> None:
        super().__init__()
        self._hardware = hardware
        self._kept = robot

    def _robot(self) -> Robot | None:
        return self._kept


def _name(caller: object) -> str:
    return caller_name(caller) or ANONYMOUS


def _owns(lease: Lease, holder: str, lease_id: str = "") -> bool:
    """Return whether it is the caller's: a name is enough where it has no secret."""
    return _is(lease, lease_id) or (lease.one_motion and lease.ttl_s is None and lease.holder == holder)


def _is(lease: Lease, lease_id: str) -> bool:
    return bool(lease_id) and hmac.compare_digest(lease.lease_id.encode(), lease_id.encode())
