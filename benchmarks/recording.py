"""Cost of recording eight arms and a camera, beside the mcap library alone."""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from fixtures.devices import RecordingDevice
from mcap.writer import Writer

from benchmarks.table import Row
from strands_robots.hardware import HardwareRobot
from strands_robots.recording.cameras import jpeg
from strands_robots.recording.file import (
    RecordedEvent,
    RecordedJoints,
    RecordedPicture,
    Recorder,
    RobotRecording,
    read_items,
)

ARMS, HZ, CAMERA_HZ = 8, 50.0, 15.0
WIDTH, HEIGHT = 320, 240
SECONDS, SECONDS_QUICK = 30.0, 4.0
PERCENT = 15.0
SAMPLED_SHARE = 0.98


class Camera:
    """Camera of a smooth scene with some noise, with another picture each time."""

    def __init__(self) -> None:
        dice = np.random.default_rng(1)
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
        scene = np.stack([rows, columns, rows + columns], axis=2) // 3
        self._pictures = [(scene + dice.integers(0, 12, scene.shape)).astype(np.uint8) for _ in range(8)]
        self.taken = 0

    def read_latest(self) -> Any:
        self.taken += 1
        return self._pictures[self.taken % len(self._pictures)]


class SeeingDevice(RecordingDevice):
    """An arm of six joints, with a camera where one is given."""

    def __init__(self, camera: Camera | None) -> None:
        super().__init__()
        self.positions = {f"joint_{number}.pos": 12.345678 * number for number in range(6)}
        self.cameras = {} if camera is None else {"front": camera}


def run(*, quick: bool = False) -> list[Row]:
    """Measure and return the one row of this part."""
    seconds = SECONDS_QUICK if quick else SECONDS
    with tempfile.TemporaryDirectory(prefix="bench-record-") as folder:
        return [recorded(Path(folder), seconds)]


def recorded(folder: Path, seconds: float) -> Row:
    """Record joints of idle arms and steps of tasks at 50 Hz, pictures at 15 Hz."""
    camera = Camera()
    path = folder / "run.mcap"
    robots = [HardwareRobot(SeeingDevice(None if number else camera), f"arm-{number}") for number in range(ARMS)]
    for robot in robots:
        robot.connect()
    idle = beats(seconds / 4, lambda beat: None)
    samplings: list[RobotRecording] = []
    with ExitStack() as stack:
        recorder = stack.enter_context(Recorder(path, joints_of_events=False))
        for number, robot in enumerate(robots):
            frames = robot.camera_frames if number == 0 else None
            samplings.append(stack.enter_context(RobotRecording(robot, recorder, f"arm-{number}", frames=frames)))
        share = beats(seconds, lambda beat: steps(recorder, beat)) - idle
    for robot in robots:
        robot.cleanup()
    items = list(read_items(path))
    recorded_steps = sum(isinstance(item, RecordedEvent) and item.event == "streamStep" for item in items)
    joints = sum(isinstance(item, RecordedJoints) for item in items)
    pictures = sum(isinstance(item, RecordedPicture) for item in items)
    sent = int(seconds * HZ) * ARMS
    bare = bare_share(folder / "bare.mcap", seconds, camera)
    skipped = sum((sampling.skipped for sampling in samplings), Counter[str]())
    late = skipped["joints"] + skipped["cameras"]
    least = SAMPLED_SHARE * seconds
    return Row(
        what=f"{ARMS} arms at {HZ:g} Hz, one {WIDTH} x {HEIGHT} camera at {CAMERA_HZ:g} Hz, {seconds:g} s",
        ours=f"{share:.1f} % of a core; {recorded_steps} steps, {joints} joint states, {pictures} pictures; "
        f"{recorder.lost} lost, {late} beats skipped",
        against=f"{bare:.1f} %, steps, joints and pictures encoded and written in one loop",
        ratio=share / bare,
        must=f"under {PERCENT:g} % of a core, none lost, at most {1 - SAMPLED_SHARE:.0%} of the beats skipped",
        ok=share < PERCENT
        and recorder.lost == 0
        and recorded_steps == sent
        and joints >= least * HZ * ARMS
        and pictures >= least * CAMERA_HZ,
    )


def steps(recorder: Recorder, beat: int) -> None:
    """Record one step of each arm, as the observers of their control loops do."""
    for number in range(ARMS):
        recorder.take(f"arm-{number}", "streamStep", step(beat))


def step(beat: int) -> dict[str, Any]:
    values = {f"joint_{number}.pos": 12.345678 * number for number in range(6)}
    return {"step": beat, "observation": values, "action": values}


def beats(seconds: float, act: Any) -> float:
    """Act at 50 Hz for some seconds; return the process's share of a core in percent."""
    cpu, started = time.process_time(), time.monotonic()
    for beat in range(int(seconds * HZ)):
        act(beat)
        time.sleep(max(0.0, started + (beat + 1) / HZ - time.monotonic()))
    return (time.process_time() - cpu) / (time.monotonic() - started) * 100


def bare_share(path: Path, seconds: float, camera: Camera) -> float:
    """Write the same messages with the mcap library alone; return the share."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/any", "json", schema)

        def write(data: bytes) -> None:
            now = time.time_ns()
            writer.add_message(channel, log_time=now, data=data, publish_time=now)

        def act(beat: int) -> None:
            for _ in range(ARMS):
                payload = step(beat)
                write(json.dumps(payload).encode())
                write(json.dumps(payload["action"]).encode())
            if int((beat + 1) * CAMERA_HZ / HZ) > int(beat * CAMERA_HZ / HZ):
                write(jpeg("front", camera.read_latest()))

        share = beats(seconds, act)
        writer.finish()
    return share
