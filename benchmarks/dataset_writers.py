"""CPU of writing one episode of an arm with two cameras, by ours or by LeRobot's own writer.

``python -m benchmarks.dataset_writers KIND SECONDS FOLDER`` in the environment of ``scripts/lerobot.sh 0.6.1`` prints
the CPU and the frames; ``KIND`` is ``ours``, ``default`` or ``streaming``. ``saved`` saves episodes of so many seconds
with LeRobot's own writer and waits for its kill; ``read`` prints how many episodes LeRobot reads.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
from fixtures.devices import RecordingDevice
from fixtures.replayed_cameras import HEIGHT, WIDTH, ReplayedCamera

from benchmarks.dataset_children import FPS, TASK, RecordedArm, cpu_seconds
from strands_robots.datasets.layout import read_info
from strands_robots.hardware import HardwareRobot

LEROBOT = ("lerobot.configs", "lerobot.datasets.lerobot_dataset")
CAMERAS = ("front", "wrist")
JOINTS = tuple(f"joint_{number}.pos" for number in range(6))
IDLE_SHARE = 0.5
"""Length of the run without a recording, which is taken off, of that of the one with it."""

SAVED = 5
"""Episodes that are saved before the kill."""

THREADS_PER_CAMERA = 4
"""Threads that write pictures, as ``lerobot-record`` has them."""


def device() -> Any:
    """Return an arm of six joints."""
    arm = RecordingDevice()
    arm.positions = dict.fromkeys(JOINTS, 10.0)
    arm.joint_ranges = dict.fromkeys(JOINTS, (-100.0, 100.0))
    return arm


def ours(seconds: float, folder: Path) -> tuple[float, int]:
    """Record an episode as ``dataset record`` does; return CPU seconds and frames."""
    cameras = {name: ReplayedCamera() for name in CAMERAS}
    robot = HardwareRobot(device(), "arm")
    robot.device.cameras = cameras
    robot.connect()
    arm = RecordedArm(robot, folder / "set", hz=FPS)
    began = cpu_seconds()
    arm.lead_for(seconds * IDLE_SHARE)
    idle = (cpu_seconds() - began) / IDLE_SHARE
    began = cpu_seconds()
    arm.record_for(seconds, robot.camera_frames)
    spent = cpu_seconds() - began
    robot.cleanup()
    return spent - idle, read_info(arm.folder).frames


def theirs(seconds: float, folder: Path, *, streaming: bool) -> tuple[float, int]:
    """Record an episode with LeRobot's own writer; return CPU seconds and frames."""
    for module in LEROBOT:
        import_module(module)
    began = cpu_seconds()
    loop(seconds * IDLE_SHARE, None)
    idle = (cpu_seconds() - began) / IDLE_SHARE
    began = cpu_seconds()
    dataset = lerobots(folder, streaming=streaming)
    frames = loop(seconds, dataset)
    dataset.save_episode()
    dataset.finalize()
    return cpu_seconds() - began - idle, frames


def lerobots(folder: Path, *, streaming: bool) -> Any:
    """Return a new dataset of LeRobot's, as ``lerobot-record`` makes it, with our codec and its settings."""
    configs, datasets = (cast("Any", import_module(module)) for module in LEROBOT)
    vector = {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}
    picture = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    cameras = {f"observation.images.{name}": picture for name in CAMERAS}
    return datasets.LeRobotDataset.create(
        "bench/set",
        FPS,
        {"observation.state": vector, "action": vector, **cameras},
        root=folder / "set",
        image_writer_threads=0 if streaming else THREADS_PER_CAMERA * len(CAMERAS),
        streaming_encoding=streaming,
        # As in strands_robots.datasets.video.
        rgb_encoder=configs.RGBEncoderConfig(vcodec="h264", preset="veryfast", crf=23, g=2, extra_options={"bf": "0"}),
    )


def loop(seconds: float, dataset: Any) -> int:
    """Read and move an arm on the grid, as ``lerobot-record`` does; return the frames."""
    arm, cameras = device(), {f"observation.images.{name}": ReplayedCamera() for name in CAMERAS}
    started, count = time.monotonic(), int(seconds * FPS)
    for frame in range(count):
        state = np.array(list(arm.get_observation().values()), dtype=np.float32)
        arm.send_action(dict(zip(JOINTS, state.tolist(), strict=True)))
        if dataset is not None:
            pictures = {name: camera.read_latest() for name, camera in cameras.items()}
            dataset.add_frame({"observation.state": state, "action": state, "task": TASK, **pictures})
        time.sleep(max(0.0, started + (frame + 1) / FPS - time.monotonic()))
    return count


def save_until_killed(seconds: float, folder: Path) -> None:
    """Save episodes with LeRobot's own writer, say so, and wait."""
    dataset = lerobots(folder, streaming=False)
    for _ in range(SAVED):
        loop(seconds, dataset)
        dataset.save_episode()
    print(json.dumps({"saved": SAVED}), flush=True)
    sys.stdin.read()


def readable(folder: Path) -> int:
    """Return how many episodes LeRobot reads of a dataset."""
    datasets: Any = import_module(LEROBOT[1])
    try:
        dataset = datasets.LeRobotDataset("bench/set", root=folder / "set")
        return len({int(dataset[number]["episode_index"]) for number in range(dataset.num_frames)})
    except Exception:  # noqa: BLE001 - whatever it raises, it does not read it
        return 0


def main() -> None:
    """Do what the arguments say, and print it."""
    logging.disable(logging.ERROR)
    kind, seconds, folder = sys.argv[1], float(sys.argv[2]), Path(sys.argv[3])
    if kind == "saved":
        save_until_killed(seconds, folder)
    elif kind == "read":
        print(json.dumps({"episodes": readable(folder)}), flush=True)
    else:
        cpu, frames = (
            ours(seconds, folder) if kind == "ours" else theirs(seconds, folder, streaming=kind == "streaming")
        )
        print(json.dumps({"cpu": cpu, "frames": frames}), flush=True)


if __name__ == "__main__":
    main()
