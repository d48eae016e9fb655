"""Events of Device Connect in the shape of the calling side."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING

from strands_robots.fleet.adapter import RobotEvent
from strands_robots.fleet.robot_task import task_of
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.device_connect.client import DeviceEvent

STATE, OBSERVATION, STEP = "stateUpdate", "observationUpdate", "streamStep"
FREQUENT = frozenset({STATE, OBSERVATION, STEP})
JOINTS = {OBSERVATION: "joints", STEP: "observation"}
"""Fields with the joints, by event."""

NAME_MAX = 100


def robot_event(event: DeviceEvent) -> RobotEvent:
    """Return a device's event with what it says of its joints and its task."""
    facts, part = event.payload, event.payload.get("robot_name")
    joints = facts.get(JOINTS.get(event.name, ""))
    return RobotEvent(
        event.device,
        _plain(event.name[: 2 * NAME_MAX]),
        facts,
        joints=joints if isinstance(joints, Mapping) else None,
        part=part if isinstance(part, str) else "",
        task=task_of(facts) if event.name == STATE else None,
        frequent=event.name in FREQUENT,
    )


@lru_cache(64)
def _plain(name: str) -> str:
    return plain_text(name, NAME_MAX)
