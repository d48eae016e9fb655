"""Cameras encoded in a process of their own: what is offered is stored or counted, and a kill costs no attempt."""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fixtures.waiting import eventually
from numpy.typing import NDArray
from PIL import Image

from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.encoded import ROW, cameras_folder, encoded_videos
from strands_robots.datasets.encoder import CameraEncoder
from strands_robots.datasets.layout import data_file, video_file
from strands_robots.datasets.session import NoPictureError, RecordingSession
from strands_robots.datasets.video import copy_pictures, pictures_of
from strands_robots.recording.file import Recorder
from strands_robots.utils import ValidationError

FPS = 50
TOP, WRIST = "top", "arm.wrist"


@pytest.fixture(scope="module")
def encoder() -> Iterator[CameraEncoder]:
    with CameraEncoder(FPS) as made:
        yield made


def picture(number: int, width: int = 64) -> NDArray[np.uint8]:
    return np.full((48, width, 3), number * 5 % 256, dtype=np.uint8)


def session(folder: Path, said: list[str] | None = None) -> RecordingSession:
    return RecordingSession(folder, FPS, "wave", "so100", ([] if said is None else said).append)


def lead(encoder: CameraEncoder, path: Path, *cameras: str, frames: int = 20) -> int:
    """Record an attempt of steps and pictures at the rate of the dataset; return how many of each there are."""
    beat = threading.Event()
    with Recorder(path) as recorder, encoder.attempt(path):
        for number in range(frames):
            recorder.take("arm-1", "streamStep", {"observation": {"pan": number}, "action": {"pan": number}})
            for camera in cameras:
                encoder.offer(camera, picture(number))
            beat.wait(1 / FPS)
    return frames


def wrong(folder: Path) -> list[str]:
    # The cameras here are given the same pictures.
    return [each.said for each in check_dataset(folder, doubles=False)[1] if each.wrong]


