"""Task of a robot, in the same shape from its status, its state and its presence."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.fleet.robot_task import TASK_MAX, task_of

RUNNING = {"left": {"policy": "mock", "instruction": "wave", "step": 7}, "right": {"policy": "act"}}


@pytest.mark.parametrize(
    ("facts", "task"),
    [
        ({}, {"state": "idle", "instruction": ""}),
        ({"task_status": "RUNNING", "instruction": "wave"}, {"state": "running", "instruction": "wave"}),
        ({"task_status": "running", "step_count": 3}, {"state": "running", "instruction": "", "step": 3}),
        ({"running_policies": {}, "task_status": "running"}, {"state": "idle"}),
        (
            {"running_policies": RUNNING},
            {"state": "running", "instruction": "wave", "policy": "mock", "step": 7, "who": "left"},
        ),
        ({"running_policies": {"left": "nonsense"}}, {"state": "idle"}),
        ({"running_policies": "nonsense", "task_status": ["x"]}, {"state": "idle", "instruction": ""}),
    ],
)
def test_task_is_read_from_every_report(facts: dict[str, Any], task: dict[str, Any]) -> None:
    assert task_of(facts) == task


def test_text_of_a_task_is_bounded() -> None:
    assert len(task_of({"instruction": "x" * 10_000_000})["instruction"]) == TASK_MAX
