"""LeRobot's own ``lerobot-record`` on a served arm: its loop beside LeRobot's driver, and its kills.

Part of :mod:`benchmarks.takeover`. The commands run in the environment of ``make lerobot``.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fixtures.child import Child
from fixtures.command_line import Machine
from fixtures.feetech_bus import MOTORS, write_calibration
from fixtures.feetech_bus.process import BusProcess
from fixtures.installed import install
from fixtures.replayed_cameras import BITS, stamped
from fixtures.waiting import eventually, free_port

from benchmarks.dataset import HALT_MS, environment, percentile
from benchmarks.dataset_writers import JOINTS
from benchmarks.table import Row
from benchmarks.takeover_children import BEAT_S, PEER
from strands_robots.datasets.video import pictures_of

if TYPE_CHECKING:
    from benchmarks.takeover import Site

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".venv-policies" / "bin" / "python"
"""LeRobot 0.4.4 with torch and the two plug-ins: ``scripts/lerobot.sh``."""

PLUG_IN = "lerobot_camera_replayed"
DEVICES = Path(__file__).with_name("takeover_lerobot_devices.py")

FPS, WIDTH, HEIGHT = 30, 640, 480
CAMERAS = {name: {"type": "replayed", "width": WIDTH, "height": HEIGHT, "fps": FPS} for name in ("front", "wrist")}

WRITER: dict[str, Any] = {"streaming_encoding": True, "vcodec": "h264"}

RATE_HZ, LOOP_RATIO = 29.5, 1.3
"""The bounds."""

WITHIN_S = 240.0
SLOW = 0.05
"""Ranges a second: an arm that is still on its way when its command is killed."""

EPISODE_S = 1.0
"""Length of an episode of the commands that are killed: kills meet saves as well."""

SITES = 4
SETTLED_S = 0.12
"""After a kill: a write that came as late as this is still its last one."""

AWAY = 90.0
NOT_MEASURED = "not measured: make lerobot first"


@dataclass
class Loop:
    """The turns of one side.

    Attributes:
        beats: when each turn's loop read its leader, in monotonic seconds.
        ages: age of each picture when it was recorded, in seconds.
        dropped: pictures that LeRobot's encoder was too slow for.
    """

    beats: list[list[float]] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    dropped: int = 0

    def see(self, numbers: Sequence[int], moments: Sequence[float]) -> None:
        """Add a camera's recorded pictures, by their numbers, and the beats of the loop."""
        if len(numbers) == len(moments):
            self.ages += [age_s(number, moment) for number, moment in zip(numbers, moments, strict=True)]
        else:
            # Which beat each of the others belongs to is not known.
            self.dropped += len(moments) - len(numbers)

    @property
    def periods(self) -> list[float]:
        """Times between two beats, in ms."""
        return [1000 * (after - before) for turn in self.beats for before, after in itertools.pairwise(turn)]

    @property
    def rate(self) -> float:
        """Beats a second."""
        return 1000 / (sum(self.periods) / len(self.periods))


def beside_lerobot(turns: int, seconds: float) -> list[Row]:
    """Record the same emulated arm by LeRobot's own driver and served by us, in turns."""
    if not PYTHON.exists():
        return [Row("the loop of lerobot-record", NOT_MEASURED, "", None, "", ok=True)]
    ours, theirs = Loop(), Loop()
    with tempfile.TemporaryDirectory(prefix="bench-lerobot-") as folder:
        site = Recordings(Path(folder), seconds)
        for turn in range(2 * turns):
            # Theirs, ours, ours, theirs: neither has the better half of a turn.
            if turn % 4 in (0, 3):
                site.record_directly(theirs)
            else:
                site.record_served(ours)
    return [loop_row(ours, theirs, seconds)]


