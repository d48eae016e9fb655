"""Adapter of foreign robots: any object behind the contract.

What an object lacks is bridged here alone: refused by name when it is called, and *did not stop* where it has no way
to halt.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from inspect import signature
from types import ModuleType
from typing import Any, Protocol, cast

from strands_robots import settings
from strands_robots.contract import (
    AT_REST,
    RUNNING,
    Joints,
    Observer,
    Robot,
    TaskRobot,
    Unsubscribe,
    WorldRobot,
    for_request,
    has_gate,
    holds_robots,
    stated_name,
)
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionRefused, MotionRequest, gate_of
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import RobotWrapper
from strands_robots.safety.stopping import (
    PendingVerdict,
    StopVerdict,
    grade,
    halt_each,
    halts_in_parts,
    json_blocks,
    read_verdict,
    verdict_of,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, ValidationError, shown
from strands_robots.verb_declaration import declared_verbs

logger = stop_logger(__name__)

STATUS_SHARE = 0.5
"""Part of the halt deadline for which the status may go on saying that the task runs."""

JointReader = Callable[[Any], Mapping[str, float]]
"""Reads a robot's joints, by name in its own unit; empty where it has none. Raises what the robot raises."""


class ForeignRobot(Protocol):
    """Verbs of another's robot that :func:`adapt` makes fit, and their answers.

    A robot may lack some of them. Further keys are passed on. A robot with a ``halt(reason)`` of its own is halted by
    that, and one with a ``stop_teleoperate()`` by that as well; both answer as :meth:`stop_task` does.
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


_TASK_VERBS = ("start_task", "stop_task", "get_task_status", "get_features")
_VALUES = (str, bytes, bool, int, float, list, tuple, dict, set, frozenset, type, ModuleType)


def adapt(robot: Any, joints: JointReader | None = None) -> TaskRobot:
    """Return ``robot`` when it fits :class:`TaskRobot`, else a wrapper that does.

    Args:
        robot: any object; what it lacks of a :class:`ForeignRobot` is refused by name when it is called.
        joints: reads the joints of a robot that has no ``get_state`` of its own; without it those are none.

    Raises:
        ValidationError: ``robot`` is a plain value, such as a name.
    """
    if isinstance(robot, TaskRobot) and has_gate(robot):
        return robot
    return AdaptedRobot(checked_object(robot), joints)


def is_value(value: object) -> bool:
    """Return True for a text, a number, a collection, a class or a module."""
    return issubclass(type(value), _VALUES)


def checked_object(robot: object) -> object:
    """Return what may be another's robot.

    Raises:
        ValidationError: it is None or a plain value, such as a name.
    """
    if robot is None or is_value(robot):
        raise ValidationError(f"robot must be an object with {', '.join(_TASK_VERBS)}, not {shown(robot)}.")
    return robot


def behind_contract(robot: Any, joints: JointReader | None = None) -> Robot:
    """Return a world as it is, and any other robot as :func:`adapt` makes it fit.

    An object with ``list_robots`` and ``stop_policy``, and no ``start_task``, is a world of others'.

    Raises:
        ValidationError: as :func:`adapt`.
    """
    if holds_robots(robot) or isinstance(robot, AdaptedRobot):
        return robot
    has = {name: callable(getattr(robot, name, None)) for name in ("list_robots", "stop_policy", "start_task")}
    if has["list_robots"] and has["stop_policy"] and not has["start_task"]:
        return AdaptedWorld(checked_object(robot))
    return adapt(robot, joints)


def adapt_world(world: Any) -> WorldRobot:
    """Return ``world`` when it fits :class:`WorldRobot`, else a wrapper that does.

    Raises:
        ValidationError: it is a plain value, such as a name.
    """
    return world if holds_robots(world) else AdaptedWorld(checked_object(world))


class _Shared:
    """State that all wrappers of one foreign robot share, on every network."""

    def __init__(self) -> None:
        self.reading = threading.Lock()
        self.read: tuple[float, Joints] | None = None
        self.warned = False
        self.known: dict[str, None] = {}
        """Robots of a world that it listed last, or that were started from here since."""
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


NO_STOP = "it exposes neither stop_task nor halt, so nothing of ours can stop it"
"""Reason in the verdict on a robot without a way to halt."""


class AdaptedRobot(RobotWrapper):
    """Foreign robot behind the contract; its own optional verbs are used.

    What it lacks is refused by name. A robot with verbs of its own (``@verb``) may have no tasks at all: its verbs are
    stopped by their permits, and it has no task status and no features unless it says so.
    """

    def __init__(self, robot: Any, joints: JointReader | None = None) -> None:
        self.wrapped = robot
        self._read_joints = joints
        usual = "robot" if callable(getattr(robot, "start_task", None)) else type(robot).__name__.lower()
        self.tool_name_str: str = stated_name(robot, usual)
        self._shared = _known.of(robot, _Shared)
        self.gate = gate_of(robot)
        self._declares_verbs = bool(declared_verbs(robot))

    @property
    def halts(self) -> bool:
        """False where neither the robot nor the end of its permits can stop it."""
        wrapped = self.wrapped
        by_permits = self._declares_verbs and not callable(getattr(wrapped, "start_task", None))
        return by_permits or stops_motions(wrapped)

    @property
    def lacks(self) -> tuple[str, ...]:
        """The verbs of the contract that it refuses by name."""
        if self._declares_verbs and self.halts:
            return ()
        return tuple(verb for verb in _TASK_VERBS if not callable(getattr(self.wrapped, verb, None)))

    def warn_endless(self, name: str) -> None:
        """Warn once in the robot's life, where it has no way to halt."""
        _warn_once(self._shared, name, halts=self.halts)

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
            return error(no_tasks(self, self.tool_name_str))
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
        if not verb and "get_task_status" in self.lacks:
            return error(f"{self.tool_name_str} exposes no get_task_status.", task_status="unknown")
        if not verb:
            return success("Nothing runs.", task_status="idle")
        return success(f"{verb} runs.", task_status="running", instruction=verb, verb=verb)

    def get_features(self) -> Envelope:
        """Return the robot's own features, or none."""
        own = getattr(self.wrapped, "get_features", None)
        if not callable(own) and "get_features" in self.lacks:
            return error(f"{self.tool_name_str} exposes no get_features.")
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
        unsubscribe: Unsubscribe = subscribe(observer) if callable(subscribe) else lambda: None
        return unsubscribe

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """The robot's own ``halt`` where it has one, else its task and its teleoperation.

        Its status is read afterwards: a robot that says that its task runs has not stopped, whatever it answered.
        """
        # A stop or a status of a stranger may hang, and the caller of a halt waits for its deadline at most.
        return stop_executor().halt(self, self.tool_name_str, reason)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Ask everything to stop, and leave the answers and the status to be read."""
        self.gate.revoke()
        with self._shared.calling():
            own = getattr(self.wrapped, "halt", None)
            if callable(own):
                answers = {self.tool_name_str: _answer(_with_reason(own, reason))}
            else:
                parts = {"task": "stop_task", "teleoperation": "stop_teleoperate"}
                stops = {name: getattr(self.wrapped, verb, None) for name, verb in parts.items()}
                answers = {name: _answer(stop) for name, stop in stops.items() if callable(stop)}
        if not self.halts:
            others = {name: partial(_given, answer) for name, answer in answers.items()}
            return halt_each({self.tool_name_str: partial(error, NO_STOP), **others})
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


RUNS_ON, SILENT = "its world lists it as running after the stop", "it has not answered its stop"

ORDER_SHARE = 0.2
"""Part of the halt deadline for which robots of a world are stopped one after another; the rest are at once."""

_WORLD_VERBS = ("list_robots", "start_policy", "stop_policy", "list_policies_running", "get_state", "get_features")


class AdaptedWorld(RobotWrapper):
    """Foreign simulation behind a world's contract; what it lacks is refused by name."""

    def __init__(self, world: Any) -> None:
        self.wrapped = world
        self.tool_name_str: str = stated_name(world, "simulation")
        self.gate = gate_of(world)
        self._shared = _known.of(world, _Shared)

    @property
    def halts(self) -> bool:
        """False where it has no way to halt that we know."""
        stops = self._own("list_robots") is not None and self._own("stop_policy") is not None
        return stops or stops_motions(self.wrapped)

    @property
    def lacks(self) -> tuple[str, ...]:
        """The verbs of the contract that it refuses by name."""
        return tuple(verb for verb in (*_WORLD_VERBS, "step", "reset") if self._own(verb) is None)

    def list_robots(self) -> list[str]:
        return self.listed() or []

    def listed(self) -> list[str] | None:
        """Return the names of its robots; None for a list that cannot be read."""
        names = _texts(self._ask("list_robots"))
        if names is not None:
            self._shared.known = dict.fromkeys(names)
        return names

    @property
    def runs(self) -> Callable[[], set[str]] | None:
        """Reads the names of robots whose policies run; None where it cannot say."""
        if self._own("list_policies_running") is None:
            return None
        return lambda: {row["robot"] for row in self.list_policies_running() if isinstance(row.get("robot"), str)}

    def list_policies_running(self) -> list[dict[str, Any]]:
        return [row for row in self._listed("list_policies_running") if isinstance(row, dict)]

    def start_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        *,
        request: MotionRequest | None = None,
        **policy: Any,
    ) -> Envelope:
        self._shared.known[robot_name] = None
        named = {"robot_name": robot_name, "instruction": instruction, "policy_provider": policy_provider}
        return self._motion("start_policy", request, **named, duration=duration, **policy)

    def stop_policy(self, robot_name: str) -> Envelope:
        return self._ask("stop_policy", robot_name=robot_name)

    def get_state(self) -> Envelope:
        return self._ask("get_state")

    def get_features(self) -> Envelope:
        return self._ask("get_features")

    def step(self, n: int = 1, *, request: MotionRequest | None = None) -> Envelope:
        return self._motion("step", request, n)

    def reset(self, *, request: MotionRequest | None = None) -> Envelope:
        return self._motion("reset", request)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        subscribe = self._own("subscribe")
        unsubscribe: Unsubscribe = (lambda: None) if subscribe is None else subscribe(observer)
        return unsubscribe

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """The world's own ``halt`` or ``stop_task``, else ``stop_policy`` of each robot.

        Its teleoperation is stopped besides.
        """
        return stop_executor().halt(self, self.tool_name_str, reason)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Ask everything to stop: the robots that are known before the world is read.

        Each robot is stopped on a thread of the stop executor's, so that one that hangs leaves the others their stops.
        """
        self.gate.revoke()
        halt, stop = self._own("halt"), self._own("stop_task")
        whole = stop if halt is None else _with_reason(halt, reason)
        answers: dict[str, object] = {}
        halting: dict[str, Future[StopVerdict]] = {}
        if whole is not None:
            answers[self.tool_name_str] = _answer(whole)
        elif self.halts:
            patience = time.monotonic() + ORDER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
            self._stop_each(tuple(self._shared.known), halting, reason, patience)
            listed = _answer(partial(self._ask, "list_robots"))
            names = _texts(listed)
            if names is None:
                answers[self.tool_name_str] = error(f"its robots could not be listed: {shown(listed)}")
            else:
                for gone in halting.keys() - set(names):
                    del halting[gone]
                self._shared.known = dict.fromkeys(names)
                self._stop_each([name for name in names if name not in halting], halting, reason, patience)
        else:
            answers[self.tool_name_str] = error(NO_STOP)
        teleoperation = self._own("stop_teleoperate")
        if teleoperation is not None:
            answers["teleoperation"] = _answer(teleoperation)
        rest = halt_each({name: partial(_given, answer) for name, answer in answers.items()})
        return _RobotsHalting(self, halting, rest) if halting or self.runs is not None else rest

    def _stop_each(
        self, names: Iterable[str], halting: dict[str, Future[StopVerdict]], reason: str, patience: float
    ) -> None:
        """Have each robot stopped, in order while their answers come in time."""
        for name in names:
            halting[name] = stop_executor().submit(_OneOfWorld(self.wrapped, name), name, reason)
            wait([halting[name]], max(0.0, patience - time.monotonic()))

    def warn_endless(self, name: str) -> None:
        """Warn once in its life, where it has no way to halt."""
        _warn_once(self._shared, name, halts=self.halts)

    def _own(self, verb: str) -> Callable[..., Any] | None:
        own = getattr(self.wrapped, verb, None)
        return own if callable(own) else None

    def _listed(self, verb: str) -> list[Any]:
        own = self._own(verb)
        answer = [] if own is None else own()
        return list(answer) if isinstance(answer, list | tuple) else []

    def _ask(self, verb: str, *values: Any, **named: Any) -> Envelope:
        own = self._own(verb)
        if own is None:
            return error(f"{self.tool_name_str} exposes no {verb}.")
        answer: Envelope = own(*values, **named)
        return answer

    def _motion(self, verb: str, request: MotionRequest | None, *values: Any, **named: Any) -> Envelope:
        if self._own(verb) is None:
            return self._ask(verb)
        try:
            permit = self.gate.permit(verb, request)
            permit.wait()
            permit.check()
        except MotionRefused as refused:
            return refused.envelope
        answer = for_request(permit.request, self._ask)(verb, *values, **named)
        if not permit.valid:
            permit.begin()
            again = self.halt("halted while it started")
            end = "and was stopped again" if again.stopped else "and DID NOT STOP AGAIN"
            return error(f"{verb} is refused: {self.tool_name_str} was halted meanwhile, {end}.")
        return answer


@dataclass(frozen=True)
class _OneOfWorld:
    """Target of the stop executor: one robot of a foreign world."""

    world: Any
    name: str

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop its policy and grade the answer."""
        return verdict_of(lambda: _given(self.world.stop_policy(robot_name=self.name)), self.name)


