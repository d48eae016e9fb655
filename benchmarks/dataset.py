"""Recording of datasets: kills, the control beat, LeRobot's own writer, and stops.

``python -m benchmarks.dataset --rows kills,beat --kills 10 --seconds 10`` measures a part of it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fixtures.child import Child
from fixtures.killed_recorders import Kill, Target, killed_in_turn, killed_while_saving
from rich.console import Console

from benchmarks.dataset_children import FPS, HZ
from benchmarks.dataset_stops import stops_ms
from benchmarks.dataset_writers import SAVED
from benchmarks.safety import Hiccups
from benchmarks.table import Row

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".venv-policies-0.6.1" / "bin" / "python"
"""LeRobot with torch: ``scripts/lerobot.sh 0.6.1``."""

LEROBOT_EPISODE_S = 0.5
"""Length of the episodes that LeRobot's writer saves before it is killed."""

ARMS = 8
CAMERAS = (("2 cameras", (2, *[0] * (ARMS - 1)), True), ("2 cameras of each arm", (2,) * ARMS, False))
"""Name, number by arm, and whether the bound is of it: sixteen cameras show where it ends."""

TURN_S = 7.5
"""Length of an episode, and of a turn without a recording: what else the machine does meets both."""

TARGETS: tuple[Target, ...] = ("recorder", "encoder", "robot")
SAVING_SHARE = 4
"""One kill of so many is of a process that saves all the time, so that kills meet each moment of a save."""

CUT_S, HALT_MS, BEAT_MS, STORED, DEFAULT, STREAMING, STOP_MS = 1.0, 300.0, 1.0, 0.95, 0.6, 1.1, 20.0
"""The bounds."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much is measured."""

    kills: int = 100
    seconds: float = 120.0
    """Of recording beside the control beat."""

    written: float = 20.0
    """Length of an episode of each writer."""

    turns: int = 3
    stops: int = 200


QUICK = Sizes(kills=8, seconds=12.0, written=6.0, turns=1, stops=20)


def run(*, quick: bool = False, sizes: Sizes | None = None, rows: Sequence[str] = ()) -> list[Row]:
    """Measure and return the rows of this part, or those that are named."""
    size = sizes or (QUICK if quick else Sizes())
    parts: dict[str, Callable[[Sizes], list[Row]]] = {
        "kills": killed,
        "beat": beside_the_beat,
        "writers": beside_lerobot,
        "stops": stopped,
    }
    with Hiccups() as machine:
        found = [row for name, measure in parts.items() if not rows or name in rows for row in measure(size)]
    return [*found, machine.row()]


def killed(size: Sizes) -> list[Row]:
    """Kill recorders, their encoders and robots at random moments."""
    saving = size.kills // SAVING_SHARE
    with tempfile.TemporaryDirectory(prefix="bench-kills-") as folder:
        killed_while_saving(Path(folder) / "saving", saving)
        kills, lost = killed_in_turn(Path(folder), size.kills - saving, TARGETS)
    return [kills_row(kills, saving, lost, lost_by_lerobot())]


def kills_row(kills: Sequence[Kill], saving: int, lost: Sequence[str], lerobots: int | None) -> Row:
    """Return the row of kills; ``saving`` more met a process that saves all the time, and lost nothing.

    ``lerobots`` are the episodes that LeRobot's own writer lost by one kill; None where it is not installed.
    """
    counts = Counter(kill.target for kill in kills)
    cuts = {
        target: [kill.cut_s for kill in kills if kill.target == target and kill.cut_s is not None] for target in TARGETS
    }
    running = sum(len(each) for each in cuts.values())
    halts = [1000 * kill.halt_s for kill in kills if kill.halt_s is not None]
    worst = max((max(each, default=0.0) for each in cuts.values()), default=0.0)
    each = ", ".join(f"{max(cuts[target], default=0.0):.2f}" for target in TARGETS)
    of = ", ".join(f"{counts[target]} of the {target}" for target in TARGETS)
    return Row(
        f"SIGKILL at {len(kills) + saving} random moments: {of}, {saving} of a process that saves all the time",
        f"{len(lost)} saved episodes lost; {running} running ones, cut by at most {each} s; the arms of {len(halts)} "
        f"recorders that led one moved for at most {max(halts, default=0.0):.0f} ms more",
        "" if lerobots is None else f"{lerobots} of {SAVED} saved episodes lost by one kill of LeRobot 0.6.1's writer",
        None,
        f"0 lost, the running one cut by at most {CUT_S:g} s, each part killed, arms still after {HALT_MS:g} ms",
        not lost
        and worst <= CUT_S
        and all(counts[target] for target in TARGETS)
        and max(halts, default=0.0) <= HALT_MS,
    )


