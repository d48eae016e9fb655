from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.cli.watch import View, in_lines, task_of, until
from strands_robots.device_connect.client import DeviceEvent


def event(name: str, **payload: Any) -> DeviceEvent:
    return DeviceEvent("arm-1", name, payload)


@pytest.mark.parametrize(
    ("seen", "told"),
    [
        (event("stateUpdate", running_policies={}), "idle"),
        (event("stateUpdate", running_policies={"arm": {"instruction": "wave", "step": 7}}), "arm does 'wave', step 7"),
        (event("stateUpdate", task_status="running", instruction="wave", step_count=3), "running: 'wave', step 3"),
        (event("policyComplete", instruction="wave", steps=9, state="stopped"), "stopped: 'wave' after 9 steps"),
        (event("taskStarted", instruction="wave", policy_provider="mock"), "started 'wave' with mock"),
        (event("emergencyStop", reason="smoke"), "EMERGENCY STOP: smoke"),
        (event("stateUpdate", running_policies="nonsense"), ""),
        (event("observationUpdate", joints={}), ""),
    ],
)
def test_an_event_says_what_the_device_does(seen: DeviceEvent, told: str) -> None:
    assert task_of(seen) == told


def test_the_view_keeps_the_last_joints_and_task() -> None:
    view = View("arm-1", {"pan": (-1.0, 1.0)})
    view.take(event("stateUpdate", running_policies={"arm": {"instruction": "wave"}}))
    view.take(event("observationUpdate", robot_name="arm", joints={"pan": 0.25}))
    view.take(event("observationUpdate", robot_name="arm", joints="nonsense"))
    sink = io.StringIO()
    Console(file=sink, width=100).print(view.draw())
    assert "+0.250" in sink.getvalue()
    assert "wave" in sink.getvalue()


def test_without_a_terminal_each_change_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    idle = event("stateUpdate", running_policies={})
    in_lines(Screen(), iter([idle, idle, event("policyStarted", instruction="a", policy_provider="mock"), idle]))
    assert capsys.readouterr().out.splitlines() == ["arm-1: idle", "arm-1: started 'a' with mock", "arm-1: idle"]


def test_a_device_that_falls_silent_is_exit_3() -> None:
    with pytest.raises(Failure) as failure:
        list(until(iter([event("stateUpdate")]), None, "arm-1"))
    assert failure.value.code is Exit.SILENT


def test_watching_ends_after_its_time() -> None:
    endless = iter(lambda: event("stateUpdate"), None)
    assert list(until(endless, 0.001, "arm-1"))
