"""Reach: inverse kinematics of the built-in arms, and cubes picked up and put down."""

from __future__ import annotations

import time

import numpy as np
from fixtures.reach_targets import reachable
from numpy.typing import NDArray

from benchmarks import reach_network
from benchmarks.table import Row
from strands_robots.kinematics import moves
from strands_robots.kinematics.chain import built_in
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start
from strands_robots.kinematics.objects import Held, SeenObject
from strands_robots.kinematics.planner import TipGoal, solve
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError

TARGETS = 500
SOLVED = {"so100": 99.5, "so101": 98.0}
"""Percent of reachable targets that must be solved."""

P95_MS = 15.0

SHOULDER_M = 0.0452
"""Distance of the pan axis from the base."""

NEAR_M, STANDING_M = 0.015, 0.003
HZ, STEPS = 50.0, 10
"""Control rate, and the physics steps of one control step."""


def run(*, quick: bool = False) -> list[Row]:
    """Measure every row of this part."""
    cubes, tries = (10, 20) if quick else (100, 200)
    return [
        *(inverse(arm, 100 if quick else TARGETS) for arm in SOLVED),
        grasping("so100", cubes, 0.0, 97.0),
        grasping("so100", cubes, 0.003, 95.0),
        grasping("so101", cubes, 0.0, 95.0),
        holding(tries),
        *reach_network.rows(quick=quick),
    ]


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


def grasping(arm: str, count: int, error_m: float, must: float) -> Row:
    """Pick up cubes of 2 to 3 cm at random places and put them down elsewhere."""
    draw = np.random.default_rng(3)
    good, misses = 0, []
    for _ in range(count):
        edge, reach, azimuth, yaw = draw.uniform((0.02, 0.16, -0.8, -3.1), (0.03, 0.26, 0.8, 3.1))
        off = draw.normal(size=2)
        table = Table(arm, edge, SHOULDER_M + reach * np.cos(azimuth), reach * np.sin(azimuth), yaw)
        goal = azimuth + (0.5 if azimuth < 0 else -0.5)
        place = np.array([SHOULDER_M + 0.2 * np.cos(goal), 0.2 * np.sin(goal), 0.0])
        lifted = table.pick(error_m * off / np.linalg.norm(off))
        if lifted and table.cube.position[2] > edge:
            table.place(place)
            cube = table.cube.position
            miss = float(np.linalg.norm(cube[:2] - place[:2]))
            misses.append(miss)
            good += miss < NEAR_M and abs(cube[2] - edge / 2) < STANDING_M
        table.world.cleanup()
    share = 100 * good / count
    known = f", the pose known to {1000 * error_m:.0f} mm" if error_m else ""
    return Row(
        f"pick and place, physics stepped by hand, on the {arm.upper()}, {count} cubes of 2 to 3 cm, random "
        f"yaw{known}: lifted, then upright "
        f"within {1000 * NEAR_M:.0f} mm of the goal",
        f"{share:.0f} %, median miss {1000 * np.median(misses):.1f} mm",
        "",
        None,
        f">= {must:g} %",
        share >= must,
    )


def holding(count: int) -> Row:
    """Close the jaws on a cube in every other try, and compare with the simulator."""
    draw = np.random.default_rng(5)
    said_wrongly, grasps, said = 0, 0, 0
    for index in range(count):
        edge, reach, azimuth, yaw = draw.uniform((0.02, 0.16, -0.8, -3.1), (0.03, 0.26, 0.8, 3.1))
        table = Table("so100", edge, SHOULDER_M + reach * np.cos(azimuth), reach * np.sin(azimuth), yaw)
        # Beside the cube the jaws close on air; nearer misses touch it, and the simulator decides.
        aside = np.zeros(2) if index % 2 == 0 else draw.uniform(0.01, 0.08) * np.array([np.cos(yaw), np.sin(yaw)])
        told = table.pick(aside)
        held = bool(table.cube.position[2] > edge)
        grasps, said = grasps + held, said + (held and bool(told))
        said_wrongly += bool(told) and not held
        table.world.cleanup()
    share = 100 * said / max(grasps, 1)
    return Row(
        f"holding against the simulator's truth, {count} tries of which {grasps} grasp the cube",
        f"held in {share:.0f} % of true grasps; said {said_wrongly} times when it was not",
        "",
        None,
        ">= 98 %; never",
        share >= 98 and said_wrongly == 0,
    )


class Table:
    """One arm and one cube, stepped by hand: seconds of motion take a fraction of that."""

    def __init__(self, arm: str, edge: float, x: float, y: float, yaw: float) -> None:
        self.world = Simulation(realtime=False)
        self.world.add_robot("arm", arm)
        self.world.add_object("cube", "box", (edge / 2,) * 3, (float(x), float(y), edge / 2), yaw=float(yaw))
        self.world.step(20)
        self._body = self.world.body("arm")
        self._held: Held | None = None

    @property
    def cube(self) -> SeenObject:
        """The cube as it is."""
        return self.world.objects("arm")[0]

    def pick(self, aside: NDArray[np.float64]) -> bool | None:
        """Pick up the cube as if it were beside its place; return what the jaw says."""
        cube = self.cube
        seen = SeenObject(cube.name, cube.position + np.array([*aside, 0.0]), cube.yaw, cube.size)
        try:
            motion, self._held = moves.pick(self._start(), seen, None)
        except ValidationError:
            return None
        self._play(motion)
        assert motion.state is not None
        return self._body.arm.holding(motion.state, 0.0)

    def place(self, position: NDArray[np.float64]) -> None:
        """Put it down, and let it come to rest."""
        assert self._held is not None
        self._play(moves.place(self._start(), position, None, self._held))
        self.world.step(100)

    def _start(self) -> Start:
        arm = self._body.arm
        return Start(arm, arm.state(self._body.get_joints()).at_setpoints(arm.setpoints(self._body.targets)), HZ, 0.5)

    def _play(self, motion: Motion) -> None:
        motion.clock = self._body.clock
        while (action := motion.act(self._body.get_joints())) is not None:
            if isinstance(action, dict) and action:
                self._body.send_action(action)
            self.world.step(STEPS)
