"""Attempts of one robot, recorded into a dataset one after another.

The running attempt is a recording (MCAP) and the videos of its cameras inside the dataset's folder, whole to their last
second whenever the process ends. It becomes an episode when it is kept; one that a killed process left becomes one when
the next session begins.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Self

from strands_robots.datasets.encoded import cameras_folder, encoded_videos, offered_cameras
from strands_robots.datasets.episodes import RECORDING, RUNNING, Dataset, DatasetHold
from strands_robots.datasets.layout import CAMERAS, INFO, DatasetError, DatasetInfo, read_info
from strands_robots.datasets.recorded import IMAGES, Attempt, attempts_in, info_of, moments_of, save_attempt
from strands_robots.utils import ValidationError, text, whole

ATTEMPT, ASIDE = "attempt", "aside"
"""Names of a running attempt, and of one that is no episode and was moved aside."""


class NoPictureError(DatasetError):
    """An attempt that lacks the pictures of a camera; its recording was moved aside."""


class RecordingSession:
    """Session of recording into the dataset of a folder; entered as a context.

    Args:
        folder: has a dataset of the same robot, or is made.
        fps: frames a second.
        task: in words, of each attempt.
        robot_type: kind of the robot.
        tell: called with a sentence for each thing that the beginning mended.

    Raises:
        DatasetError: another process records into it, or it is a folder of others' files.
        ValidationError: a value outside its domain, or a dataset of another rate.

    Entering it raises as :meth:`keep` does, where the attempt that a killed process left cannot be written. One of
    another kind is moved aside.
    """

    def __init__(self, folder: Path, fps: int, task: str, robot_type: str, tell: Callable[[str], None]) -> None:
        self.folder, self._tell = folder, tell
        self._fps = whole("fps", fps, low=1, high=1000)
        self._task = text("task", task, longest=1000)
        self._robot_type = text("robot_type", robot_type, longest=100)
        self._dataset: Dataset | None = None
        self._hold = DatasetHold(folder)
        try:
            self._open()
        except BaseException:
            self._hold.close()
            raise

    def __enter__(self) -> Self:
        self._mend()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._dataset is not None:
            self._dataset.close()
        self._hold.close()

    @property
    def episodes(self) -> int:
        """Number of saved episodes, those of earlier sessions as well."""
        return 0 if self._dataset is None else self._dataset.info.episodes

    @property
    def recording(self) -> Path:
        """File to record the next attempt into; its folder is there."""
        return self._recording(self.episodes)

    def keep(self, *, success: bool) -> tuple[int, int] | None:
        """Save the recorded attempt as an episode.

        Returns:
            Its index, and the number of its frames; None for an attempt without a step, which is removed.

        Raises:
            NoPictureError: a camera of the dataset has no picture of it; its recording was moved aside.
            ValidationError: it is of another kind than the dataset; its recording is still there.
            DatasetError: it cannot be written; its recording is still there.
        """
        recording = self.recording
        attempts = attempts_in(recording, whole=True) if recording.exists() else []
        if not attempts:
            _remove(recording)
            return None
        attempt = max(attempts, key=lambda each: len(each.steps))
        attempt.videos = encoded_videos(recording, self._fps)
        if lacking := self._lacking(attempt, offered_cameras(recording)):
            aside = self._move_aside(recording)
            raise NoPictureError(f"the attempt has no picture of {lacking}: it is no episode, and was moved to {aside}")
        dataset = self._dataset_for(attempt)
        before = dataset.info.frames
        index = save_attempt(dataset, attempt, self._task, success=success)
        _remove(recording)
        return index, dataset.info.frames - before

    def discard(self) -> None:
        """Remove the recorded attempt."""
        _remove(self.recording)

    def _lacking(self, attempt: Attempt, offered: set[str]) -> str:
        """Return the cameras without a picture of an attempt; empty for none."""
        known = () if self._dataset is None else self._dataset.info.videos
        cameras = offered | {name.removeprefix(IMAGES) for name in known}
        lacking = [each for each in sorted(cameras) if each not in attempt.videos and not attempt.pictures.get(each)]
        return ", ".join(lacking) or ("" if len(moments_of(attempt, self._fps)) else "all cameras at one moment")

    def _move_aside(self, recording: Path) -> Path:
        number = 0
        while (aside := recording.with_name(f"{ASIDE}-{number:06d}{RECORDING}")).exists():
            number += 1
        if (videos := cameras_folder(recording)).is_dir():
            videos.replace(cameras_folder(aside))
        recording.replace(aside)
        return aside

    def _open(self) -> None:
        if not (self.folder / INFO).is_file():
            return
        if (fps := read_info(self.folder).fps) != self._fps:
            raise ValidationError(f"fps must be {fps}, as {self.folder} has it, not {self._fps}.")
        self._take(Dataset(self.folder, hold=self._hold))

    def _recording(self, episode: int) -> Path:
        running = self.folder / RUNNING
        running.mkdir(exist_ok=True)
        return running / f"{ATTEMPT}-{episode:06d}{RECORDING}"

    def _mend(self) -> None:
        """Make an episode of the attempt that a killed process left."""
        current = self.recording
        for left in sorted(current.parent.glob(f"{ATTEMPT}-*{RECORDING}")):
            if left != current:
                # Its episode was saved; the process was killed before it removed this.
                _remove(left)
                self._tell(f"{left.name} is of an episode that was saved, and is removed.")
        for videos in current.parent.glob(f"{ATTEMPT}-*{CAMERAS}"):
            if not videos.with_suffix(RECORDING).exists():
                shutil.rmtree(videos)
        if not current.exists():
            return
        try:
            kept = self.keep(success=False)
        except NoPictureError as lacking:
            self._tell(f"{lacking}.")
            return
        except ValidationError as unfit:
            # It would be in the way of every recording to come.
            aside = self._move_aside(current)
            self._tell(
                f"{str(unfit).rstrip('.')}: the attempt that was running is no episode, and was moved to {aside}."
            )
            return
        if kept is None:
            self._tell("The attempt that was running has no whole second, and is removed.")
        else:
            index, frames = kept
            self._tell(f"episode {index} is the attempt that was running, cut to its last second: {frames} frames.")

    def _dataset_for(self, attempt: Attempt) -> Dataset:
        """Return the dataset for an attempt, made by the first one.

        Raises:
            ValidationError: the attempt is of another kind.
        """
        info: DatasetInfo = info_of([attempt], self._fps, self._robot_type)
        if self._dataset is None:
            self._take(Dataset(self.folder, info, hold=self._hold))
        assert self._dataset is not None
        if differences := self._dataset.info.differences(info):
            raise ValidationError(f"{self.folder} has another kind of episodes: {'; '.join(differences)}.")
        return self._dataset

    def _take(self, dataset: Dataset) -> None:
        self._dataset = dataset
        for said in dataset.mended:
            self._tell(f"{said}.")


def _remove(recording: Path) -> None:
    """Remove a recording, and then the videos beside it: without it they are nothing."""
    recording.unlink(missing_ok=True)
    shutil.rmtree(cameras_folder(recording), ignore_errors=True)