def loop_row(ours: Loop, theirs: Loop, seconds: float) -> Row:
    """Return the row of the loop, both sides of the same number of turns of so many ``seconds``."""
    mine, bare = percentile(ours.periods), percentile(theirs.periods)
    return Row(
        f"lerobot-record at {FPS} Hz of an emulated SO-101, two cameras of {WIDTH} x {HEIGHT} from memory, loopback, "
        f"{len(ours.beats)} x {seconds:g} s: rate, period of its loop, age of the recorded pictures",
        shown(ours),
        f"{shown(theirs)}, LeRobot 0.4.4's own driver",
        mine / bare,
        f"≥ {RATE_HZ:g} Hz; p99 ≤ {LOOP_RATIO:g} times",
        ours.rate >= RATE_HZ and mine <= LOOP_RATIO * bare,
    )


def shown(loop: Loop) -> str:
    """Return the figures of one side."""
    period = f"p50 {percentile(loop.periods, 0.5):.1f} p99 {percentile(loop.periods):.1f} ms"
    age = f"{1000 * percentile(loop.ages, 0.5):.0f}, p99 {1000 * percentile(loop.ages):.0f} ms old" if loop.ages else ""
    dropped = f", {loop.dropped} dropped by LeRobot's encoder" if loop.dropped else ""
    return f"{loop.rate:.2f} Hz; {period}; pictures {age}{dropped}"


