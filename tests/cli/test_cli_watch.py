from __future__ import annotations

import io
import json
import math
from typing import Any

import pytest
from rich.console import Console
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.cli import watch
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.cli.watch import (
    BAR_WIDTH,
    DeviceView,
    SignsOfLife,
    describe_task,
    follow,
    joint_bar,
    joint_limits,
    joints_table,
    print_changes,
)
from strands_robots.device_connect.client import DeviceEvent
from strands_robots.envelope import error, success
from strands_robots.fleet.adapter import RobotEvent
from strands_robots.fleet.device_connect.network import robot_event
from strands_robots.fleet.networks import Networks


def drawn(thing: object) -> str:
    sink = io.StringIO()
    Console(file=sink, width=120).print(thing)
    return sink.getvalue()


def event(name: str, **payload: Any) -> RobotEvent:
    return robot_event(DeviceEvent("arm-1", name, payload))


@pytest.mark.parametrize(
    ("seen", "task"),
    [
        (event("stateUpdate", running_policies={}), "idle"),
        (event("stateUpdate", running_policies={"arm": {"instruction": "wave", "step": 7}}), "arm does 'wave', step 7"),
        (event("stateUpdate", task_status="running", instruction="wave", step_count=3), "running: 'wave', step 3"),
        (event("policyComplete", instruction="wave", steps=9, state="stopped"), "stopped: 'wave' after 9 steps"),
        (event("taskStarted", instruction="wave", policy_provider="mock"), "started 'wave' with mock"),
        (event("emergencyStop", reason="smoke"), "EMERGENCY STOP: smoke"),
        (event("stateUpdate", running_policies="nonsense"), ""),
        (event("observationUpdate", joints={}), ""),
        (
            RobotEvent("arm-1", "state", {}, task={"state": "running", "instruction": "wave", "step": 3}),
            "running: 'wave', step 3",
        ),
        (RobotEvent("arm-1", "state", {}, task={"state": "idle"}), "idle"),
        (RobotEvent("arm-1", "safety_event", {"event": "emergency_stop"}), "EMERGENCY STOP"),
        (RobotEvent("arm-1", "stream", {"step": 3}), ""),
    ],
)
def test_event_is_described_as_the_device_task(seen: RobotEvent, task: str) -> None:
    assert describe_task(seen) == task


def test_the_view_keeps_the_last_joints_and_task() -> None:
    view = DeviceView("arm-1", {"pan": (-1.0, 1.0)})
    view.take(event("stateUpdate", running_policies={"arm": {"instruction": "wave"}}))
    view.take(event("observationUpdate", robot_name="arm", joints={"pan": 0.25}))
    view.take(event("observationUpdate", robot_name="arm", joints="nonsense"))
    text = drawn(view.draw())
    assert "+0.250" in text
    assert "wave" in text


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> ScriptedNetwork:
    there = ScriptedNetwork()
    monkeypatch.setattr(Network, "networks", lambda *_, **__: Networks([there]))
    return there


def test_watched_device_is_asked_and_followed_by_one_adapter(
    there: ScriptedNetwork, capsys: pytest.CaptureFixture[str]
) -> None:
    there.answers["getStatus"] = lambda _: success("", task_status="running", instruction="wave")
    watch.watch(Screen(), Network(), "arm-1", 0.01)
    assert capsys.readouterr().out.startswith("arm-1: running: 'wave', step 0.")
    assert [verb for _, verb, _, _ in there.calls] == ["getFeatures", "getState", "getStatus"]
    assert there.subscribers == []


def test_read_that_fails_inside_the_robot_is_no_state(
    there: ScriptedNetwork, capsys: pytest.CaptureFixture[str]
) -> None:
    there.robots["arm-1"] = "no list"
    there.answers["getState"] = lambda _: error("no bus", joints={"pan": 1.0})
    there.answers["getStatus"] = lambda _: success("", task_status="idle")
    watch.watch(Screen(machine=True), Network(), "arm-1", 0.01)
    assert [json.loads(line)["event"] for line in capsys.readouterr().out.splitlines()] == ["getStatus"]


def test_device_that_is_not_there_is_exit_3(there: ScriptedNetwork) -> None:
    with pytest.raises(CliError, match="Near it: arm-1") as failure:
        watch.watch(Screen(), Network(), "arm-2", 0.01)
    assert failure.value.code is Exit.SILENT


def test_each_change_is_one_line_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    idle = event("stateUpdate", running_policies={})
    print_changes(
        Screen(),
        "arm-1",
        "idle",
        iter([idle, idle, event("policyStarted", instruction="a", policy_provider="mock"), idle]),
    )
    assert capsys.readouterr().out.splitlines() == ["arm-1: idle", "arm-1: started 'a' with mock", "arm-1: idle"]


