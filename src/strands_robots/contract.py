"""Robot contract as types, and the adapter of foreign robots.

Networks, tools and the command line reach a robot only through these protocols. A robot of ours implements
:class:`TaskRobot` or :class:`WorldRobot`; any other object with ``start_task``, ``stop_task``,
``get_task_status`` and ``get_features`` is wrapped by :func:`adapt`.
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from types import FunctionType, MethodType
from typing import TYPE_CHECKING, Any, Generic, Literal, ParamSpec, Protocol, TypeVar, runtime_checkable

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, VerbCall, gate_of
from strands_robots.safety.stop_targets import Haltable as Haltable  # noqa: PLC0414 - part of the contract
from strands_robots.safety.stop_targets import RobotWrapper, halted_with_verbs
from strands_robots.safety.stop_targets import body_of as body_of  # noqa: PLC0414 - part of the contract
from strands_robots.safety.stopping import (
    PendingVerdict,
    StopVerdict,
    grade,
    halt_each,
    halts_in_parts,
    json_blocks,
    read_verdict,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, ValidationError, shown
from strands_robots.verb_declaration import declared_verbs

if TYPE_CHECKING:
    from typing_extensions import TypeIs

logger = stop_logger(__name__)

P = ParamSpec("P")
T = TypeVar("T")

Joints = dict[str, float]

SETTLE = "settle"
"""The ``policy`` of a robot's way to its rest pose after a stop, in its events."""

RUNNING = frozenset({"running", "starting", "connecting", "busy"})
"""Values of ``task_status`` of a task that may move its robot."""

AT_REST = frozenset({"idle", "completed", "stopped", "error"})
"""Values of ``task_status`` of a robot whose task moves nothing; any other value is unknown."""

STATUS_SHARE = 0.5
"""Part of the halt deadline for which the status may go on saying that the task runs."""


@dataclass(frozen=True, slots=True)
class RolloutEvent:
    """An event of a rollout, given to observers from the control thread.

    ``kind`` is started, step or finished; ``state`` of a finished one is completed, stopped or error.
    ``clamped_steps`` counts the actions that the robot's speed limit held back.
    ``observation`` and ``action`` hold numbers only, by joint name, in the robot's own units. ``follows_instruction``
    is False for a policy that moves by itself, whatever it was told, as ``mock`` does. ``loop`` of a finished one has
    the figures of its control loop.
    """

    kind: Literal["started", "step", "finished"]
    robot: str
    instruction: str
    policy: str
    step: int = 0
    clamped_steps: int = 0
    elapsed_s: float = 0.0
    state: str = "running"
    error: str = ""
    observation: Mapping[str, float] = field(default_factory=dict)
    action: Mapping[str, float] = field(default_factory=dict)
    follows_instruction: bool = True
    loop: Mapping[str, float] = field(default_factory=dict)


Observer = Callable[[RolloutEvent], None]
"""Called from the control thread: it must return at once and may not raise."""

Unsubscribe = Callable[[], None]


class OfRobot(Protocol):
    """An event of one robot."""

    @property
    def robot(self) -> str:
        """Name of the robot."""


E = TypeVar("E", bound=OfRobot)