class Recordings:
    """Recordings of one emulated arm, each by a command of its own.

    Args:
        folder: an empty one.
        seconds: length of an episode.
    """

    def __init__(self, folder: Path, seconds: float) -> None:
        self._folder, self._seconds = folder, seconds
        self._number = 0
        self._calibrations = folder / "calibrations"
        self._calibration = write_calibration(self._calibrations / "arm.json")
        self._environment = lerobot_environment(folder)

    def record_directly(self, loop: Loop) -> None:
        """Record by LeRobot's own driver."""
        with self._arm() as port:
            here = {"type": "so101_follower", "port": port, "id": "arm", "calibration_dir": str(self._calibrations)}
            self._record(loop, [*options("robot", here), f"--robot.cameras={json.dumps(CAMERAS)}"])

    def record_served(self, loop: Loop) -> None:
        """Record it while another process serves it."""
        machine = Machine(self._folder / f"state-{self._number}", **self._environment)
        with self._arm() as port, served_arm(machine, port, self._calibration):
            there = {"type": "strands", "peer_id": PEER}
            self._record(loop, options("robot", there), machine.environment)

    @contextmanager
    def _arm(self) -> Iterator[str]:
        with BusProcess(self._folder / "arm") as bus:
            yield bus.port

    def _record(self, loop: Loop, robot: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self._number += 1
        beats, root = self._folder / f"beats-{self._number}", self._folder / f"set-{self._number}"
        hand = {"type": "hand", "joints": [f"{motor}.pos" for motor in MOTORS], "middle": 20, "reach": 15}
        line = [*robot, *options("teleop", {**hand, "file": str(beats)}), *dataset(root, self._seconds, 1)]
        done = subprocess.run(
            [str(PYTHON.with_name("lerobot-record")), *line],
            env={**os.environ, **self._environment} if environment is None else environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=WITHIN_S,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"lerobot-record failed: {(done.stdout + done.stderr)[-2000:]}")
        moments = [float(each) for each in beats.read_text().splitlines()]
        loop.beats.append(moments)
        for video in sorted(root.glob("videos/**/*.mp4")):
            loop.see([stamped(picture) for picture in pictures_of(video)], moments)


def age_s(number: int, moment: float) -> float:
    """Return how long before a moment the picture of a number became the newest, in seconds."""
    span = 2**BITS / FPS
    return (moment - number / FPS) % span


def options(of: str, given: Mapping[str, Any]) -> list[str]:
    """Return options of a LeRobot command."""
    return [f"--{of}.{name}={value if isinstance(value, str) else json.dumps(value)}" for name, value in given.items()]


def dataset(root: Path, seconds: float, episodes: int) -> list[str]:
    """Return the options of ``lerobot-record`` that name its dataset."""
    about = {"repo_id": "bench/set", "root": str(root), "fps": FPS, "single_task": "sweep", "num_episodes": episodes}
    times = {"episode_time_s": seconds, "reset_time_s": 0, "push_to_hub": False}
    return [*options("dataset", {**about, **times, **WRITER}), "--play_sounds=false"]


def lerobot_environment(folder: Path) -> dict[str, str]:
    """Install the plug-in of this benchmark into a folder; return what LeRobot's commands then need."""
    # What is installed begins with a line of its own.
    source = DEVICES.read_text("utf-8").replace("from __future__ import annotations\n", "")
    install(folder / "installed", PLUG_IN, source, {})
    plug_ins = sorted(str(each) for each in (ROOT / "plugins").glob("*/src"))
    path = os.pathsep.join((str(folder / "installed"), *plug_ins, environment()["PYTHONPATH"]))
    return {"PYTHONPATH": path, "HF_HUB_OFFLINE": "1", "HF_LEROBOT_HOME": str(folder / "home")}


@contextmanager
def served_arm(machine: Machine, port: str, calibration: Path) -> Iterator[None]:
    """Serve an arm at a port, from the environment that has LeRobot."""
    file = calibration.parent.parent / "served.json"
    file.write_text(
        json.dumps({"calibration": str(calibration), "calibration_dir": str(file.parent), "cameras": CAMERAS})
    )
    line = ["serve", "so101", "--peer-id", PEER, "--port", port, "--config", str(file), "--rpc-allow", "*", "--json"]
    with subprocess.Popen(
        [str(PYTHON), "-m", "strands_robots.cli", *line, "--command-allow", "acquireControl,lead"],
        env=machine.environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as served:
        try:
            assert served.stdout is not None
            assert "serving" in served.stdout.readline()
            yield
        finally:
            served.terminate()


def kills_ms(sites: Sequence[Site], kills: int) -> list[float]:
    """Kill recordings of served robots at random moments; return the ms from each kill to the last motion.

    The robots take turns: each is free again when the lease of the command that was killed is over.
    """
    moments, late = random.Random(7), list[float]()
    with tempfile.TemporaryDirectory(prefix="bench-killed-") as given:
        folder = Path(given)
        with Child(
            "benchmarks.takeover_lerobot_children", {}, lerobot_environment(folder), forked=False, python=str(PYTHON)
        ) as recorders:
            for number in itertools.count():
                if len(late) == kills:
                    break
                there = sites[number % len(sites)]
                record(recorders, there, folder, number, AWAY if number // len(sites) % 2 else -AWAY)
                time.sleep(moments.uniform(0.0, 1.5))
                at = recorders.ask("kill")
                time.sleep(HALT_MS / 1000 + SETTLED_S)
                moved = there.robot.ask("writes")[1]
                if at and moved > at - 2 * BEAT_S:
                    # Else a busy machine had it held before.
                    late.append(max(0.0, 1000 * (moved - at)))
                there.robot.ask("halt")
                there.robot.ask("clear")
    return late


def record(recorders: Child, there: Site, folder: Path, number: int, away: float) -> None:
    """Record a robot that is led slowly to one side; return once it moves."""
    eventually(lambda: not there.robot.ask("held"), 20, "the lease", every=0.1)
    robot = {"type": "strands", "peer_id": PEER, "camera_names": [], "max_speed": SLOW}
    hand = {"type": "hand", "joints": list(JOINTS), "middle": away, "reach": 0}
    line = [*options("robot", robot), *options("teleop", hand), *dataset(folder / f"set-{number}", EPISODE_S, 1000)]
    ports = {"STRANDS_DC_PORT": str(there.port), "STRANDS_MESH_PORT": str(free_port())}
    state = {"STRANDS_STATE_DIR": str(folder / "state")}
    said, began = folder / "said.txt", time.monotonic()
    recorders.ask("record", line, str(said), {**ports, **state})
    try:
        eventually(lambda: there.robot.ask("writes")[1] > began, 60, "its motion", every=0.05)
    except AssertionError as failed:
        failed.add_note(said.read_text()[-2000:])
        raise