class Clock:
    """Time that passes while the watcher sleeps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(watch.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(watch.time, "sleep", self.passes)

    def passes(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.mark.parametrize(
    ("name", "beats", "every", "after"),
    [("", True, 1.0, 3.0), ("stateUpdate", False, 1.0, 3.0), ("tick", False, 5.0, 15.0), ("", False, 5.0, 6.0)],
)
def test_device_that_misses_three_beats_is_silent_and_exit_3(
    clock: Clock, name: str, beats: bool, every: float, after: float
) -> None:
    signs = SignsOfLife(lambda: 100.0 if beats else None, lambda: every)
    if name:
        signs.take(event(name))
    ages = []
    with pytest.raises(CliError, match="arm-1 is silent") as failure:
        for _, age in follow(signs, None, "arm-1"):
            ages.append(age)
    assert failure.value.code is Exit.SILENT
    assert ages[-1] == pytest.approx(after, abs=0.2)
    assert clock.now == pytest.approx(100 + after, abs=0.2)


def test_view_starts_with_the_task_of_the_status() -> None:
    view = DeviceView("arm-1", {})
    view.take_state({"task_status": "running", "instruction": "wave", "step_count": 3})
    assert view.task == "running: 'wave', step 3"
    view.take_state({"joints": {"pan": 0.5}})
    assert view.task == "running: 'wave', step 3"


def test_everything_that_has_arrived_is_in_the_next_redraw(clock: Clock) -> None:
    signs = SignsOfLife()
    for _ in range(5000):
        signs.take(event("streamStep"))
    frames = follow(signs, 10.0, "arm-1")
    assert len(next(frames)[0]) == 5000
    assert next(frames)[0] == []


def test_watching_ends_after_its_time(clock: Clock) -> None:
    assert list(follow(SignsOfLife(), 0.5, "arm-1"))
    assert clock.now == pytest.approx(100.5, abs=0.1)


def test_screen_says_when_the_device_was_last_heard() -> None:
    assert "last heard 2.5 s ago" in drawn(DeviceView("arm-1", {}).draw(2.5))


def test_bar_mark_stays_between_the_limits() -> None:
    assert joint_bar(-1.0, (-1.0, 1.0)).plain.index("●") == 0
    assert joint_bar(1.0, (-1.0, 1.0)).plain.index("●") == BAR_WIDTH - 1
    assert joint_bar(99.0, (-1.0, 1.0)).plain.index("●") == BAR_WIDTH - 1
    assert len(joint_bar(0.0, (-1.0, 1.0)).plain) == BAR_WIDTH


def test_joints_without_a_finite_number_are_left_out() -> None:
    text = drawn(joints_table({"pan": 0.5, "lift": math.nan, "name": "x", "flag": True}, {}))
    assert "+0.500" in text
    assert "lift" not in text and "name" not in text and "flag" not in text


def test_hostile_joint_name_is_printed_as_text() -> None:
    assert "[red]" in drawn(joints_table({"[red]\x1b[2J": 1.0}, {}))
    assert "\x1b[2J" not in drawn(joints_table({"[red]\x1b[2J": 1.0}, {}))


def test_joints_beyond_the_maximum_are_counted() -> None:
    assert "and 976 more" in drawn(joints_table({f"j{i}": 0.0 for i in range(1000)}, {}))


def test_joint_limits_are_read_from_simulation_and_robot() -> None:
    one = {"joints": {"pan": [-1, 1], "lift": None, "odd": [2, 1], "text": ["a", "b"]}}
    assert joint_limits(one) == {"pan": (-1.0, 1.0)}
    assert joint_limits({"robots": {"arm": one, "other": {}}}) == {"pan": (-1.0, 1.0)}
    assert joint_limits({"robots": "nonsense"}) == {}


def test_device_without_joints_says_so() -> None:
    view = DeviceView("rover", {})
    assert "reports no joints" in drawn(view.draw())
    assert "reports no joints" in view.summary
    view.take(event("observationUpdate", joints={"pan": 0.5}))
    assert "reports no joints" not in drawn(view.draw())
    assert view.summary == "idle"


def test_unavailable_device_says_why_it_has_no_joints() -> None:
    view = DeviceView("head", {})
    view.take_state({"task_status": "idle", "instruction": "", "unavailable": "no daemon at 10.0.0.7"})
    assert view.summary == "unavailable. no daemon at 10.0.0.7"
    assert "no daemon at 10.0.0.7" in drawn(view.draw())
