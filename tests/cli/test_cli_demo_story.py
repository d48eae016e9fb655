"""The demo's steps, with an agent whose robot does what the test says: a step that did not happen must fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from strands_robots.cli.demo.agent import Event
from strands_robots.cli.demo.pictures import draw, evenly
from strands_robots.cli.demo.show import Show
from strands_robots.cli.demo.story import Report, Story
from strands_robots.cli.output import Failure, Screen


class Robot:
    """What the fake agent's robot does; a test spoils one thing."""

    def __init__(self) -> None:
        self.functions = ["execute", "stop", "getStatus", "getFeatures"]
        self.travel = 0.5
        self.drift = 0.0
        self.brake = 0.0
        self.end: dict[str, Any] | None = {"state": "completed", "steps": 200}
        self.verdict: dict[str, Any] = {"status": "success", "stopped": ["arm"]}
        self.refusal = ""
        self.discovered = True
        self.alive = True


class FakeAgent:
    endpoint = "tcp/127.0.0.1:1"

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.at = 0.0
        self.stopped = False
        self.asked = 0

    def discover(self, device_id: str) -> dict[str, Any]:
        if not self.robot.discovered:
            raise Failure("not discovered")
        return {"device_id": device_id, "functions": [{"name": name} for name in self.robot.functions]}

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        if function == "execute" and self.robot.refusal:
            raise Failure(self.robot.refusal)
        if function == "stop":
            self.stopped = True
            return self.robot.verdict
        if function == "getStatus":
            self.asked += 1
            return {"robots": {"arm": {"pan": 1.0 + (self.robot.brake if self.asked > 1 else 0.0)}}}
        return {"robots": {"arm": {"joints": {"pan": [-2, 2]}}}}

    @contextmanager
    def events(self, device_id: str) -> Iterator[FakeAgent]:
        yield self

    def read(self) -> list[Event]:
        return []

    def follow(self, seconds: float) -> Iterator[Event]:
        reach = self.robot.drift if self.stopped else self.robot.travel
        start = 1.0 + self.robot.brake if self.stopped else 0.0
        for part in range(5):
            self.at += 0.1
            yield Event("observationUpdate", {"joints": {"pan": start + reach * part / 4}}, self.at)
        if self.robot.end is not None:
            yield Event("policyComplete", self.robot.end, self.at)


class FakeChild:
    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def check(self) -> None:
        if not self.robot.alive:
            raise Failure("The robot's process ended with exit code -9.")


def tell(robot: Robot) -> Report:
    story = Story(Show(Screen(machine=True)), FakeAgent(robot), FakeChild(robot), "arm-1", Report())  # type: ignore[arg-type]
    for step in (story.discover, story.drive, story.stop):
        step()
    return story.report


def test_a_robot_that_does_everything_passes() -> None:
    report = tell(Robot())
    assert [(step["step"], step["ok"]) for step in report.steps] == [
        ("discover", True),
        ("execute", True),
        ("stop", True),
    ]
    assert report.stop_ms >= 0
    assert report.path


SPOILED: dict[str, tuple[Callable[[Robot], None], str]] = {
    "discovery": (lambda robot: setattr(robot, "discovered", False), "not discovered"),
    "a function": (lambda robot: robot.functions.remove("stop"), "without stop"),
    "leave": (lambda robot: setattr(robot, "refusal", "execute was refused"), "refused"),
    "motion": (lambda robot: setattr(robot, "travel", 0.0), "did not move"),
    "its end": (lambda robot: setattr(robot, "end", None), "did not report its end"),
    "completion": (lambda robot: setattr(robot, "end", {"state": "error", "error": "boom"}), "error: boom"),
    "the verdict": (lambda robot: setattr(robot, "verdict", {"status": "success", "stopped": []}), "nothing says"),
    "all of the verdict": (
        lambda robot: setattr(robot, "verdict", {"status": "success", "stopped": ["a"], "not_stopped": ["b"]}),
        "nothing says",
    ),
    "stillness": (lambda robot: setattr(robot, "drift", 0.2), "moved on after its stop"),
    "braking": (lambda robot: setattr(robot, "brake", 0.2), "went on after its stop"),
    "life": (lambda robot: setattr(robot, "alive", False), "exit code -9"),
}


@pytest.mark.parametrize("missing", SPOILED)
def test_a_step_that_did_not_happen_fails_the_demo(missing: str) -> None:
    spoil, said = SPOILED[missing]
    robot = Robot()
    spoil(robot)
    with pytest.raises(Failure, match=said):
        tell(robot)


def test_poses_are_taken_at_an_even_rate_and_pauses_are_left_out() -> None:
    path = [(at / 100, {"pan": at / 100}) for at in [*range(100), *range(1000, 1100)]]
    seen = evenly(path, 10.0, 64)
    assert len(seen) == 20
    assert seen[10]["pan"] == 10.0
    assert len(evenly(path, 100.0, 64)) == 64
    assert evenly([], 10.0, 64) == []


def test_the_recording_is_a_picture_of_what_was_said(tmp_path: Path) -> None:
    show = Show(Screen(machine=True), record=True)
    show.done("the arm waved")
    with show.live() as frame:
        frame("first")
        frame("last")
    show.save(tmp_path / "demo.svg")
    text = (tmp_path / "demo.svg").read_text(encoding="utf-8").replace("&#160;", " ")
    assert text.startswith("<svg")
    assert "the arm waved" in text
    assert "last" in text
    assert "first" not in text


def test_pictures_that_cannot_be_written_fail_the_demo(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    path = [(at / 10, {"shoulder_pan": at / 10}) for at in range(3)]
    with pytest.raises(Failure, match="could not be written"):
        draw("so100", path, tmp_path / "taken" / "folder")


def test_a_motion_that_nobody_saw_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(Failure, match="too little"):
        draw("so100", [(0.0, {"shoulder_pan": 0.0})], tmp_path)