def test_episode_has_the_pictures_of_each_camera_at_its_moments(encoder: CameraEncoder, tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        led = lead(encoder, recording.recording, TOP, WRIST)
        kept = recording.keep(success=True)
        assert list((tmp_path / ".running").iterdir()) == []
    assert kept is not None
    assert kept[1] > led // 2
    assert wrong(tmp_path) == []
    frames = tables.read_frames(tmp_path / data_file(0))
    for camera in (TOP, WRIST):
        video = tmp_path / video_file(f"observation.images.{camera}", 0)
        shades = np.array([float(each.mean()) for each in pictures_of(video)])
        late = frames["observation.state"] * 5 - shades
        assert late.min() >= -4, "no picture is of a step to come"
        fresh = frames[f"observation.age_ms.{camera}"] < 1000 / FPS
        assert np.abs(late[fresh]).max(initial=0) <= 5 + 4, "one that is young is of the newest step, or the one before"
        changed = np.abs(np.diff(shades)) > 2
        assert (frames[f"same.{camera}"][1:] == ~changed).all()


def test_picture_is_stored_or_counted_while_the_encoder_stands_still(encoder: CameraEncoder, tmp_path: Path) -> None:
    path, offered, slowest = tmp_path / "attempt-000000.mcap", 0, 0.0
    with encoder.attempt(path):
        assert encoder.pid is not None
        encoder.offer(TOP, picture(0))
        os.kill(encoder.pid, signal.SIGSTOP)
        for number in range(1, 30):
            began = time.perf_counter()
            encoder.offer(TOP, picture(number))
            slowest, offered = max(slowest, time.perf_counter() - began), number + 1
        assert encoder.dropped[TOP] > 15
        os.kill(encoder.pid, signal.SIGCONT)
        eventually(lambda: rows(path))
    assert slowest < 0.05
    assert encoder.failed == ""
    stored = int((encoded_videos(path, FPS)[TOP].rows["same"] == 0).sum())
    assert stored >= 1
    assert stored + encoder.dropped[TOP] == offered


RECORDER = """
import sys, threading, time
from pathlib import Path
import numpy as np
from strands_robots.datasets.encoder import CameraEncoder
from strands_robots.datasets.session import RecordingSession
from strands_robots.recording.file import Recorder

with RecordingSession(Path(sys.argv[1]), 50, "wave", "so100", print) as session, CameraEncoder(50) as encoder:
    with Recorder(session.recording) as recorder, encoder.attempt(session.recording):
        for number in range(100_000):
            recorder.take("arm-1", "streamStep", {"observation": {"pan": number}, "action": {"pan": number}})
            encoder.offer("top", np.full((48, 64, 3), number * 5 % 256, dtype=np.uint8))
            print(time.time(), flush=True)
            threading.Event().wait(0.02)
"""


def test_attempt_of_a_killed_recorder_is_an_episode_up_to_its_last_second(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", RECORDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    began = float(child.stdout.readline())
    while float(child.stdout.readline()) < began + 2:
        pass
    child.kill()
    said, _ = child.communicate()
    killed = float(said.split()[-1]) if said.split() else began + 2
    left: list[str] = []
    with session(tmp_path, left) as again:
        assert again.episodes == 1, left
    frames = tables.read_frames(tmp_path / data_file(0))
    assert len(frames["index"]) / FPS > killed - began - 1.1
    assert wrong(tmp_path) == []


def rows(recording: Path) -> bytes:
    path = cameras_folder(recording) / f"{TOP}.rows"
    return path.read_bytes() if path.exists() else b""


def test_killed_encoder_ends_the_attempt_by_name_and_the_next_one_is_whole(
    encoder: CameraEncoder, tmp_path: Path
) -> None:
    with session(tmp_path) as recording:
        with Recorder(recording.recording) as recorder, encoder.attempt(recording.recording):
            number = 0
            while encoder.failed == "":
                recorder.take("arm-1", "streamStep", {"observation": {"pan": number}, "action": {"pan": number}})
                encoder.offer(TOP, picture(number))
                if len(rows(recording.recording)) > ROW.itemsize * 20 and encoder.pid is not None:
                    os.kill(encoder.pid, signal.SIGKILL)
                number += 1
                threading.Event().wait(1 / FPS)
            assert encoder.failed == "the process that encodes the cameras has ended"
        kept = recording.keep(success=False)
        assert kept is not None
        assert kept[1] > 5
        lead(encoder, recording.recording, TOP)
        assert recording.keep(success=True) is not None
        assert encoder.failed == ""
    assert wrong(tmp_path) == []


def test_attempt_whose_video_was_cut_is_an_episode_up_to_there(encoder: CameraEncoder, tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        path = recording.recording
        lead(encoder, path, TOP)
    (cameras_folder(path) / f"{TOP}.json").unlink()
    video = cameras_folder(path) / f"{TOP}.mp4"
    encoded = len(rows(path)) // ROW.itemsize
    video.write_bytes(video.read_bytes()[: -video.stat().st_size // 8])
    said: list[str] = []
    with session(tmp_path, said) as again:
        assert again.episodes == 1, said
    assert 2 <= len(tables.read_frames(tmp_path / data_file(0))["index"]) < encoded
    assert wrong(tmp_path) == []


def test_attempt_without_a_camera_of_the_dataset_is_moved_aside(encoder: CameraEncoder, tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        lead(encoder, recording.recording, TOP, WRIST)
        recording.keep(success=True)
        lead(encoder, recording.recording, TOP)
        with pytest.raises(NoPictureError, match=r"has no picture of arm\.wrist: .* was moved to .*aside-000000\.mcap"):
            recording.keep(success=True)
    aside = tmp_path / ".running" / "aside-000000.mcap"
    with session(tmp_path) as again:
        assert again.episodes == 1
        assert aside.exists()
        assert (cameras_folder(aside) / f"{TOP}.mp4").exists()


def test_first_attempt_whose_camera_cannot_be_encoded_makes_no_dataset_without_it(
    encoder: CameraEncoder, tmp_path: Path
) -> None:
    with session(tmp_path) as recording:
        path = recording.recording
        with Recorder(path) as recorder, encoder.attempt(path):
            recorder.take("arm-1", "streamStep", {"observation": {"pan": 0}, "action": {"pan": 0}})
            encoder.offer(TOP, picture(0, width=63))
            eventually(lambda: encoder.failed)
        with pytest.raises(NoPictureError, match="has no picture of top"):
            recording.keep(success=True)
    assert not (tmp_path / "meta").exists()


def test_picture_that_cannot_be_encoded_is_told_by_its_camera(encoder: CameraEncoder, tmp_path: Path) -> None:
    with encoder.attempt(tmp_path / "attempt-000000.mcap"):
        encoder.offer(TOP, picture(0, width=63))
        eventually(lambda: encoder.failed == "camera top: width must be even, not 63: a video halves its colours.")
        with pytest.raises(ValidationError, match=r"pictures of top must be \(63, 48\) as its first"):
            encoder.offer(TOP, picture(0))
        with pytest.raises(ValidationError, match="must be height x width x 3 of uint8"):
            encoder.offer(WRIST, np.zeros((48, 64, 3)))  # type: ignore[arg-type]
    assert encoder.offer(TOP, picture(0)) is False, "no attempt runs"


def test_video_that_can_grow_no_more_ends_by_name_with_what_it_has(tmp_path: Path) -> None:
    path, dice = tmp_path / "attempt-000000.mcap", np.random.default_rng(1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Of the process of the encoder as well, which begins in it.
    resource.setrlimit(resource.RLIMIT_FSIZE, (120_000, before[1]))
    try:
        with CameraEncoder(FPS) as limited, limited.attempt(path):
            limited.offer(TOP, picture(0))
            beat = threading.Event()
            while not limited.failed:
                limited.offer(TOP, dice.integers(0, 255, (48, 64, 3), dtype=np.uint8))
                beat.wait(1 / FPS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert limited.failed.startswith("camera top: ")
    assert "cannot be written" in limited.failed
    pictures = len(encoded_videos(path, FPS)[TOP].rows)
    copy_pictures(cameras_folder(path) / f"{TOP}.mp4", tmp_path / "copy.mp4", 0, pictures, FPS)
    assert len(list(pictures_of(tmp_path / "copy.mp4"))) == pictures > 2


def test_jpeg_is_decoded_in_the_process(encoder: CameraEncoder, tmp_path: Path) -> None:
    file, path = io.BytesIO(), tmp_path / "attempt-000000.mcap"
    Image.fromarray(picture(20)).save(file, "JPEG")
    with encoder.attempt(path):
        encoder.offer(TOP, file.getvalue())
        eventually(lambda: len(rows(path)) > ROW.itemsize)
    video = encoded_videos(path, FPS)[TOP]
    assert (video.width, video.height) == (64, 48)
    assert next(pictures_of(video.path)).mean() == pytest.approx(100, abs=3)


def test_picture_that_is_early_or_late_is_still_that_of_its_moment(tmp_path: Path) -> None:
    path, beat, period = tmp_path / "attempt-000000.mcap", threading.Event(), 0.05
    with CameraEncoder(round(1 / period)) as slow, slow.attempt(path):
        # Whenever the first one comes: here shortly before the grid that began with the attempt.
        beat.wait(0.9 * period)
        began = time.time()
        for number in range(12):
            at = began + period * (number + (0.25 if number % 2 else 0))
            # It is there long before its time, however busy the machine is.
            beat.wait(max(0.0, at - 4 * period - time.time()))
            slow.offer(TOP, picture(number), at)
        beat.wait(max(0.0, at + period - time.time()))
    rows = encoded_videos(path, round(1 / period))[TOP].rows
    stored = len(np.unique(rows["at"]))
    assert stored >= 11, "the first one may come before the first group"
    assert np.flatnonzero(rows["same"]).tolist() == [*range(stored, len(rows))]
