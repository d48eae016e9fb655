"""What a peer's presence says of its robot; a field that cannot be read is left out, the others stay."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.contract import TaskRobot, WorldRobot, body_of
from strands_robots.envelope import is_error, text_of
from strands_robots.mesh.dispatch import Robot

logger = logging.getLogger(__name__)

KEYS_MAX = 256
PICTURE_AXES = 3

Facts = Mapping[str, Any]


class Description:
    """Reads one robot for its presence, each field for itself; a field that cannot be read is told once a reason."""

    def __init__(self, peer_id: str, robot: Robot | None) -> None:
        self._peer_id = peer_id
        self._robot = robot
        self._troubles: dict[str, str] = {}

    def read(self) -> dict[str, Any]:
        """The fields that are known now."""
        robot = self._robot
        if robot is None:
            return {}
        facts: dict[str, Any] = {"tool_name": robot.tool_name_str}
        if isinstance(robot, WorldRobot):
            facts["world"] = True
            facts.update(self._part("sim_robots", lambda: {"sim_robots": robot.list_robots()}))
            facts.update(self._part("task_status", lambda: _world_task(robot)))
            facts.update(self._part("features", lambda: _world_features(_told(robot.get_features()))))
            return facts
        body = body_of(robot)
        facts.update(self._part("task_status", lambda: _task(robot)))
        facts.update(self._part("features", lambda: _features(_told(robot.get_features()))))
        facts.update(self._part("connected", lambda: _typed(body, "connected", "is_connected", bool)))
        facts.update(self._part("hw", lambda: _typed(body, "hw", "hardware_name", str)))
        return facts

    def _part(self, name: str, read: Callable[[], Facts]) -> Facts:
        try:
            found, trouble = read(), ""
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises costs this field alone
            found, trouble = {}, f"{type(exc).__name__}: {exc}"
        if trouble and trouble != self._troubles.get(name):
            logger.warning("%s is announced without its %s: %s", self._peer_id, name, trouble)
        self._troubles[name] = trouble
        return found


def _told(answer: Facts) -> Facts:
    if is_error(answer):
        raise RuntimeError(text_of(dict(answer)))
    return answer


def _task(robot: TaskRobot) -> Facts:
    status = _told(robot.get_task_status())
    facts = {"task_status": str(status.get("task_status", "idle"))}
    if status.get("instruction"):
        facts["instruction"] = str(status["instruction"])
    return facts


def _world_task(robot: WorldRobot) -> Facts:
    running = robot.list_policies_running()
    if not running:
        return {"task_status": "idle"}
    return {"task_status": "running", "instruction": str(running[0].get("instruction", ""))}


def _features(features: Facts) -> Facts:
    facts: dict[str, Any] = {}
    keys, seen = features.get("action_features"), features.get("observation_features")
    if isinstance(keys, Mapping):
        facts["action_keys"] = sorted(str(key) for key in keys)[:KEYS_MAX]
    if isinstance(seen, Mapping):
        cameras = [
            str(key) for key, kind in seen.items() if isinstance(kind, list | tuple) and len(kind) == PICTURE_AXES
        ]
        if cameras:
            facts["cameras"] = cameras[:KEYS_MAX]
    return facts


def _world_features(features: Facts) -> Facts:
    facts: dict[str, Any] = {}
    robots, cameras = features.get("robots"), features.get("cameras")
    if isinstance(robots, Mapping) and robots:
        facts["action_keys"] = sorted(
            str(key) if len(robots) == 1 else f"{name}/{key}"
            for name, each in robots.items()
            for key in each.get("action_features", ())
        )[:KEYS_MAX]
    if cameras:
        # The wire's camera names hold no slash.
        facts["cameras"] = [str(name).replace("/", ".") for name in cameras][:KEYS_MAX]
    return facts


def _typed(body: Any, field: str, name: str, kind: type) -> Facts:
    value = getattr(body, name, None)
    return {field: value} if isinstance(value, kind) and value != "" else {}