def beside_the_beat(size: Sizes) -> list[Row]:
    """Record simulated arms, and hold their beat against that without a recording."""
    rows = list[Row]()
    for what, cameras, bound in CAMERAS:
        about = f"{ARMS} simulated arms at {HZ:g} Hz, {what} of 320 x 240 at {FPS} Hz, {size.seconds:g} s"
        try:
            row = beat_of(about, cameras, size.seconds)
        except RuntimeError as failed:
            # On a machine that is too busy an arm's leader may be silent for too long, which ends its attempt.
            row = Row(about, f"an attempt failed: {failed}", "", None, "no attempt fails", ok=False)
        rows.append(row if bound else replace(row, must="", ok=True))
    return rows


def beat_of(about: str, cameras: Sequence[int], span: float) -> Row:
    """Measure one number of cameras."""
    order: dict[str, Any] = {"cameras": cameras}
    free, recorded, came, cores = list[float](), list[float](), 0, list[float]()
    turns = max(1, round(span / TURN_S / 2))
    seconds = span / turns / 2
    with (
        tempfile.TemporaryDirectory(prefix="bench-beat-") as folder,
        Child("benchmarks.dataset_children", order | {"folder": folder}, forked=False) as arms,
    ):
        for _ in range(turns):
            # Free, recorded, recorded, free: neither has the better half of a turn.
            free += arms.ask("lead", seconds)
            for _ in range(2):
                turn = arms.ask("record", seconds)
                recorded += turn["periods"]
                came += turn["came"]
                cores.append(turn["cores"])
            free += arms.ask("lead", seconds)
        stored = arms.ask("stored")
    return beat_row(about, free, recorded, came, stored, sum(cores) / len(cores))


def beat_row(
    about: str, free: Sequence[float], recorded: Sequence[float], came: int, stored: Mapping[str, int], cores: float
) -> Row:
    """Return the row of the beat, with and without a recording, and of the pictures."""
    mine, bare = (percentile(each) for each in (recorded, free))
    share = stored["different"] / came
    counted = stored["frames"] == stored["different"] + stored["same"]
    return Row(
        f"{about}: p99 of the control beat; pictures stored",
        f"{mine:.2f} ms; {stored['different']} of {came} pictures ({share:.1%}), {stored['same']} frames marked as the "
        f"same; {cores:.1f} cores",
        f"{bare:.2f} ms without a recording",
        mine / bare,
        f"at most {BEAT_MS:g} ms more; {STORED:.0%} stored, the rest marked",
        mine <= bare + BEAT_MS and share >= STORED and counted,
    )


def beside_lerobot(size: Sizes) -> list[Row]:
    """Write the same episode by ours and by LeRobot's own writer, in turns."""
    if not PYTHON.exists():
        return [Row("CPU of a frame", "not measured: make lerobot-next first", "", None, "", ok=True)]
    spent: dict[str, list[float]] = {"ours": [], "default": [], "streaming": []}
    for turn in range(size.turns):
        for kind in sorted(spent, reverse=turn % 2 == 1):
            spent[kind].append(frame_ms(kind, size.written))
    return writer_rows(spent, size.written)


def frame_ms(kind: str, seconds: float) -> float:
    """Return the CPU of a frame, in ms."""
    with tempfile.TemporaryDirectory(prefix="bench-write-") as folder, writer(kind, seconds, folder) as child:
        figures = json.loads(child.communicate()[0].splitlines()[-1])
    return 1000 * float(figures["cpu"]) / float(figures["frames"])


