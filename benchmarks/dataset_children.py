"""Robots that are led and recorded in a process of their own, for :mod:`benchmarks.dataset`.

``python -m benchmarks.dataset_children ORDER``: ``cameras`` (how many of each simulated arm), ``folder``.
"""

from __future__ import annotations

import io
import json
import logging
import math
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from fixtures.child import serve
from fixtures.replayed_cameras import ReplayedCameras, stamped
from rich.console import Console

from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.cli.leading import LEADER, TeleopOptions, begin
from strands_robots.cli.led_robot import LedRobot
from strands_robots.cli.local_recording import Driver, LocalAttempts
from strands_robots.cli.output import Screen
from strands_robots.contract import RolloutEvent
from strands_robots.datasets import tables
from strands_robots.datasets.layout import data_file, read_info, video_file
from strands_robots.datasets.recorded import IMAGES, LED_BY_PERSON, SAME
from strands_robots.datasets.session import RecordingSession
from strands_robots.datasets.video import pictures_of
from strands_robots.recording.cameras import Frames

FPS = 30
HZ = 50.0
TASK = "sweep"


class SweepingLeader:
    """Leader that sweeps each joint about the middle of a part of its range."""

    def __init__(self, bounds: Mapping[str, tuple[float, float]], phase: float = 0.0) -> None:
        self.keys = list(bounds)
        self._bounds, self._phase = bounds, phase

    def get_action(self) -> dict[str, float]:
        """Return where it is now."""
        share = 0.5 + 0.1 * math.sin(time.monotonic() + self._phase)
        return {key: low + share * (high - low) for key, (low, high) in self._bounds.items()}


class RecordedArm:
    """A robot that is led here, and recorded by the product's own loop for attempts.

    Args:
        robot: of this process.
        folder: of its dataset.
        hz: rate at which it is led.
        phase: of its leader.
    """

    def __init__(self, robot: Any, folder: Path, hz: float = HZ, phase: float = 0.0) -> None:
        self.robot, self.folder, self._hz = robot, folder, hz
        self.screen = Screen(console=Console(file=io.StringIO()))
        self.led = LedRobot(robot)
        self.steps: list[float] = []
        self._leader = SweepingLeader(robot.body().bounds, phase)
        # Before the recording's own observer, whose work is a part of the beat.
        robot.subscribe(self._note)

    def _note(self, event: RolloutEvent) -> None:
        if event.kind == "step":
            self.steps.append(time.monotonic())

    def lead(self) -> Any:
        """Begin to lead it, and return the task."""
        self.steps.clear()
        options = TeleopOptions(hz=self._hz)
        begin(self.screen, self.led, "bench", self._leader, options, publish=False)
        return self.robot.tasks.by_leader[LEADER]

    def lead_for(self, seconds: float) -> list[float]:
        """Lead it without a recording; return the periods of its beats in ms."""
        self.lead()
        time.sleep(seconds)
        self.robot.halt("bench")
        return self.periods()

    def record_for(self, seconds: float, frames: Frames | None, begun: Callable[[], object] = lambda: None) -> None:
        """Record one attempt as an episode."""

        def lead() -> Any:
            begun()
            return self.lead()

        with RecordingSession(self.folder, FPS, TASK, "so100", lambda said: None) as session:
            attempts = Attempts(1, lead, FPS, seconds, 0.0, success=True)
            record_attempts(self.screen, self.attempts(frames, lead), session, attempts)

    def attempts(self, frames: Frames | None, begin: Callable[[], Any]) -> LocalAttempts:
        """Return it as the product's loop for attempts takes it."""
        return LocalAttempts(self.led, frames, Driver(begin, ExitStack(), LED_BY_PERSON))

    def periods(self) -> list[float]:
        """Return the times between its beats, in ms."""
        return [1000 * (after - before) for before, after in pairwise(list(self.steps))]


