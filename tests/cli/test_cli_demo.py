"""Steps of the demo with stand-ins for robot, agent and controller: a step that did not happen must fail."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from examples.demo.output import BUNCHED_S, PAUSE_S, DemoScreen, draw_motion, frames_within, replayed
from examples.demo.processes import AgentEvent
from examples.demo.steps import NEEDED, DemoReport, DriveSteps, SafetySteps, on_plate

from strands_robots.audit import flush_audit, log_safety_event
from strands_robots.cli.output import CliError, Screen
from strands_robots.recording.cameras import jpeg
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.simulation import TABLETOP

EPOCH = "0123456789abcdef0123456789abcdef"


def table_objects(x: float = 0.24, y: float = 0.09, z: float = 0.0135) -> dict[str, Any]:
    """Return the objects as the robot tells them, with the cube at a place."""
    plate = {"x": 0.2, "y": -0.14, "z": 0.005, "size": [0.1, 0.1, 0.008]}
    return {"plate": plate, "red_cube": {"x": x, "y": y, "z": z, "size": [0.025, 0.025, 0.025]}}


ON_PLATE = {"x": 0.205, "y": -0.138, "z": 0.0215}


class Robot:
    """Behaviour of the fake agent's robot; a test changes one thing."""

    def __init__(self) -> None:
        self.functions = list(NEEDED)
        self.objects = table_objects()
        self.jpeg = base64.b64encode(jpeg("front", np.zeros((24, 32, 3), np.uint8))).decode("ascii")
        self.holding: bool | None = True
        self.travel = 0.5
        self.drift = 0.0
        self.brake = 0.0
        self.ends = True
        self.outcome: dict[str, Any] = {"task_status": "completed", "why": "it is done"}
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
        if function == "pick" and self.robot.refusal:
            raise CliError(self.robot.refusal)
        if function == "pick":
            self.stopped = False
            return {"status": "success", "task_id": "pick-1"}
        if function == "getObjects":
            return {"objects": self.robot.objects}
        if function == "getPicture":
            return {"jpeg": self.robot.jpeg}
        if function == "stop":
            self.stopped = True
            return self.robot.verdict
        if function == "getStatus":
            self.status_calls += 1
            return {"robots": {"arm": {"pan": 1.0 + (self.robot.brake if self.status_calls > 1 else 0.0)}}}
        return {"robots": {"arm": {"joints": {"pan": [-2, 2]}}}}

    def ask(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        assert (function, params["task_id"]) == ("wait", "pick-1")
        return {**self.robot.outcome, "holding": self.robot.holding, "error_mm": 0.5, "duration": 5.0}

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
            joints = {"pan": start + reach * part / 4, "gripper": self.robot.travel * part}
            yield AgentEvent("streamStep", {"observation": joints, "action": joints}, self.at)
            yield AgentEvent("observationUpdate", {"joints": {"pan": joints["pan"]}}, self.at)
        if self.robot.ends:
            yield AgentEvent("policyComplete", {"state": "completed"}, self.at)


class FakeProcess:
    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def check(self) -> None:
        if not self.robot.alive:
            raise CliError("The robot's process ended with exit code -9.")


def drive(robot: Robot, folder: Path) -> DemoReport:
    agent: Any = FakeAgent(robot)
    process: Any = FakeProcess(robot)
    steps = DriveSteps(DemoScreen(Screen(machine=True)), agent, process, "arm-1", DemoReport())
    steps.discover()
    steps.look(folder)
    steps.stop()
    steps.pick()
    return steps.report


def test_drive_steps_pass_with_a_working_robot(tmp_path: Path) -> None:
    report = drive(Robot(), tmp_path)
    assert [(step["step"], step["ok"]) for step in report.steps] == [
        ("discover", True),
        ("look", True),
        ("stop", True),
        ("pick", True),
    ]
    assert report.stop_ms >= 0
    assert report.path
    assert report.setpoints
    picture = report.steps[1]["picture"]
    assert (picture["width"], picture["height"]) == (32, 24)
    assert Path(picture["file"]).read_bytes().startswith(b"\xff\xd8")


DRIVE_FAULTS: dict[str, tuple[Callable[[Robot], None], str]] = {
    "discovery": (lambda robot: setattr(robot, "discovered", False), "not discovered"),
    "a function": (lambda robot: robot.functions.remove("stop"), "without stop"),
    "an object": (lambda robot: robot.objects.pop("red_cube"), "There are no red_cube and plate"),
    "something to do": (lambda robot: setattr(robot, "objects", table_objects(**ON_PLATE)), "before anything"),
    "a picture": (lambda robot: setattr(robot, "jpeg", "bm8gcGljdHVyZQ=="), "without a picture"),
    "leave": (lambda robot: setattr(robot, "refusal", "pick was refused"), "refused"),
    "motion": (lambda robot: setattr(robot, "travel", 0.0), "did not move"),
    "its end": (lambda robot: setattr(robot, "ends", False), "did not report its end"),
    "completion": (lambda robot: robot.outcome.update(task_status="error", why="boom"), "error: boom"),
    "a grasp": (lambda robot: setattr(robot, "holding", None), "hold nothing"),
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
def test_drive_step_that_did_not_happen_fails_the_demo(missing: str, tmp_path: Path) -> None:
    inject, message = DRIVE_FAULTS[missing]
    robot = Robot()
    inject(robot)
    with pytest.raises(CliError, match=message):
        drive(robot, tmp_path)


@pytest.mark.parametrize(
    "place",
    [
        {"x": 0.24, "y": 0.09, "z": 0.0135},
        {"x": 0.2, "y": -0.14, "z": 0.0135},
        {"x": 0.2, "y": -0.14, "z": 0.06},
        {"x": 0.235, "y": -0.14, "z": 0.0215},
    ],
    ids=["on the table", "in the plate", "above the plate", "half over its rim"],
)
def test_cube_that_is_not_on_the_plate_is_not_taken_for_it(place: dict[str, float]) -> None:
    assert on_plate(table_objects(**place)) is None
    assert on_plate(table_objects(**ON_PLATE)) == pytest.approx(0.0054, abs=1e-4)


class Scene:
    """A robot and a controller that work; a test breaks one thing."""

    def __init__(self) -> None:
        answer = Answer("arm-1", True, 3.0, "")
        self.stop_report = StopReport(EPOCH, {"arm-1": answer}, {}, {}, (), True, 3.0)
        self.refusal: dict[str, Any] = {"status": "error", "reason": f"locked by demo-safety, epoch {EPOCH}"}
        self.resumed: dict[str, Any] = {"locked": False, "epochs": []}
        self.status: dict[str, Any] = {"locked": False, "running_policies": {}}
        self.runs = True
        self.holding: bool | None = True
        self.objects = table_objects(**ON_PLATE)
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

    def start_motion(self, stream: None, verb: str, **params: Any) -> None:
        pass

    def read_objects(self) -> dict[str, Any]:
        return self.objects

    def measure_rest(self, stream: None) -> tuple[float, float]:
        return 0.01, 0.0

    def run_motion(self, stream: None, verb: str, **params: Any) -> dict[str, Any]:
        if not self.runs:
            raise CliError("The motion did not report its end.")
        return {"holding": self.holding if verb == "setGripper" else False, "error_mm": 0.5}


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
        ("place", True),
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
    "the cube": (lambda scene: setattr(scene, "holding", False), "was lost"),
    "the plate": (lambda scene: setattr(scene, "objects", table_objects()), "not on the plate"),
    "a record": (lambda scene: setattr(scene, "records", 0), "does not record what happened"),
}


@pytest.mark.parametrize("missing", SAFETY_FAULTS)
def test_safety_step_that_did_not_happen_fails_the_demo(missing: str) -> None:
    inject, message = SAFETY_FAULTS[missing]
    scene = Scene()
    inject(scene)
    with pytest.raises(CliError, match=message):
        run_safety_steps(scene)


def test_replay_shortens_pauses_and_spreads_bunches() -> None:
    setpoints = [(at, {"pan": at}) for at in (0.0, 0.02, 0.02, 3.0)]
    assert replayed(setpoints) == [
        ({"pan": 0.0}, 0.02),
        ({"pan": 0.02}, BUNCHED_S),
        ({"pan": 0.02}, PAUSE_S),
        ({"pan": 3.0}, PAUSE_S),
    ]
    assert replayed([]) == []


@pytest.mark.parametrize(("each_s", "frames"), [(0.0, 60), (0.1, 60), (0.4, 30), (5.0, 12)])
def test_slow_renderer_draws_fewer_frames(each_s: float, frames: int) -> None:
    assert frames_within(12.0, each_s) == frames


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
    setpoints = [(at / 10, {"shoulder_pan": at / 10}) for at in range(3)]
    with pytest.raises(CliError, match="could not be written"):
        draw_motion("so100", TABLETOP, setpoints, tmp_path / "taken" / "folder")


def test_motion_without_events_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(CliError, match="too little"):
        draw_motion("so100", TABLETOP, [(0.0, {"shoulder_pan": 0.0})], tmp_path)
