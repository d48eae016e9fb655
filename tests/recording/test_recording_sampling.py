"""A served robot is recorded where it is served: while it stands, while it moves, halted and locked."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.envelope import Envelope, error
from strands_robots.hardware import HardwareRobot
from strands_robots.recording import Entry, Joints, Picture, Recorder, RobotRecording, read_entries, read_items
from strands_robots.recording.cameras import chosen_frames, frames_of
from strands_robots.simulation import Simulation
from strands_robots.teleoperators.leader import ScriptedLeader
from strands_robots.utils import ValidationError

pytest.importorskip("mcap")


class Camera:
    """A camera that keeps its newest picture, as LeRobot's do."""

    def __init__(self) -> None:
        self.broken = False
        self.looks = 0

    def read_latest(self) -> Any:
        self.looks += 1
        if self.broken:
            raise TimeoutError("no frame in 200 ms")
        return np.full((24, 32, 3), self.looks % 256, dtype=np.uint8)


class SeeingDevice(RecordingDevice):
    def __init__(self) -> None:
        super().__init__()
        self.cameras = {"front": Camera()}


class Latch:
    def __init__(self) -> None:
        self.locked = False

    def refusal(self, verb: str) -> Envelope | None:
        return error("locked by the emergency stop e-1") if self.locked else None


@pytest.fixture
def arm(patient_halts: None) -> Any:
    robot = HardwareRobot(SeeingDevice(), "arm", control_hz=50)
    robot.connect()
    yield robot
    robot.cleanup()


def events(path: Path) -> list[str]:
    # A busy machine may skip a beat, which is told at the end.
    return [entry.event for entry in read_entries(path) if entry.event != "samplesSkipped"]


def test_an_idle_arm_gives_joints_and_pictures(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        Recorder(path, joints_of_events=False) as recorder,
        RobotRecording(arm, recorder, "arm-1", frames=frames_of(arm)),
    ):
        eventually(lambda: recorder.counts["/arm-1/joint_states"] >= 25)
        eventually(lambda: recorder.counts["/arm-1/camera/front"] >= 5)
    items = list(read_items(path))
    assert next(item for item in items if isinstance(item, Joints)).joints == arm.get_state()["joints"]
    assert next(item for item in items if isinstance(item, Picture)).jpeg[:2] == b"\xff\xd8"
    assert events(path) == []


def test_a_task_its_halt_and_the_lock_are_told_in_their_order(arm: HardwareRobot, tmp_path: Path) -> None:
    path, latch = tmp_path / "run.mcap", Latch()
    arm.gate.attach(latch)
    with Recorder(path, joints_of_events=False) as recorder, RobotRecording(arm, recorder, "arm-1"):
        arm.start_task("wave", duration=120)
        eventually(lambda: recorder.counts["/arm-1/streamStep"] > 5)
        latch.locked = True
        arm.halt("test")
        eventually(lambda: recorder.counts["/arm-1/locked"] == 1)
        latch.locked = False
        eventually(lambda: recorder.counts["/arm-1/unlocked"] == 1)
    told = [event for event in events(path) if event != "streamStep"]
    assert told[0] == "taskStarted"
    assert set(told[1:-1]) == {"taskComplete", "halted", "locked"}
    assert told[-1] == "unlocked"


def test_a_teleoperation_is_recorded_as_a_task_is(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, joints_of_events=False) as recorder, RobotRecording(arm, recorder, "arm-1"):
        arm.attach_teleop(ScriptedLeader({"pan.pos": (0.0, 10.0, 1.0)}))
        assert arm.teleoperate(duration=0.3)["status"] == "success"
        eventually(lambda: recorder.counts["/arm-1/taskComplete"] == 1)
    first = next(item for item in read_items(path) if isinstance(item, Entry) and item.event == "streamStep")
    assert set(first.payload["action"]) == {"pan.pos"}