def lost_by_lerobot() -> int | None:
    """Kill LeRobot's own writer after it saved some episodes; return how many it then does not read."""
    if not PYTHON.exists():
        return None
    with tempfile.TemporaryDirectory(prefix="bench-lerobot-") as folder:
        with writer("saved", LEROBOT_EPISODE_S, folder) as child:
            assert child.stdout is not None
            saved = int(json.loads(child.stdout.readline())["saved"])
            child.kill()
        with writer("read", 0, folder) as child:
            return saved - int(json.loads(child.communicate()[0].splitlines()[-1])["episodes"])


def writer(kind: str, seconds: float, folder: str) -> subprocess.Popen[str]:
    """Start a writer in the environment that has LeRobot."""
    return subprocess.Popen(
        [str(PYTHON), "-m", "benchmarks.dataset_writers", kind, str(seconds), folder],
        cwd=ROOT,
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def environment() -> dict[str, str]:
    """Return the environment of a process of LeRobot's interpreter, which takes this project from here."""
    path = os.pathsep.join((str(ROOT / "src"), str(ROOT)))
    return {**os.environ, "PYTHONPATH": path, "HF_HUB_OFFLINE": "1"}


def writer_rows(spent: Mapping[str, Sequence[float]], seconds: float) -> list[Row]:
    """Return the rows of ours beside LeRobot's default and its streaming encoding, by medians."""
    middle = {kind: sorted(each)[len(each) // 2] for kind, each in spent.items()}
    rows = []
    for kind, bound in (("default", DEFAULT), ("streaming", STREAMING)):
        ratio = middle["ours"] / middle[kind]
        rows.append(
            Row(
                f"CPU of a frame of two cameras, H.264, an episode of {seconds:g} s, median of {len(spent[kind])}",
                f"{middle['ours']:.1f} ms",
                f"{middle[kind]:.1f} ms, LeRobot 0.6.1's {kind} encoding",
                ratio,
                f"≤ {bound:g}",
                ratio <= bound,
            )
        )
    return rows


def stopped(size: Sizes) -> list[Row]:
    """Stop an arm in motion, recorded and not."""
    recorded, stored = stops_ms(size.stops, recorded=True)
    free, _ = stops_ms(size.stops, recorded=False)
    return [stops_row(recorded, free, stored)]


def stops_row(recorded: Sequence[float], free: Sequence[float], stored: Mapping[str, int]) -> Row:
    """Return the row of stops; ``stored`` proves that it was recorded meanwhile."""
    p50, p99 = (percentile(recorded, share) for share in (0.5, 0.99))
    bare = percentile(free)
    return Row(
        f"Stop while recording with two cameras, press to last write, {len(recorded)} times",
        f"p50 {p50:.1f} p99 {p99:.1f} ms, worst {max(recorded):.1f} ms; {stored['frames']} frames recorded",
        f"p50 {percentile(free, 0.5):.1f} p99 {bare:.1f} ms without a recording",
        None,
        f"p99 ≤ {STOP_MS:g} ms",
        p99 <= STOP_MS and stored["frames"] > 0,
    )


def percentile(values: Sequence[float], share: float = 0.99) -> float:
    """Return the value that this share of them keeps."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def main() -> int:
    """Measure the rows that are named and print them."""
    from benchmarks.__main__ import shown  # noqa: PLC0415 - of this command alone

    usual = Sizes()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dataset", description=__doc__)
    parser.add_argument("--rows", default="", help="kills, beat, writers, stops, with commas (all)")
    for name in ("kills", "turns", "stops"):
        parser.add_argument(f"--{name}", type=int, default=getattr(usual, name))
    for name in ("seconds", "written"):
        parser.add_argument(f"--{name}", type=float, default=getattr(usual, name))
    options = vars(parser.parse_args())
    named = [each for each in options.pop("rows").split(",") if each]
    rows = run(sizes=Sizes(**options), rows=named)
    Console().print(shown("Recording of datasets", rows))
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
