"""What every robot here can do, as types, and the one place where a foreign robot is made to fit.

Networks, tools and the command line reach a robot only through these protocols. A robot of ours implements
:class:`TaskRobot` or :class:`WorldRobot`; any other object with ``start_task``, ``stop_task``,
``get_task_status`` and ``get_features`` is wrapped by :func:`adapt`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.stopping import StopVerdict, halt_each
from strands_robots.utils import ValidationError, shown

Joints = dict[str, float]


@dataclass(frozen=True, slots=True)
class RolloutEvent:
    """Something that happened in a rollout, told to observers from the control thread.

    ``kind`` is started, step or finished; ``state`` of a finished one is completed, stopped or error.
    ``observation`` and ``action`` hold numbers only, by joint name, in the robot's own units.
    """

    kind: Literal["started", "step", "finished"]
    robot: str
    instruction: str
    policy: str
    step: int = 0
    elapsed_s: float = 0.0
    state: str = "running"
    error: str = ""
    observation: Mapping[str, float] = field(default_factory=dict)
    action: Mapping[str, float] = field(default_factory=dict)


Observer = Callable[[RolloutEvent], None]
"""Called from the control thread: it must return at once and may not raise."""

Unsubscribe = Callable[[], None]


@runtime_checkable
class Haltable(Protocol):
    """The one verb that halts every motion source and says what it did."""

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop everything that moves this robot; returns within the halt deadline."""


@runtime_checkable
class TaskRobot(Haltable, Protocol):
    """A robot with one body: real hardware, or anything that :func:`adapt` made fit."""

    tool_name_str: str
    gate: MotionGate

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Start a rollout and return at once; ``duration`` in seconds, port 0 the provider's default."""

    def stop_task(self) -> Envelope:
        """Stop the rollout; ``stopped`` is false when its loop outlived the join."""

    def get_task_status(self) -> Envelope:
        """``task_status``, ``instruction``, ``step_count``, ``duration`` of the current or last task."""

    def get_features(self) -> Envelope:
        """``observation_features`` and ``action_features``, as data."""

    def get_state(self) -> Envelope:
        """``joints`` (name to position in the device's unit) and ``task``."""

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every rollout event until the returned callable is called."""


@runtime_checkable
class WorldRobot(Haltable, Protocol):
    """A simulated world that holds several robots, each with its own rollout."""

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
        """``sim_time`` (s), ``step_count``, ``robots`` (name to joints in radians) and ``running_policies``."""

    def get_features(self) -> Envelope:
        """Joints, actuators and cameras by robot."""

    def step(self, n: int = 1) -> Envelope:
        """Advance physics by ``n`` time steps, as fast as they compute."""

    def reset(self) -> Envelope:
        """Halt, then put the world back to its initial state."""

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every rollout event until the returned callable is called."""


JointReader = Callable[[Any], Mapping[str, float]]
"""Reads a robot's joints, by name in its own unit; empty where it has none. Raises what the robot raises."""

_TASK_VERBS = ("start_task", "stop_task", "get_task_status", "get_features")


def adapt(robot: Any, joints: JointReader | None = None) -> TaskRobot:
    """``robot`` itself when it fits :class:`TaskRobot`, else a wrapper that gives it what it lacks.

    Args:
        robot: what is to fit.
        joints: reads the joints of a robot that has no ``get_state`` of its own; without it those are none.

    Raises:
        ValidationError: ``robot`` lacks one of start_task, stop_task, get_task_status, get_features.
    """
    if isinstance(robot, TaskRobot):
        return robot
    missing = [verb for verb in _TASK_VERBS if not callable(getattr(robot, verb, None))]
    if missing:
        raise ValidationError(f"robot must have {', '.join(_TASK_VERBS)}; {shown(robot)} lacks {', '.join(missing)}.")
    return AdaptedRobot(robot, joints)


class _PutAway:
    def refusal(self, verb: str) -> Envelope:
        return error(f"{verb} is refused: the robot is being taken off its network.")


