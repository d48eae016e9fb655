"""Task of a robot, as its status, its state and its presence report it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from strands_robots.contract import RUNNING
from strands_robots.utils import plain_text

TASK_MAX = 2000
"""Characters of a text of a task."""


def task_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a robot does, of a world its first task.

    It has ``state``, ``instruction``, and as far as they are reported ``step``, ``policy`` and ``who``, which is the
    robot of the world. The texts are plain, and a step is an integer.
    """
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        named = next(((name, row) for name, row in running.items() if isinstance(row, Mapping)), None)
        if named is None:
            return {"state": "idle"}
        name, row = named
        policy, instruction = _text(row.get("policy")), _text(row.get("instruction"))
        return {
            "state": "running",
            "instruction": instruction,
            "policy": policy,
            **_step(row.get("step")),
            "who": _text(name),
        }
    task = {"state": _text(facts.get("task_status")).lower() or "idle", "instruction": _text(facts.get("instruction"))}
    return task | _step(facts.get("step_count"))


def runs(facts: Mapping[str, Any], robot_name: str = "") -> bool:
    """Return whether a robot, or one of a world, runs a task by its status."""
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        return robot_name in running if robot_name else bool(running)
    return str(facts.get("task_status", "")).lower() in RUNNING


def _text(value: object) -> str:
    return plain_text(value, TASK_MAX)


def _step(value: object) -> dict[str, int]:
    return {"step": value} if isinstance(value, int) and not isinstance(value, bool) else {}
