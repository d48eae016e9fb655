"""Motion gate of one robot: permits, revoked by a halt, refused while locked.

Every motion source (a rollout, a teleoperation session, a single ``send_action``) asks :meth:`MotionGate.permit`
before it moves and looks at :attr:`Permit.valid` under the same lock as each write to the device. A halt calls
:meth:`MotionGate.revoke` first and then waits for the write that may be in flight, so that after its verdict no
action reaches the device. Revoking counts up by one; a renewal compares before it counts. Their lock is held for
nothing else.

A hold (:meth:`MotionGate.hold`) is none of this: it voids nothing. For a fraction of a second writers wait, or leave a
beat out, while the process learns what it has missed; then they go on. A halt meanwhile voids their permits as ever.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, ParamSpec, Protocol, TypeVar

from strands_robots.envelope import Envelope, error
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.process import AWAKE, AwakeClock
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, MissingExtraError, ValidationError

P = ParamSpec("P")
T = TypeVar("T")

logger = stop_logger(__name__)

REFUSED_EVERY_S = 0.2
"""Least time between two refusals of a locked robot that are told: a caller may ask without end."""

WAIT_S = 0.005
"""Seconds between two looks of a writer that waits; a halt ends its wait within these."""


ERROR_MAX = 500
"""Characters of what a verb raised, in its events."""


class Latch(Protocol):
    """A lock on motion: the lockout of the robot."""

    def refusal(self, verb: str) -> Envelope | None:
        """The refusal of ``verb`` while locked, or None while clear."""


class MotionRefused(StrandsRobotsError, RuntimeError):  # noqa: N818 - a refusal, not a fault
    """Motion is not allowed now; ``envelope`` is the answer to give."""

    def __init__(self, envelope: Envelope) -> None:
        super().__init__(str(envelope.get("reason", "motion refused")))
        self.envelope = envelope


class PermitVoidError(StrandsRobotsError, RuntimeError):
    """The permit was void at the write, so nothing was written."""


class MotionsHeldError(StrandsRobotsError, RuntimeError):
    """Motions were held at the write, so nothing was written; it may be tried again."""


REFUSALS = (MotionRefused, PermitVoidError, ValidationError, MissingExtraError)
"""The exceptions by which a robot refuses a verb."""


def refusal_envelope(verb: str, refused: Exception) -> Envelope:
    """Return the answer to a verb that raised one of :data:`REFUSALS`."""
    if isinstance(refused, MotionRefused):
        return refused.envelope
    return error(
        f"{verb} was overtaken by a stop: {refused}." if isinstance(refused, PermitVoidError) else str(refused)
    )


def answered(verb: Callable[P, Envelope]) -> Callable[P, Envelope]:
    """Answer a refusal that ``verb`` raises with its envelope."""

    @functools.wraps(verb)
    def answering(*args: P.args, **kwargs: P.kwargs) -> Envelope:
        try:
            return verb(*args, **kwargs)
        except REFUSALS as refused:
            return refusal_envelope(verb.__name__, refused)

    return answering


class MotionRequest:
    """A call for motion, dated by its arrival; a later halt voids what it begins.

    Attributes:
        gate: of the robot that is asked.
        begun: something has moved by it, whatever it is answered.
        read: the verb that asks, where it is declared a read and gets no permit; empty for motions.
    """

    __slots__ = ("__weakref__", "begun", "gate", "generation", "given_up", "read")

    def __init__(self, gate: MotionGate, generation: int | None = None, read: str = "") -> None:
        self.gate = gate
        self.generation = gate.generation if generation is None else generation
        self.read = read
        self.given_up = False
        self.begun = False

    @property
    def overtaken(self) -> bool:
        """True for ever once the robot was halted since, or the call was given up."""
        return self.given_up or self.generation != self.gate.generation

    def give_up(self) -> None:
        """Void what the call began or may still begin, and nothing else."""
        self.given_up = True


class Permit:
    """Leave to move until the next halt or until the caller withdraws it."""

    __slots__ = ("_ends", "_gate", "_withdrawn", "request", "verb")

    def __init__(self, request: MotionRequest, verb: str) -> None:
        self._gate = request.gate
        self.request = request
        """What it was given for; all that this begins has the same."""
        self._withdrawn = False
        self._ends: float | None = None
        self.verb = verb

    @property
    def generation(self) -> int:
        """The gate's, when the motion was asked for."""
        return self.request.generation

    @property
    def valid(self) -> bool:
        """False for ever after a halt, a lock, a withdrawal, or its call's end."""
        over = self._ends is not None and time.monotonic() >= self._ends
        return not (over or self._withdrawn or self.request.overtaken)

    @property
    def revoked(self) -> bool:
        """True for ever once the whole robot was halted or locked."""
        return self._gate.generation != self.request.generation

    @property
    def locked(self) -> bool:
        """The robot refuses every motion until it is resumed."""
        return self._gate.lockout(self.verb) is not None

    def check(self) -> None:
        """Raise :class:`MotionRefused` when this permit became void during a wait."""
        if not self.valid:
            raise MotionRefused(error(_LATE.format(self.verb)))

    @property
    def held(self) -> bool:
        """True while motions hold: nothing may be written now, and the permit lives on."""
        return self._gate.held

    def wait(self) -> None:
        """Wait until no hold is on, or this permit is void.

        A writer calls it without any lock that a halt needs.
        """
        while self._gate.held and self.valid:
            time.sleep(WAIT_S)

    def write(self, lock: AbstractContextManager[object], write: Callable[[], T]) -> T:
        """Run ``write`` under ``lock`` once no hold is on, and return its result.

        The lock is never kept while a hold is waited for. ``write`` looks whether the permit is still valid; where
        it raises :class:`MotionsHeldError` it runs again after the hold.
        """
        while True:
            self.wait()
            try:
                with lock:
                    if not self.held or not self.valid:
                        return write()
            except MotionsHeldError:
                continue

    def begin(self) -> None:
        """Note that something moves by this permit from now on."""
        self.request.begun = True

    def end_at(self, moment: float) -> None:
        """Void this permit alone from a moment on, in monotonic s."""
        self._ends = moment

    def withdraw(self) -> None:
        """Void this permit alone: one motion stops, the robot stays free."""
        self._withdrawn = True


