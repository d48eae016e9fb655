"""Recording of a served robot: idle, moving, halted and locked."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually

from strands_robots.envelope import Envelope, error
from strands_robots.hardware import HardwareRobot
from strands_robots.recording.cameras import Frames, chosen_frames, frames_of
from strands_robots.recording.file import (
    RecordedEvent,
    RecordedJoints,
    RecordedPicture,
    Recorder,
    RobotRecording,
    read_events,
    read_items,
)
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError

pytest.importorskip("mcap")


class Camera:
    """A camera that keeps its newest picture, as LeRobot's do."""

    def __init__(self) -> None:
        self.broken = False
        self.reads = 0

    def read_latest(self) -> Any:
        self.reads += 1
        if self.broken:
            raise TimeoutError("no frame in 200 ms")
        return np.full((24, 32, 3), self.reads % 256, dtype=np.uint8)


class SeeingDevice(RecordingDevice):
    def __init__(self) -> None:
        super().__init__()
        self.cameras = {"front": Camera()}


class FakeLockout:
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


@contextmanager
def recording(robot: Any, path: Path, device: str = "arm-1", frames: Frames | None = None) -> Iterator[Recorder]:
    with Recorder(path, joints_of_events=False) as recorder, RobotRecording(robot, recorder, device, frames=frames):
        yield recorder


def events(path: Path) -> list[str]:
    # A busy machine may skip a beat, which the recording reports at its end.
    return [event.event for event in read_events(path) if event.event != "samplesSkipped"]


def test_idle_arm_is_recorded_with_joints_and_pictures(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with recording(arm, path, frames=frames_of(arm)) as recorder:
        eventually(lambda: recorder.counts["/arm-1/joint_states"] >= 25)
        eventually(lambda: recorder.counts["/arm-1/camera/front"] >= 5)
    items = list(read_items(path))
    assert next(item for item in items if isinstance(item, RecordedJoints)).joints == arm.get_state()["joints"]
    assert next(item for item in items if isinstance(item, RecordedPicture)).jpeg[:2] == b"\xff\xd8"
    assert events(path) == []


def test_task_halt_and_lock_are_recorded_in_their_order(arm: HardwareRobot, tmp_path: Path) -> None:
    path, lockout = tmp_path / "run.mcap", FakeLockout()
    arm.gate.attach(lockout)
    with recording(arm, path) as recorder:
        arm.start_task("wave", duration=120)
        eventually(lambda: recorder.counts["/arm-1/streamStep"] > 5)
        lockout.locked = True
        arm.halt("test")
        eventually(lambda: recorder.counts["/arm-1/locked"] == 1)
        lockout.locked = False
        eventually(lambda: recorder.counts["/arm-1/unlocked"] == 1)
    names = [event for event in events(path) if event != "streamStep"]
    assert names[0] == "taskStarted"
    assert set(names[1:-1]) == {"taskComplete", "halted", "locked"}
    assert names[-1] == "unlocked"


def test_units_and_a_motion_that_is_refused_while_locked_are_recorded(tmp_path: Path) -> None:
    path, lockout = tmp_path / "run.mcap", LockoutLatch("so100")
    simulation = Simulation()
    simulation.add_robot("so100")
    try:
        with recording(simulation, path):
            lockout.engage("0" * 32, "bob", "smoke")
            simulation.gate.attach(lockout)
            assert simulation.start_policy("so100", "wave", "mock")["locked"] is True
    finally:
        simulation.cleanup()
    told = {event.event: event for event in read_events(path)}
    assert told["jointUnits"].payload["units"]["gripper"] == "radians"
    assert told["jointUnits"].robot == "arm-1/so100"
    assert told["motionRefused"].payload["verb"] == "start_policy"
    assert "emergency stop of bob" in str(told["motionRefused"].payload["reason"])


def test_teleoperation_is_recorded_like_a_task(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with recording(arm, path) as recorder:
        arm.attach_teleop(ScriptedLeader({"pan.pos": (0.0, 10.0, 1.0)}))
        assert arm.teleoperate(duration=0.3)["status"] == "success"
        eventually(lambda: recorder.counts["/arm-1/taskComplete"] == 1)
    first = next(item for item in read_items(path) if isinstance(item, RecordedEvent) and item.event == "streamStep")
    assert set(first.payload["action"]) == {"pan.pos"}


def test_failing_camera_is_reported_once_and_joints_go_on(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    arm.device.cameras["front"].broken = True
    with recording(arm, path, frames=frames_of(arm)) as recorder:
        eventually(lambda: arm.device.cameras["front"].reads > 15)
        eventually(lambda: recorder.counts["/arm-1/joint_states"] >= 10)
    assert events(path) == ["notRecorded"]


def test_failing_camera_does_not_affect_the_other_cameras(arm: HardwareRobot, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    arm.device.cameras["wrist"] = Camera()
    arm.device.cameras["front"].broken = True
    with recording(arm, path, frames=frames_of(arm)) as recorder:
        eventually(lambda: recorder.counts["/arm-1/notRecorded"] == 1)
        eventually(lambda: recorder.counts["/arm-1/camera/wrist"] >= 15)
    (payload,) = [event.payload for event in read_events(path) if event.event == "notRecorded"]
    assert payload["what"] == "pictures of front"


def test_only_the_chosen_cameras_are_read(arm: HardwareRobot) -> None:
    arm.device.cameras["wrist"] = Camera()
    frames = chosen_frames(arm, ["wrist", "nowhere"])
    assert frames is not None
    assert {name: picture.shape for name, picture in frames().items()} == {"wrist": (24, 32, 3)}
    assert arm.device.cameras["front"].reads == 0


def test_each_robot_of_a_world_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    world = Simulation("bench")
    world.add_robot("left", "so100")
    world.add_robot("right", "so100", position=(0.0, 0.5, 0.0))
    try:
        with recording(world, path, "sim-1") as recorder:
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


def test_recording_whose_last_gate_check_fails_still_unsubscribes_and_reports_skipped_beats(
    arm: HardwareRobot, tmp_path: Path
) -> None:
    class Unreadable(FakeLockout):
        def refusal(self, verb: str) -> Envelope | None:
            if self.locked:
                raise OSError("the lockout cannot be read")
            return None

    path, lockout = tmp_path / "run.mcap", Unreadable()
    arm.gate.attach(lockout)
    with Recorder(path, joints_of_events=False) as recorder:
        with RobotRecording(arm, recorder, "arm-1") as sampling:
            sampling.skipped["joints"] += 1
            lockout.locked = True
        lockout.locked = False
        arm.start_task("wave", duration=0.05)
        eventually(lambda: arm.get_task_status()["task_status"] != "running")
    assert [event.event for event in read_events(path)] == ["samplesSkipped"]


def test_beats_skipped_by_a_slow_camera_are_counted_and_recorded(arm: HardwareRobot, tmp_path: Path) -> None:
    path, was_read = tmp_path / "run.mcap", threading.Event()

    def slow() -> dict[str, Any]:
        time.sleep(0.2)
        was_read.set()
        return {}

    with Recorder(path, joints_of_events=False) as recorder:
        with RobotRecording(arm, recorder, "arm-1", frames=slow, cameras_hz=50) as sampling:
            assert was_read.wait(20)
            eventually(lambda: sampling.skipped["cameras"] >= 8)
        skipped = sampling.skipped["cameras"]
    (payload,) = [event.payload for event in read_events(path) if event.event == "samplesSkipped"]
    assert payload["cameras"] == skipped
