"""Robot contract as types, and the adapter of foreign robots.

Networks, tools and the command line reach a robot only through these protocols. A robot of ours implements
:class:`TaskRobot` or :class:`WorldRobot`; any other object is wrapped by :func:`adapt`, best one with ``start_task``,
``stop_task``, ``get_task_status`` and ``get_features``: what it lacks is refused by name.
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import FunctionType, MethodType
from typing import TYPE_CHECKING, Any, Generic, Literal, ParamSpec, Protocol, TypeVar, runtime_checkable

from strands_robots.envelope import Envelope, error
from strands_robots.safety.gate import MotionGate, MotionRequest, VerbCall, gate_of
from strands_robots.safety.stop_targets import Haltable as Haltable  # noqa: PLC0414 - part of the contract
from strands_robots.safety.stop_targets import body_of as body_of  # noqa: PLC0414 - part of the contract
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap

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


@dataclass(frozen=True, slots=True)
class RolloutEvent:
    """An event of a rollout, given to observers from the control thread.

    ``kind`` is started, step, turn or finished; ``state`` of a finished one is completed, stopped or error. A turn
    tells who drives from now on, of a robot that a leader elsewhere has: ``state`` is policy, led or held, ``error``
    the reason of a hold, ``led_by`` the leader.
    ``clamped_steps`` counts the actions that the robot's speed limit held back.
    ``observation`` and ``action`` hold numbers only, by joint name, in the robot's own units. ``follows_instruction``
    is False for a policy that moves by itself, whatever it was told, as ``mock`` does. ``loop`` of a finished one has
    the figures of its control loop. ``led_by`` of a step is the leader that had taken over from the policy.
    """

    kind: Literal["started", "step", "turn", "finished"]
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
    led_by: str = ""


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


def has_gate(robot: object) -> bool:
    """Return True for a robot with a gate of ours; a test double has any attribute."""
    return isinstance(getattr(robot, "gate", None), MotionGate)


def stated_name(robot: object, usual: str = "robot") -> str:
    """Return a robot's ``tool_name_str`` where that is a text, else the usual name."""
    stated = getattr(robot, "tool_name_str", "")
    return stated if isinstance(stated, str) and stated else usual


_worlds: IdentityMap[bool] = IdentityMap()


def holds_robots(robot: object) -> TypeIs[WorldRobot]:
    """Return True for a world, which holds robots or may be given some."""
    if not callable(getattr(robot, "list_robots", None)):
        return False
    # Asked for every heartbeat and command; to check the whole contract takes 20 us.
    return _worlds.get(robot) or (isinstance(robot, WorldRobot) and has_gate(robot) and _worlds.of(robot, lambda: True))


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
