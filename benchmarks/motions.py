"""Planned motions against the simulator's truth: grasps, places, ways around objects, contact, payloads.

Physics is stepped by hand, so that no figure depends on how busy the machine is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Row
from strands_robots.kinematics import moves, objects
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start, move_joints, move_to
from strands_robots.kinematics.objects import Held, SeenObject
from strands_robots.policies.base import PolicyError
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError

Floats = NDArray[np.float64]

HZ, STEPS = 50.0, 10
"""Control rate, and the physics steps of one control step."""

SHELF_M = 0.037
CONTACT_S = 0.3
SHAPES = ("box", "cylinder", "sphere")
PLACES = ("table", "occupied", "shelf")


def run(*, quick: bool = False) -> list[Row]:
    """Measure every row of this part."""
    cubes, places, scenes, payloads, walls = (8, 9, 6, 20, 6) if quick else (72, 98, 40, 200, 40)
    return [picks(cubes), putting(places), around(scenes), carrying(payloads), contact(walls)]


@dataclass(frozen=True, slots=True)
class Told:
    """What a motion's answer would say: why it failed, empty for done, and that it was refused."""

    why: str
    refused: bool = False


class Bench:
    """One arm in a world that is stepped by hand."""

    def __init__(self) -> None:
        self.world = Simulation(realtime=False)
        self.world.add_robot("arm", "so101")
        self.body = self.world.body("arm")
        self.held: Held | None = None

    def start(self, speed: float = 0.5) -> Start:
        """Return the beginning of a motion, with the objects as they are."""
        arm = self.body.arm
        state = arm.state(self.body.get_joints()).at_setpoints(arm.setpoints(self.body.targets))
        return Start(arm, state, HZ, speed, self.world.objects("arm"), self.held)

    def play(self, motion: Motion) -> str:
        """Play a motion to its end; return the contact that ended it."""
        motion.clock = self.body.clock
        try:
            while (action := motion.act(self.body.get_joints())) is not None:
                if isinstance(action, dict) and action:
                    self.body.send_action(action)
                self.world.step(STEPS)
        except PolicyError:
            return motion.contact
        self.world.step(100)
        return ""

    def judged(self, motion: Motion, looked: objects.Sight) -> Told:
        """Play a motion and return what its answer says."""
        blocked = self.play(motion)
        looked.after = self.world.objects("arm")
        assert motion.state is not None
        holding = None if motion.opening is None else self.body.arm.holding(motion.state, motion.opening)
        tip = self.body.arm.chain.forward(motion.state.joints).position
        error_mm = None if motion.goal is None else 1000 * float(np.linalg.norm(tip - motion.goal))
        return Told(blocked or motion.problem(error_mm, holding) or looked.problem())

    def pick(self, name: str) -> Told:
        """Pick an object up."""
        start = self.start()
        target = next(each for each in start.objects if each.name == name)
        try:
            objects.require_uncovered(target, start.objects)
            motion, self.held = moves.pick(start, target, None)
        except ValidationError as exc:
            return Told(str(exc), refused=True)
        wanted = self.held.centre(start.arm.chain.forward(motion.end_joints))
        return self.judged(motion, objects.Sight(start.objects, name, wanted, objects.CARRIED_MM))

    def place(self, position: Floats, on: str = "") -> Told:
        """Put the held object down."""
        assert self.held is not None
        start = self.start()
        try:
            objects.require_vacant(position, self.held, start.objects, on)
            motion = moves.place(start, position, None, self.held, on)
        except ValidationError as exc:
            return Told(str(exc), refused=True)
        wanted = position + np.array([0.0, 0.0, self.held.below])
        return self.judged(motion, objects.Sight(start.objects, self.held.name, wanted))

    def object(self, name: str) -> SeenObject:
        """Return an object as it is now."""
        return next(each for each in self.world.objects("arm") if each.name == name)

    def put(self, name: str, shape: str, edge: float, at: Floats, yaw: float) -> None:
        """Put an object of an edge length onto the table."""
        half = edge / 2
        size = {"box": (half,) * 3, "cylinder": (half, half), "sphere": (half,)}[shape]
        self.world.add_object(name, shape, size, (float(at[0]), float(at[1]), half), mass=0.02, yaw=yaw)


