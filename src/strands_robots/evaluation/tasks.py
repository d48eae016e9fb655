"""Tasks with a goal that the simulator can judge, set up at random from a seed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from strands_robots.envelope import is_error
from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start
from strands_robots.kinematics.objects import SeenObject
from strands_robots.kinematics.planner import Planner
from strands_robots.simulation import CUBE, PLATE
from strands_robots.simulation.world import Simulation
from strands_robots.utils import ValidationError, choice

ROBOT = "arm"
"""Name of the robot in the world of a task."""

SHOULDER_M = 0.0452
"""Distance of the pan axis of the SO arms from their base."""

NEAR_M = 0.02
"""The tip has reached a point, or a cube its place, within this distance."""

PUSHED_M = 0.04
ON_PLATE_M = 0.035
TRIES = 50


class EvaluationTask(ABC):
    """One task; an object serves one episode.

    Attributes:
        name: on the command line.
        instruction: what a policy is told.
        seconds: longest time of an episode.
        environment: observation keys besides the robot's own, in metres.
    """

    name: str
    instruction: str
    seconds: float
    environment: tuple[str, ...]

    @abstractmethod
    def set_up(self, world: Simulation, draw: np.random.Generator) -> None:
        """Put the objects of an episode into a world that has the robot."""

    @abstractmethod
    def observed(self, world: Simulation) -> dict[str, float]:
        """Return the numbers of :attr:`environment`."""

    @abstractmethod
    def achieved(self, world: Simulation) -> bool:
        """Return True while the goal is reached."""

    @abstractmethod
    def plan(self, step: int, start: Start, world: Simulation) -> Motion | None:
        """Return the expert's motion number ``step``, None after the last.

        Raises:
            ValidationError: there is no way.
        """


class Reach(EvaluationTask):
    """Move the tip to a point in front of the arm."""

    name = "reach"
    instruction = "move the tip to the target"
    seconds = 6.0
    environment = ("target.x", "target.y", "target.z")

    def set_up(self, world: Simulation, draw: np.random.Generator) -> None:
        arm = world.body(ROBOT).arm
        for _ in range(TRIES):
            reach, azimuth, height = draw.uniform((0.16, -0.8, 0.05), (0.26, 0.8, 0.18))
            self._target = _at(reach, azimuth, height)
            try:
                Planner(arm.chain, arm.chain.rest, arm.jaw_radians(0.0)).reach(self._target, None)
            except ValidationError:
                continue
            return
        raise ValidationError(f"no point in front of {arm.chain.label} is within its reach.")

    def observed(self, world: Simulation) -> dict[str, float]:
        return dict(zip(self.environment, map(float, self._target), strict=True))

    def achieved(self, world: Simulation) -> bool:
        return float(np.linalg.norm(np.array(world.body(ROBOT).tip_position()) - self._target)) < NEAR_M

    def plan(self, step: int, start: Start, world: Simulation) -> Motion | None:
        from strands_robots.kinematics import moves  # noqa: PLC0415 - the planner is loaded with the first plan

        return moves.move_to(start, self._target, None) if step == 0 else None


class _CubeTask(EvaluationTask):
    """A task with one cube on the table."""

    edge = 0.025

    def _put_cube(self, world: Simulation, position: Floats, yaw: float) -> None:
        half = self.edge / 2
        _added(world.add_object(CUBE, "box", (half,) * 3, (float(position[0]), float(position[1]), half), yaw=yaw))

    def cube(self, world: Simulation) -> SeenObject:
        """Return the cube as it is."""
        return _object(world, CUBE)

    def observed(self, world: Simulation) -> dict[str, float]:
        return dict(zip(self.environment, map(float, self.cube(world).position), strict=True))


class PushCube(_CubeTask):
    """Push a cube to the left by four centimetres, flat on the table."""

    name = "push_cube"
    instruction = "push the cube to the left"
    seconds = 12.0
    environment = ("red_cube.x", "red_cube.y", "red_cube.z")

    def set_up(self, world: Simulation, draw: np.random.Generator) -> None:
        reach, azimuth = draw.uniform((0.17, -0.35), (0.23, 0.2))
        self._put_cube(world, _at(reach, azimuth, 0.0), 0.0)
        world.step(20)
        self._before = self.cube(world).position.copy()

    def achieved(self, world: Simulation) -> bool:
        now = self.cube(world).position
        return float(now[1] - self._before[1]) > PUSHED_M and abs(float(now[2] - self._before[2])) < 0.005

    def plan(self, step: int, start: Start, world: Simulation) -> Motion | None:
        from strands_robots.kinematics import moves  # noqa: PLC0415 - the planner is loaded with the first plan

        beside = self._before + np.array([0.0, -0.05, 0.008])
        if step == 0:
            return moves.set_gripper(start, 0.0)
        if step == 1:
            return moves.move_to(start, beside + np.array([0.0, 0.0, 0.05]), None)
        if step == 2:
            return moves.move_by(start, np.array([0.0, 0.0, -0.05]))
        return moves.move_by(start, np.array([0.0, 0.085, 0.0])) if step == 3 else None


class PickPlace(_CubeTask):
    """Pick up a cube and put it onto a plate."""

    name = "pick_place"
    instruction = "put the red cube on the plate"
    seconds = 25.0
    environment = ("red_cube.x", "red_cube.y", "red_cube.z", "plate.x", "plate.y")

    def set_up(self, world: Simulation, draw: np.random.Generator) -> None:
        reach, azimuth, yaw = draw.uniform((0.17, 0.2, -0.7), (0.25, 0.7, 0.7))
        self._put_cube(world, _at(reach, azimuth, 0.0), float(yaw))
        away = draw.uniform(-0.75, -0.45)
        x, y, _ = _at(0.2, away, 0.0)
        _added(world.add_object(PLATE, "cylinder", (0.05, 0.004), (float(x), float(y), 0.004), mass=0.3))
        world.step(20)
        self._held: Any = None

    def observed(self, world: Simulation) -> dict[str, float]:
        plate = _object(world, PLATE).position
        values = (*map(float, self.cube(world).position), float(plate[0]), float(plate[1]))
        return dict(zip(self.environment, values, strict=True))

    def achieved(self, world: Simulation) -> bool:
        cube, plate = self.cube(world).position, _object(world, PLATE).position
        away = float(np.linalg.norm(np.array(world.body(ROBOT).tip_position()) - cube))
        resting = abs(float(cube[2]) - float(plate[2]) - 0.004 - self.edge / 2) < 0.004
        return float(np.linalg.norm(cube[:2] - plate[:2])) < ON_PLATE_M and resting and away > self.edge

    def plan(self, step: int, start: Start, world: Simulation) -> Motion | None:
        from strands_robots.kinematics import moves  # noqa: PLC0415 - the planner is loaded with the first plan

        if step == 0:
            motion, self._held = moves.pick(start, self.cube(world), None)
            return motion
        if step > 1:
            return None
        plate = _object(world, PLATE)
        on = plate.position + np.array([0.0, 0.0, float(plate.size[2]) / 2])
        return moves.place(start, on, None, self._held)


TASKS: Mapping[str, type[EvaluationTask]] = {task.name: task for task in (Reach, PushCube, PickPlace)}
"""Tasks by name."""


def task_of(name: object) -> EvaluationTask:
    """Return a new task. Raises :class:`ValidationError` for an unknown name."""
    return TASKS[choice("task", name, tuple(TASKS))]()


def _at(reach: float, azimuth: float, height: float) -> Floats:
    return np.array([SHOULDER_M + reach * np.cos(azimuth), reach * np.sin(azimuth), height])


def _object(world: Simulation, name: str) -> SeenObject:
    return next(each for each in world.objects(ROBOT) if each.name == name)


def _added(answer: Mapping[str, Any]) -> None:
    if is_error(answer):
        raise ValidationError(str(answer["reason"]))
