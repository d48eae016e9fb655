"""What a peer publishes of itself ten times a second: joints, task, simulated time, its robots."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.contract import TaskRobot, WorldRobot
from strands_robots.envelope import is_error, text_of
from strands_robots.mesh.dispatch import Robot

TASK_FIELDS = {"status": "task_status", "instruction": "instruction", "steps": "step_count", "duration": "duration"}

DETAIL_MAX = 160
STALE_S = 1.0
"""Age in seconds from which joints of an earlier read are published no more."""


class UnreadableError(Exception):
    """A section that cannot be read, or only in part; ``found`` is the part."""

    def __init__(self, reason: str, detail: str, found: Mapping[str, Any] | None = None) -> None:
        super().__init__(detail)
        self.reason = reason
        self.found = found or {}


@dataclass(slots=True)
class _Trouble:
    reason: str
    detail: str
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
        for name, read in self._sections().items():
            self._section(body, name, read)
        if self._troubles:
            now = time.monotonic()
            body["degraded"] = {
                name: {
                    "reason": trouble.reason,
                    "detail": trouble.detail,
                    "failures": trouble.failures,
                    "seconds": round(now - trouble.since, 3),
                }
                for name, trouble in self._troubles.items()
            }
        # Written last, so that nothing a robot says can pass for another peer.
        return {**body, "peer_id": self._peer_id, "t": self._clock()} if body else None

    def _sections(self) -> dict[str, Callable[[], Any]]:
        robot = self._robot
        if isinstance(robot, WorldRobot):
            state, running, names = _Once(robot.get_state), _Once(robot.list_policies_running), _Once(robot.list_robots)
            return {
                "joints": lambda: self._world_joints(_told(state()), names()),
                "sim_time": lambda: _sim_time(_told(state())),
                "robots": lambda: _active(names(), running()),
                "task": lambda: _world_task(running()),
            }
        if isinstance(robot, TaskRobot):
            return {
                "joints": lambda: _joints(_told(robot.get_state())),
                "task": lambda: task_of(_told(robot.get_task_status())),
            }
        return {}

    def _section(self, body: dict[str, Any], name: str, read: Callable[[], Any]) -> None:
        try:
            found, reason, detail = read(), "", ""
        except UnreadableError as exc:
            found, reason, detail = exc.found, exc.reason, str(exc)
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is told, not hidden
            found, reason, detail = None, type(exc).__name__, str(exc)
        if reason:
            trouble = self._troubles.setdefault(name, _Trouble("", "", time.monotonic()))
            trouble.reason, trouble.detail = reason, _bounded(detail)
            trouble.failures += 1
        else:
            self._troubles.pop(name, None)
        if found is not None and found != {}:
            body[name] = found

    def _world_joints(self, state: Mapping[str, Any], names: list[str]) -> dict[str, Any]:
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
        bad = [name for name, entry in joints.items() if not all(_sound(entry[part]) for part in entry)]
        return _good(joints, bad)

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


class _Once:
    """One read of a robot that several sections of a message share."""

    def __init__(self, read: Callable[[], Any]) -> None:
        self._read = read
        self._answer: Any = None
        self._raised: Exception | None = None
        self._asked = False

    def __call__(self) -> Any:
        if not self._asked:
            self._asked = True
            try:
                self._answer = self._read()
            except Exception as exc:  # noqa: BLE001 - raised again, for each section that needs it
                self._raised = exc
        if self._raised is not None:
            raise self._raised
        return self._answer


def task_of(status: Mapping[str, Any]) -> dict[str, Any]:
    """The task section of a status envelope."""
    return {name: status[field] for name, field in TASK_FIELDS.items() if field in status}


def _told(answer: Mapping[str, Any]) -> Mapping[str, Any]:
    if not isinstance(answer, Mapping):
        raise UnreadableError("malformed", f"the robot answered with a {type(answer).__name__}")
    if is_error(answer):
        raise UnreadableError("refused", text_of(dict(answer)))
    return answer


def _joints(state: Mapping[str, Any]) -> dict[str, float]:
    joints = state.get("joints")
    found: dict[str, float] = {}
    bad: list[str] = []
    for name, value in (joints if isinstance(joints, Mapping) else {}).items():
        if _sound(value) and value is not None:
            found[str(name)] = float(value)
        else:
            bad.append(str(name))
    problem, age = state.get("joints_error"), state.get("joints_age_s")
    if problem:
        fresh = isinstance(age, int | float) and age <= STALE_S
        raise UnreadableError("stale", str(problem), found if fresh else None)
    return _good(found, bad)


def _good(joints: dict[str, Any], bad: list[str]) -> dict[str, Any]:
    if bad:
        good = {name: entry for name, entry in joints.items() if name not in bad}
        raise UnreadableError("not a number", ", ".join(bad), good)
    return joints


def _sim_time(state: Mapping[str, Any]) -> float | None:
    at = state.get("sim_time")
    return float(at) if isinstance(at, int | float) else None


def _active(names: list[str], running: list[dict[str, Any]]) -> dict[str, bool]:
    moving = {str(row.get("robot", "")) for row in running}
    return {name: name in moving for name in names}


def _world_task(running: list[dict[str, Any]]) -> dict[str, Any]:
    if not running:
        return {}
    first = running[0]
    return {
        "status": "running",
        "instruction": first.get("instruction", ""),
        "steps": first.get("step", 0),
        "duration": first.get("elapsed_s", 0.0),
    }


def _sound(value: object) -> bool:
    if value is None:
        return True
    try:
        return not isinstance(value, bool | str | bytes) and math.isfinite(value)  # type: ignore[arg-type]
    except TypeError:
        return False


def _bounded(text: str) -> str:
    return text if len(text) <= DETAIL_MAX else f"{text[:DETAIL_MAX]}..."
