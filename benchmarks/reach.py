"""Reach: inverse kinematics of the built-in arms."""

from __future__ import annotations

import time

import mujoco
import numpy as np

from benchmarks.table import Row
from strands_robots.kinematics.chain import Chain, TipPose, built_in
from strands_robots.kinematics.inverse import TipGoal, solve

TARGETS = 500
SOLVED = {"so100": 99.5, "so101": 98.0}
"""Percent of reachable targets that must be solved."""

P95_MS = 15.0


def run(*, quick: bool = False) -> list[Row]:
    """Measure every row of this part."""
    return [inverse(arm, 100 if quick else TARGETS) for arm in SOLVED]


def inverse(arm: str, count: int) -> Row:
    """Solve reachable poses of the tip from the arm's home."""
    chain = built_in(arm)
    times, errors = [], []
    for pose in reachable(chain, count):
        began = time.perf_counter()
        solution = solve(chain, TipGoal(pose.position, pose.approach), chain.rest)
        times.append(1000 * (time.perf_counter() - began))
        if solution is not None:
            errors.append(np.linalg.norm(chain.forward(solution.joints).position - pose.position))
    solved, p95 = 100 * len(errors) / count, float(np.percentile(times, 95))
    return Row(
        f"Inverse kinematics of the {arm.upper()}, {count} reachable poses of the tip: solved within 1 mm and 1 degree",
        f"{solved:.1f} %, {np.median(times):.1f} ms (p95 {p95:.1f} ms), worst error {1000 * max(errors):.2f} mm",
        "",
        None,
        f">= {SOLVED[arm]:g} %, p95 <= {P95_MS:g} ms",
        solved >= SOLVED[arm] and p95 <= P95_MS,
    )


def reachable(chain: Chain, count: int) -> list[TipPose]:
    """Return poses of random joints without contact, the tip above 10 mm."""
    draw = np.random.default_rng(7)
    poses: list[TipPose] = []
    while len(poses) < count:
        data = chain.data(chain.lows + (chain.highs - chain.lows) * draw.random(len(chain.joints)))
        mujoco.mj_collision(chain.model, data)
        pose = chain.tip(data)
        if pose.position[2] > 0.01 and not data.ncon:
            poses.append(pose)
    return poses
