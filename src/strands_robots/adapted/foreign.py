"""Foreign robots: what may be one, what all adapters of it share, its stops."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from inspect import signature
from types import ModuleType
from typing import Any, Protocol

from strands_robots import settings
from strands_robots.contract import (
    Joints,
)
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict, verdict_of
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, ValidationError, shown

logger = stop_logger(__name__)

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


TASK_VERBS = ("start_task", "stop_task", "get_task_status", "get_features")
STATUS_SHARE = 0.5
"""Part of the halt deadline for which the status may go on saying that the task runs."""

SILENT = "it has not answered its stop"

ORDER_SHARE = 0.2
"""Part of the halt deadline for which parts of a robot are stopped one after another; the rest are at once."""

_VALUES = (str, bytes, bool, int, float, list, tuple, dict, set, frozenset, type, ModuleType)


def is_value(value: object) -> bool:
    """Return True for a text, a number, a collection, a class or a module."""
    return issubclass(type(value), _VALUES)


def checked_object(robot: object) -> object:
    """Return what may be another's robot.

    Raises:
        ValidationError: it is None or a plain value, such as a name.
    """
    if robot is None or is_value(robot):
        raise ValidationError(f"robot must be an object with {', '.join(TASK_VERBS)}, not {shown(robot)}.")
    return robot


class SharedState:
    """State that all wrappers of one foreign robot share, on every network."""

    def __init__(self) -> None:
        self.reading = threading.Lock()
        self.read: tuple[float, Joints] | None = None
        self.warned = False
        self.rest_stopped = threading.Event()
        """Set once everything but its teleoperation has answered the last halt."""

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


_states: IdentityMap[SharedState] = IdentityMap()


def shared_state(robot: object) -> SharedState:
    """Return what all wrappers of a foreign robot share."""
    return _states.of(robot, SharedState)


def stops_motions(robot: object) -> bool:
    """Return True for a robot with a ``halt`` or a ``stop_task``."""
    return any(callable(getattr(robot, name, None)) for name in ("halt", "stop_task"))


NO_STOP = "it exposes neither stop_task nor halt, so nothing of ours can stop it"
"""Reason in the verdict on a robot without a way to halt."""


def warn_once(shared: SharedState, name: str, *, halts: bool) -> None:
    if not halts and not shared.warned:
        shared.warned = True
        logger.warning("%s cannot be stopped: %s. Every stop is answered so.", name, NO_STOP)


def no_tasks(lacking: Collection[str], name: str) -> str:
    """Return why a robot that lacks those verbs starts no task."""
    if "start_task" in lacking:
        return f"{name} exposes no start_task."
    return f"{name} runs no tasks; it has verbs of its own."


def answer_of(stop: Callable[[], object]) -> object:
    try:
        return stop()
    except Exception as exc:  # noqa: BLE001 - whatever a stop raises is graded
        return exc


def with_reason(halt: Callable[..., object], reason: str) -> Callable[[], object]:
    """Return the call of a stranger's halt, which may take no reason."""
    # One that states no signature is given the reason.
    with suppress(ValueError):
        try:
            signature(halt).bind(reason)
        except TypeError:
            return halt
    return partial(halt, reason)


def given(answer: object) -> object:
    """Return the answer to a stop; as text None, which would mean that nothing moved."""
    return shown(answer) if answer is None else answer


def facts_of(answer: object) -> dict[str, Any]:
    """Return the fields of an envelope; none for any other answer."""
    facts = answer if isinstance(answer, Mapping) else {}
    return {key: value for key, value in facts.items() if key not in ("status", "content")}


@contextmanager
def teleoperation_stopped_after(
    robot: Any, shared: SharedState, reason: str
) -> Iterator[dict[str, Future[StopVerdict]]]:
    """Yield the stop of its teleoperation, which begins when the block is over.

    A stop that hangs in the block does not keep it: it begins then after :data:`ORDER_SHARE` of the deadline. Empty for
    a robot without ``stop_teleoperate``.
    """
    if not callable(getattr(robot, "stop_teleoperate", None)):
        yield {}
        return
    shared.rest_stopped = over = threading.Event()
    try:
        # Given up when the verdict is, so that the next stop finds a thread.
        within = STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        part = _TeleoperationOf(robot, shared)
        yield {"teleoperation": stop_executor().submit(part, "teleoperation", reason, within=within)}
    finally:
        over.set()


@dataclass(frozen=True)
class _TeleoperationOf:
    """Target of the stop executor: the teleoperation of one robot."""

    robot: Any
    shared: SharedState

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop it and grade the answer."""
        self.shared.rest_stopped.wait(ORDER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))
        return verdict_of(lambda: given(self.robot.stop_teleoperate()), "teleoperation")
