"""A recording that is being made: beside what is served or led, and its summary at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from strands_robots.cli.output import Failure, Screen, table
from strands_robots.recording import Recorder, RobotRecording
from strands_robots.recording.cameras import chosen_frames

NO_CAMERAS = "none"


@contextmanager
def recorded(screen: Screen, robot: Any, device: str, file: Path | None, cameras: str | None = None) -> Iterator[None]:
    """Record ``robot`` while the block runs, halts and locks included; nothing without a ``file``.

    Args:
        screen: where the summary is told.
        robot: what is served or led here.
        device: what it is called in the recording.
        file: a new ``.mcap`` file.
        cameras: names with commas between them, ``none``, or None for those of the robot itself.

    Raises:
        Failure: something was lost.
        ValidationError: the file, or a camera, is refused.
    """
    if file is None:
        yield
        return
    names = None if cameras is None else [name for name in cameras.split(",") if name]
    frames = None if names == [NO_CAMERAS] else chosen_frames(robot, names)
    recorder = Recorder(file, joints_of_events=False)
    sampling = RobotRecording(robot, recorder, device, frames=frames)
    with ExitStack() as stack:
        # Told last, and where the block is left by Ctrl-C as well.
        stack.callback(lambda: told(screen, recorder))
        stack.enter_context(recorder)
        stack.enter_context(sampling)
        screen.say(f"Recording {device} into {file}.")
        yield
    lossless(recorder)


def told(screen: Screen, recorder: Recorder) -> None:
    """Tell what a finished recording holds."""
    if not recorder.path.exists():
        return
    counts = dict(recorder.counts)
    screen.data({"event": "recorded", "file": str(recorder.path), "messages": counts, "lost": recorder.lost})
    screen.show(table(f"{recorder.path}, {_size(recorder.path)}", ("channel", "messages"), sorted(counts.items())))


def lossless(recorder: Recorder) -> None:
    """Raises :class:`Failure` where something was lost."""
    if recorder.lost:
        raise Failure(f"{recorder.lost} messages were lost: the disk was too slow.")


def _size(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