def each_at_once(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Return what each call returns, each on a thread of its own; raise what one of them raises."""
    results: dict[int, Any] = {}
    failures: list[BaseException] = []

    def run(number: int) -> None:
        try:
            results[number] = calls[number]()
        except BaseException as failure:  # noqa: BLE001 - raised below
            failures.append(failure)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return [results[number] for number in range(len(calls))]


class ArmsOfOneProcess:
    """Simulated arms, each with a dataset of its own and cameras that are replayed."""

    def __init__(self, order: Mapping[str, Any], cameras: ReplayedCameras) -> None:
        from strands_robots.robot import Robot  # noqa: PLC0415 - heavy

        folder, self._cameras = Path(order["folder"]), cameras
        robots: list[Any] = [Robot("so100", mode="sim", mesh=False) for _ in order["cameras"]]
        self._arms = [RecordedArm(robot, folder / f"arm-{n}", phase=n) for n, robot in enumerate(robots)]
        self._per_arm = camera_names(order["cameras"])

    def lead(self, seconds: float) -> list[float]:
        """Lead them without a recording; return the periods of all beats in ms."""
        rows = each_at_once([partial(arm.lead_for, seconds) for arm in self._arms])
        return [each for row in rows for each in row]

    def record(self, seconds: float) -> dict[str, Any]:
        """Record one episode of each; return the periods, the number of pictures that came, and the cores in use."""
        # What is set up for one arm takes no beat of another.
        together = threading.Barrier(len(self._arms), timeout=60)
        cpu, began = cpu_seconds(self._cameras.pid), time.monotonic()

        def record(number: int) -> tuple[list[float], int]:
            arm, names = self._arms[number], self._per_arm[number]
            arm.record_for(seconds, (lambda: self._cameras.frames(*names)) if names else None, together.wait)
            # An episode is as long as its steps.
            return arm.periods(), len(names) * (int((arm.steps[-1] - arm.steps[0]) * FPS) + 1)

        rows = each_at_once([partial(record, number) for number in range(len(self._arms))])
        cores = (cpu_seconds(self._cameras.pid) - cpu) / (time.monotonic() - began)
        return {
            "periods": [each for row, _ in rows for each in row],
            "came": sum(came for _, came in rows),
            "cores": cores,
        }

    def stored(self) -> dict[str, int]:
        """Return how many frames the episodes have, their different pictures, and the frames marked as the same."""
        return totals([stored_pictures(arm.folder) for arm in self._arms])

    def close(self) -> None:
        """End the robots."""
        for arm in self._arms:
            arm.robot.cleanup()


def camera_names(counts: Sequence[int]) -> list[list[str]]:
    """Return the names of each arm's cameras."""
    return [[f"arm{arm}_{number}" for number in range(count)] for arm, count in enumerate(counts)]


def totals(rows: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Return the sums of rows by name."""
    return {name: sum(row[name] for row in rows) for name in rows[0]} if rows else {}


def stored_pictures(folder: Path) -> dict[str, int]:
    """Return the frames of all videos of a dataset, their different pictures, and the frames marked as the same."""
    info, found = read_info(folder), {"frames": 0, "different": 0, "same": 0}
    for episode in range(info.episodes):
        columns = tables.read_frames(folder / data_file(episode))
        for name in info.videos:
            numbers = [stamped(picture) for picture in pictures_of(folder / video_file(name, episode))]
            found["frames"] += len(numbers)
            found["different"] += len(set(numbers))
            found["same"] += int(np.sum(columns[f"{SAME}{name.removeprefix(IMAGES)}"]))
    return found


def cpu_seconds(*others: int) -> float:
    """Return the CPU of this process and of all its children, of those that ended too, but for ``others``."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    living = [each for each in psutil.Process().children(recursive=True) if each.pid not in others]
    return time.process_time() + ended.ru_utime + ended.ru_stime + sum(_cpu_of(each) for each in living)


def _cpu_of(process: psutil.Process) -> float:
    try:
        times = process.cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(times.user + times.system)


@contextmanager
def arms_of(order: Mapping[str, Any]) -> Iterator[ArmsOfOneProcess]:
    """Yield the arms of an order."""
    with ReplayedCameras([name for names in camera_names(order["cameras"]) for name in names], FPS) as cameras:
        arms = ArmsOfOneProcess(order, cameras)
        try:
            yield arms
        finally:
            arms.close()


def main() -> None:
    """Obey until standard input closes."""
    logging.disable(logging.ERROR)
    with arms_of(json.loads(sys.argv[1])) as arms:
        serve({"lead": arms.lead, "record": arms.record, "stored": arms.stored})


if __name__ == "__main__":
    main()
