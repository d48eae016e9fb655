"""What a peer publishes of itself ten times a second: joints, task, simulated time; and what its presence says."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.contract import TaskRobot, WorldRobot
from strands_robots.mesh.dispatch import Robot
from strands_robots.utils import shown

TASK_FIELDS = {"status": "task_status", "instruction": "instruction", "steps": "step_count", "duration": "duration"}


@dataclass(slots=True)
class _Trouble:
    reason: str
    since: float
    failures: int = 0


class StateReader:
    """Reads a robot into state messages; a section that cannot be read is told as degraded, the others stay."""

    def __init__(self, peer_id: str, robot: Robot | None, clock: Callable[[], float] = time.time) -> None:
        self._peer_id = peer_id
        self._robot = robot
        self._clock = clock
        self._troubles: dict[str, _Trouble] = {}
        self._before: dict[str, tuple[float, float]] = {}

    def read(self) -> dict[str, Any] | None:
        """The message, or None when there is nothing to say."""
        body: dict[str, Any] = {}
        if isinstance(self._robot, WorldRobot):
            self._section(body, "joints", self._world)
        elif self._robot is not None:
            self._section(body, "joints", self._hardware)
        if self._troubles:
            now = time.monotonic()
            body["degraded"] = {
                name: {
                    "reason": trouble.reason,
                    "failures": trouble.failures,
                    "seconds": round(now - trouble.since, 3),
                }
                for name, trouble in self._troubles.items()
            }
        # Written last, so that nothing a robot says can pass for another peer.
        return {**body, "peer_id": self._peer_id, "t": self._clock()} if body else None

    def _section(self, body: dict[str, Any], name: str, read: Callable[[], Mapping[str, Any]]) -> None:
        try:
            body.update(read())
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is told, not hidden
            trouble = self._troubles.setdefault(name, _Trouble("", time.monotonic()))
            trouble.reason, trouble.failures = shown(f"{type(exc).__name__}: {exc}"), trouble.failures + 1
        else:
            self._troubles.pop(name, None)

    def _hardware(self) -> Mapping[str, Any]:
        robot = self._robot
        if not isinstance(robot, TaskRobot):
            return {}
        state = robot.get_state()
        joints = state.get("joints")
        found: dict[str, Any] = {}
        if isinstance(joints, Mapping) and joints:
            found["joints"] = {str(name): float(value) for name, value in joints.items()}
        task = task_of(robot.get_task_status())
        return {**found, **({"task": task} if task else {})}

    def _world(self) -> Mapping[str, Any]:
        robot = self._robot
        if not isinstance(robot, WorldRobot):
            return {}
        state = robot.get_state()
        running = {str(row.get("robot", "")): row for row in robot.list_policies_running()}
        names = robot.list_robots()
        joints: dict[str, Any] = {}
        at = state.get("sim_time")
        for name, values in dict(state.get("robots") or {}).items():
            inner = values.get("joints", values) if isinstance(values, Mapping) else {}
            for joint, value in inner.items():
                if isinstance(value, Mapping):
                    entry = {"position": value.get("position"), "velocity": value.get("velocity")}
                elif isinstance(value, int | float):
                    entry = {"position": float(value), "velocity": self._speed(f"{name}/{joint}", float(value), at)}
                else:
                    continue
                joints[joint if len(names) == 1 else f"{name}/{joint}"] = entry
        found: dict[str, Any] = {"robots": {name: name in running for name in names}}
        if joints:
            found["joints"] = joints
        if isinstance(state.get("sim_time"), int | float):
            found["sim_time"] = float(state["sim_time"])
        if running:
            first = next(iter(running.values()))
            found["task"] = {
                "status": "running",
                "instruction": first.get("instruction", ""),
                "steps": first.get("step", 0),
                "duration": first.get("elapsed_s", 0.0),
            }
        return found

    def _speed(self, joint: str, position: float, at: object) -> float | None:
        """Velocity by simulated time between two messages; 0 while the world stands still, None for the first."""
        if not isinstance(at, int | float):
            return None
        known = self._before.get(joint)
        self._before[joint] = (float(at), position)
        if known is None:
            return None
        passed = float(at) - known[0]
        return (position - known[1]) / passed if passed > 0 else 0.0


def task_of(status: Mapping[str, Any]) -> dict[str, Any]:
    """The task section of a status envelope."""
    return {name: status[field] for name, field in TASK_FIELDS.items() if field in status}


def describe(robot: Robot | None) -> dict[str, Any]:
    """What presence says of a robot besides who it is."""
    if robot is None:
        return {}
    facts: dict[str, Any] = {"tool_name": robot.tool_name_str}
    if isinstance(robot, WorldRobot):
        running = robot.list_policies_running()
        facts.update(world=True, sim_robots=robot.list_robots(), task_status="running" if running else "idle")
        if running:
            facts["instruction"] = str(running[0].get("instruction", ""))
        return facts
    status = robot.get_task_status()
    facts["task_status"] = str(status.get("task_status", "idle"))
    if status.get("instruction"):
        facts["instruction"] = str(status["instruction"])
    body = getattr(robot, "wrapped", robot)
    connected = getattr(body, "is_connected", None)
    if isinstance(connected, bool):
        facts["connected"] = connected
    keys = robot.get_features().get("action_features")
    if isinstance(keys, Mapping):
        facts["action_keys"] = sorted(str(key) for key in keys)[:256]
    hardware = getattr(body, "hardware_name", None)
    if isinstance(hardware, str):
        facts["hw"] = hardware
    return facts