class _RobotsHalting(PendingVerdict):
    """Verdict on a foreign world: its robots that are being stopped, then what runs."""

    def __init__(self, world: AdaptedWorld, halting: Mapping[str, Future[StopVerdict]], rest: StopVerdict) -> None:
        super().__init__(time.monotonic() + STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))
        self._runs, self._halting, self._rest = world.runs, dict(halting), rest

    def known(self) -> StopVerdict | None:
        return self._verdict({}) if self._runs is None and self._answered() else None

    def read(self) -> set[str]:
        wait(self._halting.values(), max(0.0, self.until - time.monotonic()))
        return set() if self._runs is None else self._runs()

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        running = cast("set[str]", reading)
        return self._verdict(dict.fromkeys(running, RUNS_ON)) if last or (self._answered() and not running) else None

    def unread(self, why: str) -> StopVerdict:
        return self._verdict({} if self._runs is None else dict.fromkeys(self._halting, why))

    def _answered(self) -> bool:
        return all(each.done() for each in self._halting.values())

    def _verdict(self, goes_on: Mapping[str, str]) -> StopVerdict:
        silent = {name: StopVerdict(not_stopped={name: SILENT}) for name, each in self._halting.items()}
        ends = [each.result() if each.done() else silent[name] for name, each in self._halting.items()] + [self._rest]
        return StopVerdict(
            tuple(name for end in ends for name in end.halted if name not in goes_on),
            {**goes_on, **{name: said for end in ends for name, said in end.not_stopped.items()}},
            {name: said for end in ends for name, said in end.unknown.items()},
        )


