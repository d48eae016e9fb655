"""The same small ACT trained on our recording over the network and on LeRobot's own: successes on common seeds.

It takes half an hour, most of it for the recordings in real time, so it is measured only when it is
asked for by its name.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence

from benchmarks.dataset import PYTHON, ROOT, environment
from benchmarks.table import Row

RECORDINGS, STEPS, SEEDS = 100, 2500, 200
QUICK = (2, 20, 4)
LEAST = -0.10
Z95 = 1.959964


def run(*, quick: bool = False) -> list[Row]:
    """Measure and return the one row of this part."""
    if not PYTHON.exists():
        return [Row("ACT on our recording", "not measured: make lerobot-next first", "", None, "", ok=True)]
    sizes = QUICK if quick else (RECORDINGS, STEPS, SEEDS)
    with tempfile.TemporaryDirectory(prefix="bench-train-") as folder:
        done = subprocess.run(
            [str(PYTHON), "-m", "benchmarks.dataset_training", folder, *map(str, sizes)],
            cwd=ROOT,
            env=environment() | {"STRANDS_STATE_DIR": folder},
            stdout=subprocess.PIPE,
            stderr=sys.stderr,
            text=True,
            check=True,
        )
    found = json.loads(done.stdout.splitlines()[-1])
    return [train_row(found["ours"], found["theirs"], *sizes[:2])]


def train_row(ours: Sequence[bool], theirs: Sequence[bool], recordings: int, steps: int) -> Row:
    """Return the row of both policies on the same seeds."""
    difference, low, high = paired_interval(ours, theirs)
    return Row(
        f"push_cube, ACT of {steps} steps on {recordings} episodes of the expert, {len(ours)} common seeds: successes",
        f"{sum(ours)}, recorded over the network",
        f"{sum(theirs)}, recorded by LeRobot's own writer in a loop beside the arm",
        None,
        f"95 % interval of the difference above {100 * LEAST:.0f} points: here {100 * difference:+.1f}, "
        f"{100 * low:+.1f} to {100 * high:+.1f}; LeRobot's in half of the episodes",
        low > LEAST and 2 * sum(theirs) >= len(theirs),
    )


def paired_interval(ours: Sequence[bool], theirs: Sequence[bool]) -> tuple[float, float, float]:
    """Return the mean of the differences by seed, and its 95 % interval by the normal distribution."""
    differences = [int(mine) - int(other) for mine, other in zip(ours, theirs, strict=True)]
    count, mean = len(differences), sum(differences) / len(differences)
    variance = sum((each - mean) ** 2 for each in differences) / max(1, count - 1)
    half = Z95 * math.sqrt(variance / count)
    return mean, mean - half, mean + half
