"""Adapter of foreign robots: any object behind the contract.

What an object lacks is bridged here alone: refused by name when it is called, and *did not stop* where it has no way
to halt.
"""

from __future__ import annotations

from typing import Any

from strands_robots.adapted.foreign import (
    STATUS_SHARE,
    ForeignRobot,
    JointReader,
    checked_object,
    is_value,
    no_tasks,
    stops_motions,
)
from strands_robots.adapted.robot import AdaptedRobot
from strands_robots.adapted.world import RUNS_ON, AdaptedWorld
from strands_robots.contract import Robot, TaskRobot, WorldRobot, has_gate, holds_robots


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


def warn_endless(robot: object, name: str) -> None:
    """Warn of a robot that no stop can end; once, however many networks serve it."""
    if isinstance(robot, Adapted):
        robot.warn_endless(name)


__all__ = [
    "RUNS_ON",
    "STATUS_SHARE",
    "AdaptedRobot",
    "AdaptedWorld",
    "ForeignRobot",
    "JointReader",
    "adapt",
    "adapt_world",
    "behind_contract",
    "checked_object",
    "is_value",
    "lacks",
    "no_tasks",
    "simulated",
    "stops_motions",
    "task_status_of",
    "warn_endless",
]
