"""Events of Device Connect, read for the calling side."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.device_connect.client import DeviceEvent
from strands_robots.fleet.adapter import RobotEvent
from strands_robots.fleet.device_connect.network import robot_event

JOINTS = {"pan": 0.5}


def read(name: str, **payload: Any) -> RobotEvent:
    return robot_event(DeviceEvent("arm-1", name, payload))


@pytest.mark.parametrize(("name", "field"), [("observationUpdate", "joints"), ("streamStep", "observation")])
def test_joints_are_read_with_the_robot_of_the_world_that_they_belong_to(name: str, field: str) -> None:
    event = read(name, robot_name="left", **{field: JOINTS})
    assert (event.robot, event.joints, event.part, event.task, event.frequent) == ("arm-1", JOINTS, "left", None, True)


def test_state_is_read_as_a_task() -> None:
    event = read("stateUpdate", task_status="running", instruction="wave", step_count=3)
    assert event.task == {"state": "running", "instruction": "wave", "step": 3}
    assert event.frequent


def test_other_event_is_for_the_timeline() -> None:
    event = read("taskComplete", task_status="running")
    assert (event.name, event.task, event.frequent, event.alive) == ("taskComplete", None, False, True)


def test_hostile_fields_and_names_are_left_out_or_made_plain() -> None:
    event = read("\x1b[2Jboo" + "x" * 1000, joints="nonsense", observation=[1], robot_name={"a": 1})
    assert (event.joints, event.part) == (None, "")
    assert "\x1b" not in event.name
    assert len(event.name) <= 100