def _texts(listed: object) -> list[str] | None:
    """Return the names in a list of robots; None for what may hide some."""
    if not isinstance(listed, list | tuple | set | frozenset):
        return None
    names = [name for name in listed if isinstance(name, str)]
    return names if len(names) == len(listed) else None


def _warn_once(shared: _Shared, name: str, *, halts: bool) -> None:
    if not halts and not shared.warned:
        shared.warned = True
        logger.warning("%s cannot be stopped: %s. Every stop is answered so.", name, NO_STOP)


Adapted = AdaptedRobot | AdaptedWorld


def simulated(robot: object, peer_type: str) -> bool:
    """Return True for a simulation, whose motions need no operator's approval.

    Worlds of ours are, and of others' those of the type ``sim``: another may be a cell of real arms.
    """
    ours = holds_robots(robot) and not isinstance(robot, AdaptedWorld)
    return peer_type == "sim" or (ours and getattr(robot, "of_package", False) is not True)


def lacks(robot: object) -> tuple[str, ...]:
    """Return the verbs of the contract that a robot refuses by name."""
    return robot.lacks if isinstance(robot, Adapted) else ()


def task_status_of(world: WorldRobot) -> str:
    """Return ``running`` or ``idle``; ``unknown`` for a world that lists no policies."""
    if "list_policies_running" in lacks(world):
        return "unknown"
    return "running" if world.list_policies_running() else "idle"


def no_tasks(robot: object, name: str) -> str:
    """Return why a robot starts no task."""
    if "start_task" in lacks(robot):
        return f"{name} exposes no start_task."
    return f"{name} runs no tasks; it has verbs of its own."


def warn_endless(robot: object, name: str) -> None:
    """Warn of a robot that no stop can end; once, however many networks serve it."""
    if isinstance(robot, Adapted):
        robot.warn_endless(name)


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


def _with_reason(halt: Callable[..., object], reason: str) -> Callable[[], object]:
    """Return the call of a stranger's halt, which may take no reason."""
    # One that states no signature is given the reason.
    with suppress(ValueError):
        try:
            signature(halt).bind(reason)
        except TypeError:
            return halt
    return partial(halt, reason)


def _given(answer: object) -> object:
    """Return the answer to a stop; as text None, which would mean that nothing moved."""
    return shown(answer) if answer is None else answer


def _facts(answer: object) -> dict[str, Any]:
    """Return the fields of an envelope; none for any other answer."""
    facts = answer if isinstance(answer, Mapping) else {}
    return {key: value for key, value in facts.items() if key not in ("status", "content")}
