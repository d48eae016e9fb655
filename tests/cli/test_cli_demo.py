"""Steps of the demo with stand-ins for robot, agent and controller: a step that did not happen must fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from strands_robots.audit import flush_audit, log_safety_event
from strands_robots.cli.demo.output import DemoScreen, draw_path, sample_poses
from strands_robots.cli.demo.processes import AgentEvent
from strands_robots.cli.demo.steps import DemoReport, DriveSteps, SafetySteps
from strands_robots.cli.output import CliError, Screen
from strands_robots.safety.answers import Answer
from strands_robots.safety.controller import StopReport

EPOCH = "0123456789abcdef0123456789abcdef"


class Robot:
    """Behaviour of the fake agent's robot; a test changes one thing."""

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
        self.status_calls = 0

    def discover(self, device_id: str) -> dict[str, Any]:
        if not self.robot.discovered:
            raise CliError("not discovered")
        return {"device_id": device_id, "functions": [{"name": name} for name in self.robot.functions]}

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        if function == "execute" and self.robot.refusal:
            raise CliError(self.robot.refusal)
        if function == "stop":
            self.stopped = True
            return self.robot.verdict
        if function == "getStatus":
            self.status_calls += 1
            return {"robots": {"arm": {"pan": 1.0 + (self.robot.brake if self.status_calls > 1 else 0.0)}}}
        return {"robots": {"arm": {"joints": {"pan": [-2, 2]}}}}

    @contextmanager
    def events(self, device_id: str) -> Iterator[FakeAgent]:
        yield self

    def read(self) -> list[AgentEvent]:
        return []

    def follow(self, seconds: float) -> Iterator[AgentEvent]:
        reach = self.robot.drift if self.stopped else self.robot.travel
        start = 1.0 + self.robot.brake if self.stopped else 0.0
        for part in range(5):
            self.at += 0.1
            yield AgentEvent("observationUpdate", {"joints": {"pan": start + reach * part / 4}}, self.at)
        if self.robot.end is not None:
            yield AgentEvent("policyComplete", self.robot.end, self.at)


class FakeProcess:
    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def check(self) -> None:
        if not self.robot.alive:
            raise CliError("The robot's process ended with exit code -9.")


def drive(robot: Robot) -> DemoReport:
    agent: Any = FakeAgent(robot)
    process: Any = FakeProcess(robot)
    steps = DriveSteps(DemoScreen(Screen(machine=True)), agent, process, "arm-1", DemoReport())
    for step in (steps.discover, steps.drive, steps.stop):
        step()
    return steps.report


def test_drive_steps_pass_with_a_working_robot() -> None:
    report = drive(Robot())
    assert [(step["step"], step["ok"]) for step in report.steps] == [
        ("discover", True),
        ("execute", True),
        ("stop", True),
    ]
    assert report.stop_ms >= 0
    assert report.path


