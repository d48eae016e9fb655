"""Reports of a robot: its task, its joints, and its events, which are bounded."""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Self

from strands_robots.contract import RUNNING
from strands_robots.fleet.adapter import NetworkAdapter, RobotEvent
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


Range = tuple[float, float]
"""Lower and upper limit of a joint, in the unit that the robot states."""

JOINTS_MAX = 64


def joint_limits(features: Mapping[str, Any]) -> dict[str, Range]:
    """Return the joint limits in an answer to getFeatures; a world's first robot."""
    chosen = _first(features)
    found: dict[str, Range] = {}
    for key in ("joints", "ranges"):
        joints = chosen.get(key)
        for name, limits in joints.items() if isinstance(joints, Mapping) else ():
            pair = [value for value in limits if _finite(value)] if isinstance(limits, list | tuple) else []
            if len(pair) == 2 and pair[0] < pair[1]:
                # A real robot names the range of an action, such as pan.pos, and the position of the joint, pan.
                found[str(name)] = found[str(name).removesuffix(".pos")] = (float(pair[0]), float(pair[1]))
    return found


def joint_units(features: Mapping[str, Any]) -> dict[str, str]:
    """Return the unit of each joint in an answer to getFeatures.

    Of a world these are the first robot's.
    """
    units = _first(features).get("joint_units")
    named = list(units.items())[:JOINTS_MAX] if isinstance(units, Mapping) else []
    found = {str(name): str(unit)[:40] for name, unit in named}
    # A real robot names the unit of an action, such as pan.pos, and the position of the joint, pan.
    return {**{name.removesuffix(".pos"): unit for name, unit in found.items()}, **found}


def _first(features: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the features of a robot, of a world those of its first one."""
    robots = features.get("robots")
    chosen = next(iter(robots.values())) if isinstance(robots, Mapping) and robots else features
    return chosen if isinstance(chosen, Mapping) else {}


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


EVENTS_MAX = 10_000
"""Events that wait for a slow reader; a further one displaces the oldest."""

BYTES_MAX = 64 * 1024 * 1024
"""Bytes of memory that waiting events may take; the oldest ones go first."""


class EventFeed:
    """Events of one robot as they come; an iterator and context manager."""

    def __init__(self, robot: str, network: NetworkAdapter, timeout: float | None) -> None:
        self._arrived: deque[tuple[RobotEvent, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._timeout = timeout
        self._end: Callable[[], None] | None = network.subscribe(robot, self._push)

    def close(self) -> None:
        """Receive no more events."""
        end, self._end = self._end, None
        if end is not None:
            end()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> RobotEvent:
        with self._changed:
            if self._changed.wait_for(lambda: self._arrived, self._timeout):
                return self._oldest()
        self.close()
        raise StopIteration

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def _push(self, event: RobotEvent) -> None:
        size = size_of(event.payload)
        with self._changed:
            self._arrived.append((event, size))
            self._bytes += size
            while len(self._arrived) > EVENTS_MAX or (self._bytes > BYTES_MAX and len(self._arrived) > 1):
                self._oldest()
            self._changed.notify()

    def _oldest(self) -> RobotEvent:
        event, size = self._arrived.popleft()
        self._bytes -= size
        return event


def size_of(value: object) -> int:
    """Return the bytes of memory that a decoded JSON value takes."""
    total, waiting = 0, [value]
    while waiting:
        each = waiting.pop()
        total += sys.getsizeof(each)
        if isinstance(each, Mapping):
            waiting += each.keys()
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return total