class Waiting:
    """Motions with leave that have not begun, by a name that a stop may name."""

    def __init__(self) -> None:
        self._permits: dict[Permit, str] = {}

    @contextmanager
    def until_begun(self, permit: Permit, name: str = "") -> Iterator[None]:
        """Mark the time in which a motion loads, connects or waits."""
        self._permits[permit] = name
        try:
            yield
        finally:
            del self._permits[permit]

    def void(self, name: str | None = None) -> None:
        """Withdraw the permits of ``name``, or of all."""
        for permit, whose in list(self._permits.items()):
            if name in (None, whose):
                permit.withdraw()


class OrderedStop(NamedTuple):
    """A stop that the stop executor carries out.

    Attributes:
        reason: what it was ordered for, such as by whom.
        verdict: is set to the robot's :class:`~strands_robots.safety.stopping.StopVerdict`, in time.
    """

    reason: str
    verdict: Future[Any]


RefusalObserver = Callable[[str, str], object]
"""Is told the verb and the reason of a motion that was refused while its robot is locked; it returns at once."""


class MotionGate:
    """Gate of one robot; thread-safe.

    Attributes:
        generation: rises with every halt; permits of an older one are void.
        given: rises with every permit that is given. A settling begins only where none was given since its halt.
        under_way: the robot's own verbs that have not returned.
        newest_stop: the last stop that was ordered, by whomever; None before the first one.
    """

    def __init__(self, latch: Latch | None = None, awake: AwakeClock = AWAKE) -> None:
        self._awake = awake
        self._held_until, self._holds = float("-inf"), 0
        self._latches: tuple[Latch, ...] = () if latch is None else (latch,)
        self._attaching = threading.Lock()
        self._counting = threading.Lock()
        self.generation = 0
        self._of_thread = threading.local()
        self._watchers: tuple[Callable[[], None], ...] = ()
        self.given = 0
        self.under_way = VerbsUnderWay()
        self.newest_stop: OrderedStop | None = None
        self._refusal_observers: tuple[RefusalObserver, ...] = ()
        self._refusal_told = float("-inf")

    @property
    def held(self) -> bool:
        """True while motions hold: by :meth:`hold`, or after the process did not run."""
        now = self._awake.look()
        return now < self._awake.held_until or now < self._held_until

    @property
    def holds(self) -> int:
        """Rises with every hold."""
        return self._holds + self._awake.pauses

    def hold(self, seconds: float) -> None:
        """Let no motion write for so long; return at once.

        Nothing is voided, and a halt is not delayed. A hold under way is only ever made longer.
        """
        until = self._awake.look() + seconds
        if until > self._held_until:
            self._held_until = until
            self._holds += 1

    @property
    def latches(self) -> tuple[Latch, ...]:
        """Everything that decides whether motion is locked."""
        return self._latches

    def attach(self, latch: Latch) -> None:
        """Let ``latch``, beside the present ones, decide whether motion is locked."""
        with self._attaching:
            if latch not in self._latches:
                self._latches = (*self._latches, latch)

    def detach(self, latch: Latch) -> None:
        """Ask ``latch`` no more."""
        with self._attaching:
            self._latches = tuple(each for each in self._latches if each is not latch)

    def watch(self, begins: Callable[[], None]) -> Callable[[], None]:
        """Call ``begins`` before each permit; return a callable that ends that."""
        with self._attaching:
            self._watchers = (*self._watchers, begins)
        if self.given:
            begins()

        def unwatch() -> None:
            with self._attaching:
                self._watchers = tuple(each for each in self._watchers if each is not begins)

        return unwatch

    def watch_refusals(self, observer: RefusalObserver) -> Callable[[], None]:
        """Tell ``observer`` of motions that are refused while locked.

        At most one in :data:`REFUSED_EVERY_S` seconds is told. Return a callable that ends that.
        """
        with self._attaching:
            self._refusal_observers = (*self._refusal_observers, observer)

        def unwatch() -> None:
            with self._attaching:
                self._refusal_observers = tuple(each for each in self._refusal_observers if each is not observer)

        return unwatch

    def note_refused(self, verb: str, refusal: Envelope) -> None:
        """Tell the observers that a motion was refused, where it was for a lockout."""
        now = time.monotonic()
        if refusal.get("locked") is not True or now - self._refusal_told < REFUSED_EVERY_S:
            return
        self._refusal_told = now
        for observer in self._refusal_observers:
            try:
                observer(verb, str(refusal.get("reason", "")))
            except Exception:
                logger.exception("An observer of refused motions failed.")

    def request(self) -> MotionRequest:
        """Return a request for motion that is made now, for :meth:`permit` later.

        A call that waits for a thread or a connection is thus older than a stop that comes meanwhile.
        """
        return MotionRequest(self, self.generation)

    def within(self, request: MotionRequest) -> AbstractContextManager[None]:
        """Make permits that a stranger's code asks for on this thread part of a request.

        A robot of ours is given its request as an argument. A stranger's robot, and the verbs that its author declares,
        call gate and robot without one, so this thread has to remember it. Of two requests around one another the
        outer one counts, which is the older.
        """
        return self._asked_by(self._outer() or request)

    def reading(self, verb: str) -> AbstractContextManager[None]:
        """Refuse permits on this thread, for the time of a verb that is a read."""
        return self._asked_by(MotionRequest(self, self.generation, read=verb))

    @contextmanager
    def _asked_by(self, request: MotionRequest) -> Iterator[None]:
        """Make permits that are asked for on this thread part of a request."""
        before = self._outer()
        self._of_thread.request = request
        try:
            yield
        finally:
            self._of_thread.request = before

    @contextmanager
    def moving(self, verb: str, within_s: float, request: MotionRequest | None = None) -> Iterator[Permit]:
        """Give the permit of a robot's own verb, and mark the time until it has returned.

        The permit is void after ``within_s`` seconds, and once the verb has returned.

        Raises:
            MotionRefused: locked, halted since it was asked for, or another own verb has not returned.
        """
        permit = self.permit(verb, request)
        call = VerbCall(verb, permit.request, lambda: permit.valid, permit.request.give_up)
        with self.under_way.entered(call) as other:
            if other:
                raise MotionRefused(error(f"{verb} is refused: {other} of this robot has not returned."))
            try:
                permit.wait()
                permit.check()
                permit.begin()
                permit.end_at(time.monotonic() + within_s)
                with self.within(permit.request):
                    yield permit
                call.ended = "completed" if permit.valid else "stopped"
            except BaseException as exc:
                call.error = f"{type(exc).__name__}: {exc}"[:ERROR_MAX]
                call.ended = "error" if permit.valid else "stopped"
                raise
            finally:
                # What the verb has left behind, such as a thread, writes no more by it.
                permit.withdraw()

    def lockout(self, verb: str) -> Envelope | None:
        """Return the answer to ``verb`` while locked, else None."""
        for latch in self._latches:
            locked = latch.refusal(verb)
            if locked is not None:
                return locked
        return None

    def refusal(self, verb: str, request: MotionRequest | None = None) -> Envelope | None:
        """Return the refusal of ``verb`` while locked or halted since, else None."""
        dated = self._dated(request)
        if dated.read:
            return error(f"{verb} is refused: {dated.read} is declared a read, and a read moves nothing.")
        locked = self.lockout(verb)
        if locked is not None:
            return locked
        return error(_LATE.format(verb)) if dated.overtaken else None

    def permit(self, verb: str, request: MotionRequest | None = None) -> Permit:
        """Return leave to move; raise :class:`MotionRefused` if locked or halted.

        Args:
            verb: its name in the refusal.
            request: what the motion is a part of; one that is made now by default.
        """
        # The generation is read before the latches, so that a lock engaged in between voids this permit.
        dated = self._dated(request)
        permit = Permit(dated, verb)
        for _ in range(2):
            refusal = self.refusal(verb, dated)
            if refusal is not None:
                self.note_refused(verb, refusal)
                raise MotionRefused(refusal)
            # Counted between two looks at the latches: a settling that begins beside this either is a latch that
            # refuses it, or sees that it was given.
            self.given += 1
        for begins in self._watchers:
            begins()
        return permit

    def revoke(self) -> int:
        """Void every permit given so far; return the generation of this halt."""
        with self._counting:
            self.generation += 1
            return self.generation

    def settling(self, generation: int) -> Permit:
        """Return leave for the motion that is a part of the halt of ``generation``.

        No latch is asked, for the robot is locked. Only a robot's own halt may call this; the next halt voids it.
        """
        return Permit(MotionRequest(self, generation), "settle")

    def renew(self, permit: Permit) -> Permit:
        """Void every other permit, as a halt does, and return a fresh one.

        Raises :class:`MotionRefused` where another caller has halted or locked the robot since ``permit`` was given.
        """
        with self._counting:
            valid = permit.valid
            if valid:
                self.generation += 1
            request = MotionRequest(self, self.generation)
        refusal = self.lockout(permit.verb) if valid else None
        if refusal is None and not (valid and not request.overtaken):
            refusal = error(_LATE.format(permit.verb))
        if refusal is not None:
            raise MotionRefused(refusal)
        return Permit(request, permit.verb)

    def _outer(self) -> MotionRequest | None:
        return getattr(self._of_thread, "request", None)

    def _dated(self, request: MotionRequest | None) -> MotionRequest:
        outer: MotionRequest | None = getattr(self._of_thread, "request", None)
        if outer is not None:
            return outer
        if request is not None and request.gate is self:
            return request
        made = MotionRequest(self)
        # One of a robot that has this one inside: a halt of either refuses the motion.
        made.given_up = request is not None and request.overtaken
        return made