def test_a_camera_that_fails_is_told_once_and_the_joints_go_on(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    arm.device.cameras["front"].broken = True
    with (
        Recorder(path, joints_of_events=False) as recorder,
        RobotRecording(arm, recorder, "arm-1", frames=frames_of(arm)),
    ):
        eventually(lambda: arm.device.cameras["front"].looks > 15)
        eventually(lambda: recorder.counts["/arm-1/joint_states"] >= 10)
    assert events(path) == ["notRecorded"]


def test_a_camera_that_fails_costs_the_ones_behind_it_nothing(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    arm.device.cameras["wrist"] = Camera()
    arm.device.cameras["front"].broken = True
    with (
        Recorder(path, joints_of_events=False) as recorder,
        RobotRecording(arm, recorder, "arm-1", frames=frames_of(arm)),
    ):
        eventually(lambda: recorder.counts["/arm-1/notRecorded"] == 1)
        eventually(lambda: recorder.counts["/arm-1/camera/wrist"] >= 15)
    (told,) = [entry.payload for entry in read_entries(path) if entry.event == "notRecorded"]
    assert told["what"] == "pictures of front"


def test_only_the_chosen_cameras_are_looked_at(arm: HardwareRobot) -> None:
    arm.device.cameras["wrist"] = Camera()
    frames = chosen_frames(arm, ["wrist", "nowhere"])
    assert frames is not None
    assert {name: picture.shape for name, picture in frames().items()} == {"wrist": (24, 32, 3)}
    assert arm.device.cameras["front"].looks == 0


def test_a_world_records_each_of_its_robots(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    world = Simulation("bench")
    world.add_robot("left", "so100")
    world.add_robot("right", "so100", position=(0.0, 0.5, 0.0))
    try:
        with Recorder(path, joints_of_events=False) as recorder, RobotRecording(world, recorder, "sim-1"):
            world.start_policy("left", "wave", duration=120)
            eventually(lambda: recorder.counts["/sim-1/streamStep"] > 5)
            for name in ("left", "right"):
                eventually(lambda name=name: recorder.counts[f"/sim-1/{name}/joint_states"] > 5)
            world.halt("test")
            eventually(lambda: recorder.counts["/sim-1/policyComplete"] == 1)
        with pytest.raises(ValidationError, match="overview"):
            chosen_frames(world, ["nobody"])
    finally:
        world.cleanup()


def test_a_recording_whose_last_look_fails_still_leaves_the_robot_and_tells_what_it_skipped(
    arm: HardwareRobot, tmp_path: Path
) -> None:
    class Unreadable(Latch):
        def refusal(self, verb: str) -> Envelope | None:
            if self.locked:
                raise OSError("the lockout cannot be read")
            return None

    path, latch = tmp_path / "run.mcap", Unreadable()
    arm.gate.attach(latch)
    with Recorder(path, joints_of_events=False) as recorder:
        with RobotRecording(arm, recorder, "arm-1") as sampling:
            sampling.skipped["joints"] += 1
            latch.locked = True
        latch.locked = False
        arm.start_task("wave", duration=0.05)
        eventually(lambda: arm.get_task_status()["task_status"] != "running")
    assert [entry.event for entry in read_entries(path)] == ["samplesSkipped"]


def test_beats_that_a_slow_camera_skips_are_counted_and_told(arm: HardwareRobot, tmp_path: Path) -> None:
    path, looked = tmp_path / "run.mcap", threading.Event()

    def slow() -> dict[str, Any]:
        time.sleep(0.2)
        looked.set()
        return {}

    with Recorder(path, joints_of_events=False) as recorder:
        with RobotRecording(arm, recorder, "arm-1", frames=slow, cameras_hz=50) as sampling:
            assert looked.wait(20)
            eventually(lambda: sampling.skipped["cameras"] >= 8)
        skipped = sampling.skipped["cameras"]
    (told,) = [entry.payload for entry in read_entries(path) if entry.event == "samplesSkipped"]
    assert told["cameras"] == skipped