class Observers(Generic[E]):
    """Observers of a robot's events; one that raises is logged and stays."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._observers: tuple[Callable[[E], None], ...] = ()
        self._logged: set[tuple[int, str]] = set()

    def subscribe(self, observer: Callable[[E], None]) -> Unsubscribe:
        """Call ``observer`` with every event; the returned callable ends that."""
        with self._lock:
            self._observers = (*self._observers, observer)
        once = threading.Lock()

        def unsubscribe() -> None:
            if once.acquire(blocking=False):
                with self._lock:
                    left = list(self._observers)
                    left.remove(observer)
                    self._observers = tuple(left)

        return unsubscribe

    def notify(self, event: E) -> None:
        """Call every observer, in the calling thread."""
        for observer in self._observers:
            try:
                observer(event)
            except Exception as exc:
                failure = (id(observer), type(exc).__name__)
                if failure not in self._logged:
                    self._logged.add(failure)
                    logger.exception("An observer of %s raised; it stays subscribed.", event.robot)


VERB = "verb"
"""The ``policy`` of a verb of a robot's own, in its events; its ``instruction`` is the verb's name."""


@runtime_checkable
class TaskRobot(Haltable, Protocol):
    """A robot with one body: real hardware, or anything that :func:`adapt` made fit."""

    tool_name_str: str
    gate: MotionGate

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Start a rollout and return at once; ``duration`` in s, port 0 the default."""

    def stop_task(self) -> Envelope:
        """Stop the rollout; ``stopped`` is false when its loop outlived the join."""

    def get_task_status(self) -> Envelope:
        """Return status, instruction, step count and duration of the latest task."""

    def get_features(self) -> Envelope:
        """``observation_features`` and ``action_features``, as data."""

    def get_state(self) -> Envelope:
        """``joints`` (name to position in the device's unit) and ``task``.

        ``joints_age_s`` where it is known; ``joints_error`` is the reason where the joints are old.
        """

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Call ``observer`` with every rollout event; return its unsubscribe."""


@runtime_checkable
class WorldRobot(Haltable, Protocol):
    """A simulated world: a collection of robots, each with its own rollout."""

    tool_name_str: str
    gate: MotionGate

    def list_robots(self) -> list[str]:
        """Names, in the order in which they were added."""

    def start_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        **policy: Any,
    ) -> Envelope:
        """Start a rollout of one robot and return at once."""

    def stop_policy(self, robot_name: str) -> Envelope:
        """Stop one robot's rollout; the answer says whether it stopped."""

    def list_policies_running(self) -> list[dict[str, Any]]:
        """One row a running rollout: robot, instruction, policy, step, elapsed_s."""

    def get_state(self) -> Envelope:
        """Return ``sim_time`` (s), steps, joints of each robot, running policies."""

    def get_features(self) -> Envelope:
        """Joints, actuators and cameras by robot."""

    def step(self, n: int = 1) -> Envelope:
        """Advance physics by ``n`` time steps, as fast as they compute."""

    def reset(self) -> Envelope:
        """Halt, then put the world back to its initial state."""

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Call ``observer`` with every rollout event; return its unsubscribe."""


Robot = TaskRobot | WorldRobot
"""A robot that a network can serve."""

JointReader = Callable[[Any], Mapping[str, float]]
"""Reads a robot's joints, by name in its own unit; empty where it has none. Raises what the robot raises."""


class ForeignRobot(Protocol):
    """Least robot that :func:`adapt` makes fit: four verbs and their answers.

    Further keys are passed on. A robot with a ``halt(reason)`` of its own is halted by that, and one with a
    ``stop_teleoperate()`` by that as well; both answer as :meth:`stop_task` does.
    """

    def start_task(
        self, instruction: str, *, policy_provider: str, duration: float, policy_port: int
    ) -> Mapping[str, Any]:
        """Start and return at once: ``status`` success, or error with ``reason``."""

    def stop_task(self) -> Mapping[str, Any] | None:
        """Stop: ``status`` is ``success`` or ``error``; ``stopped`` false did not stop.

        None leaves it to :meth:`get_task_status`, which is read after every stop; anything else is unknown.
        """

    def get_task_status(self) -> Mapping[str, Any]:
        """``task_status`` of :data:`AT_REST` or :data:`RUNNING`; all else is unknown."""

    def get_features(self) -> Mapping[str, Any]:
        """``observation_features`` and ``action_features``, as data."""


_TASK_VERBS = {
    "start_task": "(instruction, policy_provider, duration, policy_port) -> {'status': 'success' or 'error'}",
    "stop_task": "() -> {'status': 'success' or 'error'}",
    "get_task_status": f"() -> {{'task_status': {', '.join(sorted(AT_REST | RUNNING))}}}",
    "get_features": "() -> {'observation_features': {}, 'action_features': {}}",
}


def adapt(robot: Any, joints: JointReader | None = None) -> TaskRobot:
    """Return ``robot`` when it fits :class:`TaskRobot`, else a wrapper that does.

    Args:
        robot: what is to fit: a :class:`ForeignRobot` at least.
        joints: reads the joints of a robot that has no ``get_state`` of its own; without it those are none.

    Raises:
        ValidationError: ``robot`` lacks one of start_task, stop_task, get_task_status, get_features, and declares no
            verb of its own.
    """
    if isinstance(robot, TaskRobot):
        return robot
    missing = [verb for verb in _TASK_VERBS if not callable(getattr(robot, verb, None))]
    # What a robot with verbs of its own lacks is bridged: it may have no tasks at all, and none that no stop ends.
    endless = "start_task" not in missing and not stops_motions(robot)
    if missing and (endless or not declared_verbs(robot)):
        shapes = "; ".join(f"{verb}{_TASK_VERBS[verb]}" for verb in missing)
        raise ValidationError(
            f"robot must have {', '.join(_TASK_VERBS)}, or verbs of its own declared by @verb; {shown(robot)} lacks "
            f"{', '.join(missing)}. Expected: {shapes}."
        )
    return AdaptedRobot(robot, joints)