def put_away(robot: Any) -> Callable[[], None]:
    """Let nothing begin on ``robot`` from now on, over whatever network; what is returned takes that back.

    For whoever halts a robot and then leaves its network: a motion asked for in between would outlive the process.
    """
    gate, latch = _gate_of(robot), _PutAway()
    gate.attach(latch)
    return lambda: gate.detach(latch)


_gates: WeakKeyDictionary[Any, MotionGate] = WeakKeyDictionary()


def _gate_of(robot: Any) -> MotionGate:
    """The robot's own gate, else one for it: the same however often it is wrapped, so that a stop voids all roads."""
    own = getattr(robot, "gate", None)
    if isinstance(own, MotionGate):
        return own
    try:
        return _gates.setdefault(robot, MotionGate())
    except TypeError:  # it cannot be a key; each wrapper has a gate, and every emergency stop knows them all
        return MotionGate()


class AdaptedRobot:
    """A foreign robot behind the contract: gated, haltable, with its own optional verbs used where it has them."""

    def __init__(self, robot: Any, joints: JointReader | None = None) -> None:
        self.wrapped = robot
        self._read_joints = joints
        self.tool_name_str: str = str(getattr(robot, "tool_name_str", "") or "robot")
        self.gate = _gate_of(robot)

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        try:
            permit = self.gate.permit("start_task")
        except MotionRefused as refused:
            return refused.envelope
        answer: Envelope = self.wrapped.start_task(
            instruction, policy_provider=policy_provider, duration=duration, policy_port=policy_port
        )
        if not permit.valid:
            # The stop came while the robot was starting, and may have found nothing to stop.
            again = self.halt("halted while it started")
            end = "and was stopped again" if again.stopped else "and DID NOT STOP AGAIN"
            return error(f"start_task is refused: {self.tool_name_str} was halted while it started, {end}.")
        return answer

    def stop_task(self) -> Envelope:
        answer: Envelope = self.wrapped.stop_task()
        return answer

    def get_task_status(self) -> Envelope:
        answer: Envelope = self.wrapped.get_task_status()
        return answer

    def get_features(self) -> Envelope:
        answer: Envelope = self.wrapped.get_features()
        return answer

    def get_state(self) -> Envelope:
        """The robot's own state where it tells one, else its joints and task; ``joints_error`` says why it has none."""
        own = getattr(self.wrapped, "get_state", None)
        if callable(own):
            answer: Envelope = own()
            return answer
        fields: dict[str, Any] = {"joints": {}, "task": _facts(self.get_task_status())}
        try:
            if self._read_joints is not None:
                fields["joints"] = dict(self._read_joints(self.wrapped))
        except Exception as exc:  # noqa: BLE001 - a bus raises what it likes; the answer says what
            fields["joints_error"] = f"The joints could not be read: {type(exc).__name__}: {exc}"
        return success(fields.get("joints_error") or f"{len(fields['joints'])} joints.", **fields)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        subscribe = getattr(self.wrapped, "subscribe", None)
        if callable(subscribe):
            unsubscribe: Unsubscribe = subscribe(observer)
            return unsubscribe
        return lambda: None

    def halt(self, reason: str = "") -> StopVerdict:
        """The robot's own ``halt`` where it has one, else its task and its teleoperation."""
        self.gate.revoke()
        own = getattr(self.wrapped, "halt", None)
        if callable(own):
            return halt_each({self.tool_name_str: lambda: own(reason)})
        sources: dict[str, Callable[[], object]] = {"task": self.wrapped.stop_task}
        teleop = getattr(self.wrapped, "stop_teleoperate", None)
        if callable(teleop):
            sources["teleoperation"] = teleop
        return halt_each(sources)


def _facts(answer: object) -> dict[str, Any]:
    """What an envelope tells, without its form; a foreign robot may answer with something else."""
    told = answer if isinstance(answer, Mapping) else {}
    return {key: value for key, value in told.items() if key not in ("status", "content")}