DRIVE_FAULTS: dict[str, tuple[Callable[[Robot], None], str]] = {
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


@pytest.mark.parametrize("missing", DRIVE_FAULTS)
def test_drive_step_that_did_not_happen_fails_the_demo(missing: str) -> None:
    inject, message = DRIVE_FAULTS[missing]
    robot = Robot()
    inject(robot)
    with pytest.raises(CliError, match=message):
        drive(robot)


class Scene:
    """A robot and a controller that work; a test breaks one thing."""

    def __init__(self) -> None:
        answer = Answer("arm-1", True, 3.0, "")
        self.stop_report = StopReport(EPOCH, {"arm-1": answer}, {}, {}, (), True, 3.0)
        self.refusal: dict[str, Any] = {"status": "error", "reason": f"locked by demo-safety, epoch {EPOCH}"}
        self.resumed: dict[str, Any] = {"locked": False, "epochs": []}
        self.status: dict[str, Any] = {"locked": False, "running_policies": {}}
        self.runs = True
        self.records = 2
        self.assertions: list[Any] = []
        self.report = DemoReport()

    def stop(self, expected: list[str], reason: str, *, deadline_s: float) -> StopReport:
        return self.stop_report

    def ask(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        return self.refusal

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        if function == "resume":
            self.assertions.append(params["assertion"])
            return self.resumed
        return self.status

    @contextmanager
    def events(self, device_id: str) -> Iterator[None]:
        yield None

    def start_motion(self, stream: None, title: str, seconds: float) -> None:
        pass

    def measure_rest(self, stream: None) -> tuple[float, float]:
        return 0.01, 0.0

    def run_motion(self, stream: None, title: str, seconds: float) -> tuple[int, float]:
        if not self.runs:
            raise CliError("The motion did not report its end.")
        return 100, 1.0


def run_safety_steps(scene: Scene) -> None:
    for number in range(scene.records):
        log_safety_event("emergency_stop", "arm-1", {"number": number})
    assert flush_audit(20)
    fake: Any = scene
    key = Ed25519PrivateKey.generate()
    steps = SafetySteps(DemoScreen(Screen(machine=True)), fake, fake, peer_id="arm-1", controller=fake, key=key)
    for step in steps.steps:
        step()


def test_safety_steps_pass_with_a_working_robot() -> None:
    scene = Scene()
    run_safety_steps(scene)
    assert [(step["step"], step["ok"]) for step in scene.report.steps] == [
        ("emergency stop", True),
        ("refusal", True),
        ("resume", True),
        ("execute again", True),
    ]
    assert [(each["epoch"], each["targets"]) for each in scene.assertions] == [(EPOCH, ["arm-1"])]


SAFETY_FAULTS: dict[str, tuple[Callable[[Scene], None], str]] = {
    "an answer": (
        lambda scene: setattr(scene, "stop_report", StopReport(EPOCH, {}, {}, {}, ("arm-1",), True, 3000.0)),
        "did not answer the emergency stop",
    ),
    "a refusal": (lambda scene: setattr(scene, "refusal", {"status": "success"}), "did not refuse a motion"),
    "its stop's name": (
        lambda scene: setattr(scene, "refusal", {"status": "error", "reason": "busy"}),
        "did not refuse a motion",
    ),
    "who stopped": (
        lambda scene: setattr(scene, "refusal", {"status": "error", "reason": EPOCH}),
        "does not say who",
    ),
    "a resume": (lambda scene: scene.resumed.update(locked=True), "still locked"),
    "freedom": (lambda scene: scene.status.update(locked=True), "still locked"),
    "stillness": (lambda scene: scene.status.update(running_policies={"so100": {}}), "started a motion"),
    "a motion": (lambda scene: setattr(scene, "runs", False), "did not report its end"),
    "a record": (lambda scene: setattr(scene, "records", 0), "does not record what happened"),
}


@pytest.mark.parametrize("missing", SAFETY_FAULTS)
def test_safety_step_that_did_not_happen_fails_the_demo(missing: str) -> None:
    inject, message = SAFETY_FAULTS[missing]
    scene = Scene()
    inject(scene)
    with pytest.raises(CliError, match=message):
        run_safety_steps(scene)


def test_poses_are_sampled_evenly_without_pauses() -> None:
    path = [(at / 100, {"pan": at / 100}) for at in [*range(100), *range(1000, 1100)]]
    seen = sample_poses(path, 10.0, 64)
    assert len(seen) == 20
    assert seen[10]["pan"] == 10.0
    assert len(sample_poses(path, 100.0, 64)) == 64
    assert sample_poses([], 10.0, 64) == []


def test_recording_shows_the_last_state_of_each_frame(tmp_path: Path) -> None:
    screen = DemoScreen(Screen(machine=True), record=True)
    screen.done("the arm waved")
    with screen.live() as frame:
        frame("first")
        frame("last")
    screen.save(tmp_path / "demo.svg")
    text = (tmp_path / "demo.svg").read_text(encoding="utf-8").replace("&#160;", " ")
    assert text.startswith("<svg")
    assert "the arm waved" in text
    assert "last" in text
    assert "first" not in text


def test_pictures_that_cannot_be_written_fail_the_demo(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    path = [(at / 10, {"shoulder_pan": at / 10}) for at in range(3)]
    with pytest.raises(CliError, match="could not be written"):
        draw_path("so100", path, tmp_path / "taken" / "folder")


def test_motion_without_events_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(CliError, match="too little"):
        draw_path("so100", [(0.0, {"shoulder_pan": 0.0})], tmp_path)