def spot(draw: np.random.Generator, low: float, high: float) -> Floats:
    """Return a random place on the table between two azimuths (rad)."""
    reach, azimuth = draw.uniform(0.17, 0.25), draw.uniform(low, high)
    return np.array([0.045 + reach * np.cos(azimuth), reach * np.sin(azimuth), 0.0])


def picks(count: int) -> Row:
    """Pick cubes up beside two others."""
    draw = np.random.default_rng(11)
    lifted = false = refused = 0
    for _ in range(count):
        bench, edge, at = Bench(), float(draw.uniform(0.02, 0.03)), spot(draw, -0.7, 0.7)
        bench.put("cube", "box", edge, at, float(draw.uniform(-3, 3)))
        for index in range(2):
            beside = at + 0.07 * np.array([np.cos(turn := draw.uniform(-3, 3)), np.sin(turn), 0.0])
            bench.put(f"other {index}", "box", 0.02, beside, 0.0)
        bench.world.step(50)
        told = bench.pick("cube")
        up = bool(bench.object("cube").position[2] > edge)
        lifted, refused, false = lifted + up, refused + told.refused, false + (not told.why and not up)
        bench.world.cleanup()
    return Row(
        f"{count} cubes of 2 to 3 cm picked up, two others 7 cm beside each",
        f"{lifted} lifted, {refused} refused; said to be done {false} times when it was not",
        "",
        None,
        ">= 95 %; never",
        lifted >= 0.95 * count and not false,
    )