def behind_contract(robot: Any, joints: JointReader | None = None) -> Robot:
    """Return a world as it is, and any other robot as :func:`adapt` makes it fit.

    Raises:
        ValidationError: as :func:`adapt`.
    """
    return robot if holds_robots(robot) else adapt(robot, joints)


_worlds: IdentityMap[bool] = IdentityMap()


def holds_robots(robot: object) -> TypeIs[WorldRobot]:
    """Return True for a world, which holds robots or may be given some."""
    if not callable(getattr(robot, "list_robots", None)):
        return False
    # Asked for every heartbeat and command; to check the whole contract takes 20 us.
    return _worlds.get(robot) or (isinstance(robot, WorldRobot) and _worlds.of(robot, lambda: True))


def robots_in(robot: object) -> list[str]:
    """Return the names of the robots of a world now; none for any other robot."""
    return robot.list_robots() if holds_robots(robot) else []


def task_runs(robot: Robot, name: str = "") -> bool | None:
    """Return whether a task moves the robot, or the named robot of a world.

    None where its status is unknown.
    """
    if holds_robots(robot):
        return any(row.get("robot") == name for row in robot.list_policies_running())
    # A robot whose motions are gestures has no task.
    status = getattr(robot, "get_task_status", None)
    if not callable(status):
        return False
    state = str(status().get("task_status", "")).lower()
    return state in RUNNING if state in RUNNING | AT_REST else None


def for_request(request: MotionRequest | None, method: Callable[P, T]) -> Callable[P, T]:
    """Return a robot's method as it is called for a request.

    A halt since the request was made refuses what the method begins. A method of ours takes it as its argument
    ``request``, by keyword alone. A stranger's takes none: permits that it asks its gate for on this thread are given
    for the request all the same.
    """
    if request is None:
        return method
    # Off its code: inspect.signature takes 90 us of each command. The methods of a proxy are no functions.
    function = method.__func__ if isinstance(method, MethodType) else method
    function = inspect.unwrap(function) if isinstance(function, FunctionType) else function
    code = function.__code__ if isinstance(function, FunctionType) else None
    named = () if code is None else code.co_varnames[code.co_argcount : code.co_argcount + code.co_kwonlyargcount]
    # An argument of a stranger's that has the same name is not ours.
    if "request" in named and MotionRequest.__name__ in str(function.__annotations__.get("request")):
        ours: Callable[..., T] = method
        return partial(ours, request=request)

    def within(*values: P.args, **named: P.kwargs) -> T:
        with request.gate.within(request):
            return method(*values, **named)

    return within


def observe(robot: Robot, observer: Observer) -> Unsubscribe:
    """Call ``observer`` with the events of rollouts and of the robot's own verbs."""

    def told(call: VerbCall) -> None:
        kind: Literal["started", "finished"] = "finished" if call.ended else "started"
        elapsed_s = time.monotonic() - call.began if call.ended else 0.0
        observer(
            RolloutEvent(
                kind,
                robot.tool_name_str,
                call.name,
                VERB,
                elapsed_s=elapsed_s,
                state=call.ended or "running",
                error=call.error,
            )
        )

    unsubscribe = robot.subscribe(observer)
    leave = robot.gate.under_way.observe(told)

    def end() -> None:
        leave()
        unsubscribe()

    return end


class _PutAway:
    def refusal(self, verb: str) -> Envelope:
        return error(f"{verb} is refused: the robot is being taken off its network.")


def put_away(robot: Any) -> Callable[[], None]:
    """Refuse every motion of ``robot`` until the returned callable is called.

    For a caller that halts a robot and then leaves its network: a motion requested in between would go on.
    """
    gate, latch = gate_of(body_of(robot)), _PutAway()
    gate.attach(latch)
    return lambda: gate.detach(latch)


class _Shared:
    """State that all wrappers of one foreign robot share, on every network."""

    def __init__(self) -> None:
        self.reading = threading.Lock()
        self.read: tuple[float, Joints] | None = None
        self._calls: set[object] = set()

    @property
    def called(self) -> bool:
        """A verb that moves or stops the robot is under way."""
        return bool(self._calls)

    @contextmanager
    def calling(self) -> Iterator[None]:
        """Mark the time of such a verb; wait for no other call, it may be a stop."""
        call = object()
        self._calls.add(call)
        try:
            yield
        finally:
            self._calls.discard(call)