_LATE = "{} is refused: the robot was halted after it was asked for; nothing was started."


@dataclass(eq=False, slots=True)
class VerbCall:
    """One call of a robot's own verb.

    Attributes:
        name: of the verb.
        call: identity of the caller's request; verbs that a verb calls have its own.
        valid: returns False once its permit is void.
        void: ends its permit, and no other.
        thread: that runs it.
        ended: how it ended; empty while it runs.
    """

    name: str
    call: object
    valid: Callable[[], bool]
    void: Callable[[], None]
    began: float = field(default_factory=time.monotonic)
    thread: int = field(default_factory=threading.get_ident)
    ended: Literal["", "completed", "stopped", "error"] = ""
    error: str = ""


CallObserver = Callable[[VerbCall], None]
"""Called when a verb begins and when it has ended, on the verb's thread. It must return at once and may not raise."""


class VerbsUnderWay:
    """The own motion verbs of one robot that run now; thread-safe.

    A verb of ours is a rollout or a plan that a halt ends by itself. A robot's own verb is its author's code: a halt
    voids its permit and waits until it has returned. One that does not return is a robot that may still move.

    Attributes:
        calls: that have not returned, the oldest first. A halt reads them without a lock.
    """

    def __init__(self) -> None:
        self.calls: tuple[VerbCall, ...] = ()
        self._beginning = threading.Lock()
        self._observers: tuple[CallObserver, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.calls)

    @property
    def name(self) -> str:
        """The verb that a caller asked for; empty while none runs."""
        return next((each.name for each in self.calls), "")

    def observe(self, observer: CallObserver) -> Callable[[], None]:
        """Call ``observer`` at each begin and end; return a callable that ends that."""
        with self._beginning:
            self._observers = (*self._observers, observer)

        def leave() -> None:
            with self._beginning:
                self._observers = tuple(each for each in self._observers if each is not observer)

        return leave

    @contextmanager
    def entered(self, call: VerbCall) -> Iterator[str]:
        """Mark the time of a call; gives the verb that keeps it from beginning, or "".

        One call of a robot's own verbs runs at a time, with those that it calls itself.
        """
        with self._beginning:
            other = next((each.name for each in self.calls if each.call is not call.call), "")
            outer = not self.calls
            if not other:
                self.calls = (*self.calls, call)
        try:
            if not other and outer:
                self._tell(call)
            yield other
        finally:
            if not other:
                with self._beginning:
                    self.calls = tuple(each for each in self.calls if each is not call)
                if outer:
                    self._tell(call)

    def _tell(self, call: VerbCall) -> None:
        for observer in self._observers:
            observer(call)


_gates: IdentityMap[MotionGate] = IdentityMap()


def gate_of(robot: object) -> MotionGate:
    """Return a robot's own ``gate``, or one that is made for it; it is kept."""
    own = getattr(robot, "gate", None)
    return _gates.of(robot, lambda: own if isinstance(own, MotionGate) else MotionGate())


def kept_gate(robot: object) -> MotionGate | None:
    """Return the gate that is kept of a robot, or None; asks the robot nothing."""
    return _gates.get(robot)