def putting(count: int) -> Row:
    """Put cubes, cylinders and balls down on the table, on a shelf, and where another object is."""
    draw = np.random.default_rng(12)
    good = false = honest = 0
    for index in range(count):
        shape, where = SHAPES[index % 3], PLACES[(index // 3) % 3]
        bench, at, goal = Bench(), spot(draw, -0.7, -0.2), spot(draw, 0.2, 0.7)
        bench.put("thing", shape, 0.025, at, float(draw.uniform(-3, 3)))
        if where == "occupied":
            bench.put("glass", "cylinder", 0.03, goal, 0.0)
        if where == "shelf":
            middle = (float(goal[0]), float(goal[1]), SHELF_M / 2)
            bench.world.add_object("shelf", "box", (0.04, 0.04, SHELF_M / 2), middle, fixed=True)
            goal[2] = SHELF_M
        bench.world.step(50)
        told = bench.pick("thing")
        if not told.why:
            told = bench.place(goal, "shelf" if where == "shelf" else "")
        off = 1000 * float(np.linalg.norm(bench.object("thing").position - goal - np.array([0.0, 0.0, 0.0125])))
        there = off <= objects.PLACED_MM
        good, honest = good + (not told.why and there), honest + bool(told.why)
        false += not told.why and not there
        bench.world.cleanup()
    return Row(
        f"{count} places of cubes, cylinders and balls: on the table, on a shelf at 37 mm, where a glass is",
        f"{good} done and there, {honest} told or refused; said to be done {false} times when it lay elsewhere",
        "",
        None,
        "never",
        not false,
    )


def around(count: int) -> Row:
    """Move past posts between the start and the goal."""
    draw = np.random.default_rng(13)
    reached = refused = pushed = other = 0
    for _ in range(count):
        bench, side = Bench(), 1 if draw.random() < 0.5 else -1
        bench.play(move_to(bench.start(1.0), np.array([0.22, -0.12 * side, 0.05]), None))
        for index in range(int(draw.integers(1, 4))):
            x, y, half = draw.uniform((0.16, -0.05, 0.02), (0.3, 0.05, 0.06))
            bench.world.add_object(f"post {index}", "box", (0.01, 0.01, half), (x, y, half), mass=0.02)
        bench.world.step(50)
        start = bench.start(1.0)
        try:
            motion = move_to(start, np.array([0.22, 0.12 * side, 0.05]), None)
        except ValidationError as exc:
            named = "post" in str(exc)
            refused, other = refused + named, other + (not named)
        else:
            looked = objects.Sight(start.objects)
            told = bench.judged(motion, looked)
            reached, pushed, other = reached + (not told.why), pushed + bool(looked.moved), other + bool(told.why)
        bench.world.cleanup()
    return Row(
        f"{count} scenes with 1 to 3 posts between the start and the goal of the tip",
        f"{reached} reached the goal, {refused} refused by the post's name, {other} other; {pushed} pushed a post",
        "",
        None,
        ">= 90 % reached; none pushed, no other",
        reached >= 0.9 * count and not pushed and not other,
    )


def carrying(count: int) -> Row:
    """Move joints anywhere with payloads up to the arm's own mass."""
    draw = np.random.default_rng(14)
    ended: list[str] = []
    heaviest = 0.0
    for _ in range(count):
        bench = Bench()
        model = bench.world.physics.compiled.model
        own = float(model.body_subtreemass[model.body(bench.body.parts.root).id])
        mass = float(draw.uniform(0, own))
        model.body_mass[model.site_bodyid[model.site(bench.body.parts.tip).id]] += mass
        heaviest = max(heaviest, mass)
        chain, speed = bench.body.arm.chain, float(np.exp(draw.uniform(np.log(0.02), 0)))
        for _ in range(20):
            share = draw.uniform(0.2, 0.8, len(chain.joints))
            wanted = np.degrees(chain.lows + (chain.highs - chain.lows) * share)
            try:
                motion = move_joints(
                    bench.start(speed), dict(zip([joint.name for joint in chain.joints], wanted, strict=True))
                )
            except ValidationError:
                continue
            ended += [blocked] if (blocked := bench.play(motion)) else []
            break
        bench.world.cleanup()
    return Row(
        f"{count} motions with payloads up to the arm's own mass, {1000 * heaviest:.0f} g, at 2 to 100 % of full speed",
        f"{len(ended)} ended as contact{': ' + ended[0] if ended else ''}",
        "",
        None,
        "none",
        not ended,
    )


def contact(count: int) -> Row:
    """Turn the arm into a wall that no plan knows."""
    draw = np.random.default_rng(15)
    took, named = [], 0
    for _ in range(count):
        bench, speed = Bench(), float(np.exp(draw.uniform(np.log(0.1), 0)))
        bench.world.add_object("wall", "box", (0.3, 0.01, 0.3), (0.3, draw.uniform(0.09, 0.16), 0.3), fixed=True)
        start = bench.start(speed)
        motion = move_joints(Start(start.arm, start.state, HZ, speed), {"shoulder_pan": -60.0})
        motion.clock = bench.body.clock
        met = None
        try:
            while (action := motion.act(bench.body.get_joints())) is not None:
                if isinstance(action, dict) and action:
                    bench.body.send_action(action)
                before = bench.body.clock()
                bench.world.step(STEPS)
                if met is None and touches(bench.world):
                    met = before
        except PolicyError:
            took.append(bench.body.clock() - (met or 0.0))
            named += motion.contact.startswith("shoulder_pan")
        bench.world.cleanup()
    worst = max(took, default=float("inf"))
    return Row(
        f"{count} motions at 10 to 100 % of full speed into a wall that the plan does not know",
        f"{named} ended by the joint's name, {1000 * float(np.median(took)):.0f} ms after the first touch (median), "
        f"{1000 * worst:.0f} ms at most",
        "",
        None,
        f"all; at most {1000 * CONTACT_S:.0f} ms",
        named == count and worst <= CONTACT_S,
    )


def touches(world: Simulation) -> bool:
    """Return True while the arm touches the wall."""
    data = world.physics.snapshot.data()
    mujoco.mj_collision(data.model, data)
    touching = data.contact.geom[data.contact.dist < 0].ravel() if data.ncon else ()
    return any("wall" in str(data.model.body(int(data.model.geom_bodyid[geom])).name) for geom in touching)
