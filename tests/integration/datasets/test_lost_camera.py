"""A camera that is gone in the middle of an attempt: the episode is kept, and says so in each frame."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.encoder import CameraEncoder
from strands_robots.datasets.layout import data_file
from strands_robots.datasets.recorded import AGE, SAME
from strands_robots.datasets.session import RecordingSession
from strands_robots.recording.file import Recorder

FPS, FRAMES, GONE_AT = 30, 66, 15


def test_episode_of_a_camera_that_was_unplugged_is_kept_and_marks_it(tmp_path: Path) -> None:
    beat = threading.Event()
    with RecordingSession(tmp_path, FPS, "wave", "so100", lambda said: None) as recording:
        path = recording.recording
        with CameraEncoder(FPS) as encoder, Recorder(path) as recorder, encoder.attempt(path):
            for number in range(FRAMES):
                recorder.take("arm-1", "streamStep", {"observation": {"pan": number}, "action": {"pan": number}})
                for camera in ("top", "wrist")[: 2 if number < GONE_AT else 1]:
                    shade = number * 3 if camera == "top" else 200 - number * 3
                    encoder.offer(camera, np.full((48, 64, 3), shade, dtype=np.uint8))
                beat.wait(1 / FPS)
        kept = recording.keep(success=True)
    assert kept is not None
    assert kept[1] > FRAMES // 2, "it goes on without the camera"
    frames = tables.read_frames(tmp_path / data_file(0))
    ages = frames[f"{AGE}wrist"]
    assert frames[f"{SAME}wrist"][-20:].all()
    assert ages[-1] > 1000
    assert np.diff(ages[-20:]).min() > 0, "each frame says how old its picture is"
    assert ages[-1] > frames[f"{AGE}top"].max()
    found = check_dataset(tmp_path)[1]
    assert not any(each.wrong for each in found)
    said = [f"{each.where}: {each.said}" for each in found]
    assert any(each.startswith("episode 0: wrist is ") for each in said), said
    assert any("wrist: its picture stays the same for" in each for each in said), said
