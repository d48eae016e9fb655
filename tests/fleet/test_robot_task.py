"""Task of a robot, in the same shape from its status, its state and its presence."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.fleet.reports import TASK_MAX, task_of

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


@pytest.mark.parametrize("step", ["7", True, 7.5, [7], {"html": "x"}, None])
def test_step_that_is_no_integer_is_left_out(step: object) -> None:
    assert "step" not in task_of({"task_status": "running", "step_count": step})
    assert "step" not in task_of({"running_policies": {"left": {"step": step}}})


def test_texts_of_a_task_are_plain() -> None:
    said = "wave\x1b[2J\n\u202etwice"
    world = task_of({"running_policies": {said: {"policy": said, "instruction": said}}})
    arm = task_of({"task_status": said, "instruction": said})
    assert {*world.values(), *arm.values()} == {"running", "wave twice"}


def test_text_of_a_task_is_bounded() -> None:
    assert len(task_of({"instruction": "x" * 10_000_000})["instruction"]) == TASK_MAX