_known: IdentityMap[_Shared] = IdentityMap()


def stops_motions(robot: object) -> bool:
    """Return True for a robot with a ``halt`` or a ``stop_task``."""
    return any(callable(getattr(robot, name, None)) for name in ("halt", "stop_task"))


class AdaptedRobot(RobotWrapper):
    """Foreign robot behind the contract; its own optional verbs are used."""

    def __init__(self, robot: Any, joints: JointReader | None = None) -> None:
        self.wrapped = robot
        self._read_joints = joints
        usual = "robot" if callable(getattr(robot, "start_task", None)) else type(robot).__name__.lower()
        self.tool_name_str: str = str(getattr(robot, "tool_name_str", "") or usual)
        self._shared = _known.of(robot, _Shared)
        self.gate = gate_of(robot)

    def start_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        *,
        request: MotionRequest | None = None,
    ) -> Envelope:
        start = getattr(self.wrapped, "start_task", None)
        if not callable(start):
            return error(f"{self.tool_name_str} runs no tasks; it has verbs of its own.")
        busy = self.gate.under_way.name
        if busy:
            return error(f"start_task is refused: {busy} of {self.tool_name_str} has not returned.")
        try:
            permit = self.gate.permit("start_task", request)
            permit.wait()
            permit.check()
        except MotionRefused as refused:
            return refused.envelope
        with self._shared.calling():
            task = {"policy_provider": policy_provider, "duration": duration, "policy_port": policy_port}
            answer: Envelope = for_request(permit.request, start)(instruction, **task)
        if not permit.valid:
            # The stop came while the robot was starting, and may have found nothing to stop.
            permit.begin()
            again = self.halt("halted while it started")
            end = "and was stopped again" if again.stopped else "and DID NOT STOP AGAIN"
            return error(f"start_task is refused: {self.tool_name_str} was halted while it started, {end}.")
        return answer

    def stop_task(self) -> Envelope:
        """Stop the task; the robot's own answer where its status does not contradict it."""
        stop = getattr(self.wrapped, "stop_task", None)
        if self.gate.under_way or not callable(stop):
            return self.halt("stop_task").envelope()
        with self._shared.calling():
            answer: Envelope | None = stop()
        verdict = read_verdict(_StatusAfter(self, {"task": answer}))
        return answer if answer is not None and verdict.stopped else verdict.envelope()

    def get_task_status(self) -> Envelope:
        """Return the robot's own status; while a verb of its own runs, that."""
        own = getattr(self.wrapped, "get_task_status", None)
        verb = self.gate.under_way.name
        if callable(own):
            answer: Envelope = own()
            if not verb or not isinstance(answer, Mapping) or _task_status(answer) in RUNNING:
                return answer
        if not verb:
            return success("Nothing runs.", task_status="idle")
        return success(f"{verb} runs.", task_status="running", instruction=verb, verb=verb)

    def get_features(self) -> Envelope:
        """Return the robot's own features, or none."""
        own = getattr(self.wrapped, "get_features", None)
        if not callable(own):
            return success("It states no features.", observation_features={}, action_features={})
        answer: Envelope = own()
        return answer

    def get_state(self) -> Envelope:
        """Return the robot's own state, else its joints, ``joints_age_s`` and task.

        While its task runs, or it is being started or stopped, its joints are not read: it drives its bus itself, and
        does not know of our turns on it. They are then those of the last read, and ``joints_error`` says so.
        """
        own = getattr(self.wrapped, "get_state", None)
        if callable(own):
            answer: Envelope = own()
            return answer
        # One at a time, so that one that waited looks anew at what the robot does. No stop ever waits for this.
        with self._shared.reading:
            task = _facts(self.get_task_status())
            problem = self._refresh(_task_status(task) or "")
            read_at, joints = self._shared.read or (None, {})
        fields: dict[str, Any] = {"joints": dict(joints), "task": task}
        fields["joints_age_s"] = None if read_at is None else round(time.monotonic() - read_at, 4)
        if problem:
            fields["joints_error"] = problem
        return success(problem or f"{len(joints)} joints.", **fields)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        subscribe = getattr(self.wrapped, "subscribe", None)
        if callable(subscribe):
            unsubscribe: Unsubscribe = subscribe(observer)
            return unsubscribe
        return lambda: None

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """The robot's own ``halt`` where it has one, else its task and its teleoperation.

        Its status is read afterwards: a robot that says that its task runs has not stopped, whatever it answered.
        """
        began = time.monotonic()
        deadline = began + settings.number("STRANDS_HALT_DEADLINE_S")
        verdict = halted_with_verbs(self, lambda: self.halt_here(reason, deadline), deadline)
        return replace(verdict, elapsed_ms=(time.monotonic() - began) * 1000)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Ask everything to stop, and leave the answers and the status to be read."""
        self.gate.revoke()
        with self._shared.calling():
            own = getattr(self.wrapped, "halt", None)
            if callable(own):
                answers = {self.tool_name_str: _answer(lambda: own(reason))}
            else:
                parts = {"task": "stop_task", "teleoperation": "stop_teleoperate"}
                stops = {name: getattr(self.wrapped, verb, None) for name, verb in parts.items()}
                answers = {name: _answer(stop) for name, stop in stops.items() if callable(stop)}
        # Where there is none, its verbs return when their permits are void, which the stop executor waits for.
        return _StatusAfter(self, answers) if answers else StopVerdict()

    def _refresh(self, status: str) -> str:
        """Read the joints unless a call is disturbed; else return the reason."""
        if self._read_joints is None:
            return ""
        busy = "it is being started or stopped" if self._shared.called else "its task runs" if status in RUNNING else ""
        if busy:
            known = self._shared.read
            # A robot without joints has none that could be old.
            none = known is not None and not known[1]
            return "" if none else f"The joints are those of the last read: {busy}."
        began = time.monotonic()
        try:
            self._shared.read = (began, dict(self._read_joints(self.wrapped)))
        except Exception as exc:  # noqa: BLE001 - a bus raises what it likes; the answer says what
            return f"The joints could not be read: {type(exc).__name__}: {exc}"
        return ""


class _StatusAfter(PendingVerdict):
    """Answers of a foreign robot to a stop, and its status after them.

    Args:
        answers: by what was asked to stop; the status may contradict the first.
    """

    def __init__(self, robot: AdaptedRobot, answers: Mapping[str, object]) -> None:
        super().__init__(time.monotonic() + STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))
        self._robot, self._answers = robot, answers
        self._main = next(iter(answers))
        self._name = robot.tool_name_str

    def known(self) -> StopVerdict | None:
        refused = grade(self._answers[self._main]).stopped is False
        has_status = callable(getattr(self._robot.wrapped, "get_task_status", None))
        return None if has_status and not refused else self._verdict(self._answers[self._main])

    def read(self) -> str | None:
        try:
            return _task_status(self._robot.wrapped.get_task_status())
        except Exception:
            logger.exception("%s: its status could not be read after a stop.", self._name)
            return None

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        answer = self._answers[self._main]
        if reading in RUNNING:
            if not last:
                return None
            return self._verdict(
                error(f"its get_task_status says {reading} after the stop, which answered {shown(answer)}")
            )
        if reading not in AT_REST:
            # Text is an unknown answer to a stop.
            return self._verdict("task_status is none of idle, stopped, completed, error, running")
        return self._verdict(success("Stopped.", stopped=True) if answer is None else answer)

    def unread(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={self._main: f"{why}: its stop has returned, its status has not"})

    def _verdict(self, main: object) -> StopVerdict:
        answers = {**self._answers, self._main: main}
        return halt_each({name: partial(_given, answer) for name, answer in answers.items()})


def _task_status(answer: object) -> str | None:
    """Return the ``task_status`` of an answer, beside its content or inside it."""
    facts = [answer, *json_blocks(answer)] if isinstance(answer, Mapping) else []
    words = [fact["task_status"] for fact in facts if isinstance(fact.get("task_status"), str)]
    return words[0].lower() if words else None


def _answer(stop: Callable[[], object]) -> object:
    try:
        return stop()
    except Exception as exc:  # noqa: BLE001 - whatever a stop raises is graded
        return exc


def _given(answer: object) -> object:
    """Return the answer to a stop; as text None, which would mean that nothing moved."""
    return shown(answer) if answer is None else answer


def _facts(answer: object) -> dict[str, Any]:
    """Return the fields of an envelope; none for any other answer."""
    facts = answer if isinstance(answer, Mapping) else {}
    return {key: value for key, value in facts.items() if key not in ("status", "content")}
