"""Targets of a stop, as the stop executor sees them."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields
from typing import Any, Protocol, TypeGuard, cast, runtime_checkable

from strands_robots.safety.gate import MotionGate
from strands_robots.safety.stopping import PendingVerdict, StopVerdict
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)


@runtime_checkable
class Haltable(Protocol):
    """A robot with the one verb that halts every motion source and returns a verdict."""

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop everything that moves this robot; returns within the halt deadline."""


class RobotWrapper:
    """Robot that stands for another one: their stops are stops of one target."""

    wrapped: Any


def body_of(robot: Any) -> Any:
    """Return the robot that a wrapper stands for, else ``robot`` itself."""
    # By its type: isinstance may ask a robot for its __class__.
    return robot.wrapped if issubclass(type(robot), RobotWrapper) else robot


def holds_several(target: object) -> bool:
    """Return whether its class lists several robots, which its halt stops together."""
    return hasattr(type(target), "list_robots")


@runtime_checkable
class NotesMotion(Protocol):
    """Target that notes its motions before its permits are void."""

    def halt_ordered(self) -> None:
        """Note what moves. Must not block."""


@runtime_checkable
class HaltsInParts(Protocol):
    """Target whose verdict may have to be read after its halt.

    Its public ``halt`` is marked by :func:`~strands_robots.safety.stopping.halts_in_parts`.
    """

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Halt on this thread by ``deadline`` (monotonic s), unless the device blocks."""


@runtime_checkable
class DirectTarget(NotesMotion, HaltsInParts, Protocol):
    """Target that says itself what is known while its :meth:`halt_here` blocks.

    No second thread is started for it meanwhile: whatever blocks the first, such as its bus, would block the second.
    """

    def unanswered(self, why: str) -> StopVerdict:
        """Return the verdict while :meth:`halt_here` has not returned. Must not block."""


Target = Haltable | HaltsInParts


def note_motion(target: object) -> None:
    """Let a target note what moves, before its permits are void.

    Never raises: a stop follows.
    """
    # Of its class: an attribute of the robot's own may be looked up anywhere. A check of a protocol costs more than
    # a stop may.
    note = getattr(type(target), "halt_ordered", None)
    if note is not None:
        try:
            note(target)
        except Exception:
            logger.exception("A robot could not note what moves before its stop.")


def revoke_permits(target: object) -> None:
    """Void the permits of a target that has a gate of ours.

    Never raises: a stop follows.
    """
    try:
        # Without its ``__getattr__``, which may look names up anywhere.
        gate = object.__getattribute__(target, "gate")
    except AttributeError:
        return
    except Exception:
        logger.exception("The gate of a robot could not be read before its stop.")
        return
    if isinstance(gate, MotionGate):
        gate.revoke()


def has_parts(target: object) -> TypeGuard[HaltsInParts]:
    """Return whether the executor calls the parts of its halt."""
    kind = type(target)
    halt = getattr(kind, "halt", None)
    return hasattr(kind, "halt_here") and (halt is None or getattr(halt, "halts_in_parts", False))


def is_direct(target: object) -> TypeGuard[DirectTarget]:
    """Return whether it answers for itself while its halt blocks."""
    return has_parts(target) and hasattr(type(target), "unanswered")


def target_key(target: Target) -> Hashable:
    """Return an identity that is equal for the same target."""
    body = body_of(target)
    params = getattr(type(body), "__dataclass_params__", None)
    if params is None or not (params.frozen and params.eq):
        return id(body)
    # By the identity of its parts, which may be robots without a hash, and by the value of a name.
    parts = (getattr(body, each.name) for each in fields(cast(Any, body)))
    return (type(body), *(part if isinstance(part, str) else id(part) for part in parts))
