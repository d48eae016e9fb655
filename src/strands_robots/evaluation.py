"""Policies tried on tasks in simulation, and the report of many episodes."""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from strands_robots.contract import RolloutEvent
from strands_robots.envelope import is_error
from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start
from strands_robots.kinematics.objects import SeenObject
from strands_robots.kinematics.planner import Planner
from strands_robots.policies import create_policy
from strands_robots.policies.base import Action, Policy, PolicyError, Ranges, numbers
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.rollout import Clock, Rollout, RolloutObservers
from strands_robots.recording.file import STEP, Recorder
from strands_robots.safety.gate import Permit
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


EXPERT = "expert:"
"""Prefix of the name of a scripted expert, before that of its task."""

SPEED = 0.5
"""Share of full speed at which an expert moves."""

HZ = 50.0
"""Control rate of an episode, unless another is asked for."""

SUCCESS_STEPS = 10
"""Control steps for which the goal must be reached without a break."""

Z95 = 1.959964
"""Quantile of the normal distribution for 95 %."""

HEADINGS = ("policy", "episodes", "success", "95 % interval", "median time of a success")

_ROW, _LEFT, _WIDTH, _TOP = 34, 190, 420, 54
"""Pixels of the plot."""


class ExpertPolicy:
    """Policy that plays planned motions, one after another.

    Args:
        task: whose motions are planned.
        world: where it is set up.
        hz: control rate.
    """

    uses_cameras = False

    def __init__(self, task: EvaluationTask, world: Simulation, hz: float) -> None:
        self._task = task
        self._world = world
        self._hz = hz
        self._step = 0
        self._motion: Motion | None = None

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._step, self._motion = 0, None

    def act(self, observation: Mapping[str, Any]) -> Action | Any | None:
        """Return what the present motion says; plan the next one at its end.

        Raises:
            PolicyError: there is no way.
        """
        while True:
            if self._motion is not None:
                action = self._motion.act(observation)
                if action is not None:
                    return action
                self._step += 1
            try:
                self._motion = self._task.plan(self._step, self._start(observation), self._world)
            except ValidationError as exc:
                raise PolicyError(f"the expert has no plan: {exc}") from exc
            if self._motion is None:
                return None
            self._motion.clock = self._world.body(ROBOT).clock

    def interrupt(self) -> None:
        """Do nothing: this policy never waits."""

    def close(self) -> None:
        """Do nothing: this policy has no resources."""

    def _start(self, observation: Mapping[str, Any]) -> Start:
        body = self._world.body(ROBOT)
        arm = body.arm
        state = arm.state(numbers(observation)).at_setpoints(arm.setpoints(body.targets))
        return Start(arm, state, self._hz, SPEED)


@dataclass(frozen=True)
class Episode:
    """Outcome of one episode.

    Attributes:
        seconds: simulated time until success, or until its end.
        error: why the policy failed, if it did.
        loop: figures of its control loop.
        recording: its MCAP file.
    """

    seed: int
    success: bool
    seconds: float
    steps: int
    error: str = ""
    loop: Mapping[str, float] = field(default_factory=dict)
    recording: str = ""


class SteppedClock(Clock):
    """Simulated time: waiting computes physics.

    Args:
        world: stepped by :meth:`wait`.
        stepped: called after each wait.
    """

    def __init__(self, world: Simulation, stepped: Callable[[], None]) -> None:
        self._world = world
        self._stepped = stepped

    def now(self) -> float:
        return self._world.physics.snapshot.time

    def wait(self, until: float, stop: threading.Event) -> None:
        steps = round((until - self.now()) / self._world.physics.compiled.scene.timestep)
        if steps > 0 and not stop.is_set():
            self._world.step(steps)
        self._stepped()


class TaskBody:
    """The robot of a task, which observes the task's numbers besides its joints."""

    def __init__(self, world: Simulation, task: EvaluationTask) -> None:
        self.name = ROBOT
        self._world = world
        self._task = task
        self._body = world.body(ROBOT)

    @property
    def bounds(self) -> Ranges:
        return self._body.bounds

    @property
    def speeds(self) -> Mapping[str, float]:
        return self._body.speeds

    def get_observation(self) -> dict[str, Any]:
        return dict(self.get_joints())

    def get_joints(self) -> dict[str, float]:
        return {**self._body.get_joints(), **self._task.observed(self._world)}

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        return self._body.send_action(action, permit)

    def hold(self, permit: Permit | None = None) -> None:
        self._body.hold(permit)

    def running(self) -> AbstractContextManager[None]:
        """Return a context that starts no clock: time is moved by hand."""
        return nullcontext()

    def facts(self, hz: float) -> RobotFacts:
        """Return what a policy is checked against."""
        units = {**self._body.joint_units, **dict.fromkeys(self._task.environment, "metres")}
        return RobotFacts(
            ROBOT, self.get_joints(), list(self.bounds), units, {}, hz, self.bounds, self._body.parts.model
        )


class EpisodeJudge:
    """Ends a rollout when its task's goal was reached for long enough."""

    def __init__(self, task: EvaluationTask, world: Simulation) -> None:
        self.success = False
        self.stop: Callable[[], None] = lambda: None
        self._task = task
        self._world = world
        self._steps_at_goal = 0

    def look(self) -> None:
        """Look once, after every control step."""
        self._steps_at_goal = self._steps_at_goal + 1 if self._task.achieved(self._world) else 0
        if self._steps_at_goal >= SUCCESS_STEPS and not self.success:
            self.success = True
            self.stop()


def run_episode(
    policy_name: str,
    task_name: str,
    seed: int,
    *,
    robot: str = "so100",
    hz: float = HZ,
    latency_s: float = 0.0,
    recording: Path | None = None,
) -> Episode:
    """Run one episode.

    Args:
        policy_name: ``mock``, a profile, or ``expert:TASK``.
        task_name: one of :data:`TASKS`.
        seed: decides where things are.
        robot: a built-in arm.
        hz: control rate.
        latency_s: simulated time that each answer of a profile's policy takes.
        recording: a new MCAP file.

    Raises:
        ValidationError: an unknown name, or a policy that does not fit the robot.
        PolicyError: the policy could not be loaded.
    """
    task = task_of(task_name)
    world = Simulation("evaluation", realtime=False, stop_level="hold")
    try:
        answer = world.add_robot(ROBOT, robot)
        if is_error(answer):
            raise ValidationError(str(answer["reason"]))
        task.set_up(world, np.random.default_rng(seed))
        judge = EpisodeJudge(task, world)
        clock = SteppedClock(world, judge.look)
        body = TaskBody(world, task)
        policy = _policy(policy_name, task, world, clock, hz=hz, latency_s=latency_s)
        if isinstance(policy, ProfiledPolicy):
            policy.load(body.facts(hz), policy.profile.first_deadline_s)
        observers = RolloutObservers()
        with ExitStack() as stack:
            if recording is not None:
                recorder = stack.enter_context(Recorder(recording))
                observers.subscribe(_Recording(recorder, task.name, clock).take)
            rollout = Rollout(
                body,
                policy,
                permit=world.gate.permit("evaluate"),
                instruction=task.instruction,
                policy_name=policy_name,
                duration=task.seconds,
                hz=hz,
                observers=observers,
                clock=clock,
                ends_at_rest=True,
            )
            judge.stop = rollout.request_stop
            rollout.run()
            _settle(world, judge, hz)
        return Episode(
            seed,
            judge.success,
            round(rollout.elapsed_s, 3),
            rollout.step_count,
            rollout.error,
            rollout.counts,
            "" if recording is None else str(recording),
        )
    finally:
        world.cleanup()


def _settle(world: Simulation, judge: EpisodeJudge, hz: float) -> None:
    """Look on for a moment where the policy ended by itself."""
    steps = round(1 / (hz * world.physics.compiled.scene.timestep))
    for _ in range(2 * SUCCESS_STEPS):
        if judge.success:
            return
        world.step(steps)
        judge.look()


def _policy(
    name: str, task: EvaluationTask, world: Simulation, clock: SteppedClock, *, hz: float, latency_s: float
) -> Policy:
    if name.startswith(EXPERT):
        if name.removeprefix(EXPERT) != task.name:
            raise ValidationError(f"policy must be {EXPERT}{task.name} for the task {task.name}, not {name!r}.")
        return ExpertPolicy(task, world, hz)
    policy = create_policy(name)
    if isinstance(policy, ProfiledPolicy):
        policy.compute_inline(clock.now, latency_s)
    return policy


class _Recording:
    """Writes the events of a rollout, at their simulated times."""

    def __init__(self, recorder: Recorder, device: str, clock: SteppedClock) -> None:
        self._recorder = recorder
        self._device = device
        self._clock = clock
        self._begun = time.time() - clock.now()

    def take(self, event: RolloutEvent) -> None:
        payload: dict[str, Any] = {"instruction": event.instruction, "policy": event.policy}
        name = "policyStarted"
        if event.kind == "step":
            name = STEP
            payload = {"step": event.step, "observation": dict(event.observation), "action": dict(event.action)}
        elif event.kind == "finished":
            name = "policyComplete"
            payload |= {"steps": event.step, "state": event.state, "error": event.error, "loop": dict(event.loop)}
        self._recorder.take(self._device, name, payload, at=self._begun + self._clock.now())


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Return Wilson's score interval (95 %) of a success rate, from 0 to 1."""
    if episodes == 0:
        return 0.0, 1.0
    share, square = successes / episodes, Z95**2
    centre = (share + square / (2 * episodes)) / (1 + square / episodes)
    spread = Z95 * math.sqrt(share * (1 - share) / episodes + square / (4 * episodes**2)) / (1 + square / episodes)
    # At the ends rounding may leave the interval by 1e-17.
    low, high = max(0.0, centre - spread), min(1.0, centre + spread)
    return (0.0 if successes == 0 else low), (1.0 if successes == episodes else high)


Outcomes = Mapping[str, Sequence[Episode]]
"""Episodes by policy."""


def rows_of(outcomes: Outcomes) -> list[tuple[str, ...]]:
    """Return a row for each policy, as :data:`HEADINGS` name its columns."""
    rows: list[tuple[str, ...]] = []
    for policy, episodes in outcomes.items():
        good = [each for each in episodes if each.success]
        low, high = wilson(len(good), len(episodes))
        took = f"{median(each.seconds for each in good):.1f} s" if good else "-"
        share = f"{100 * len(good) / max(1, len(episodes)):.0f} %"
        rows.append((policy, str(len(episodes)), share, f"{100 * low:.0f} to {100 * high:.0f} %", took))
    return rows


def table_of(outcomes: Outcomes) -> str:
    """Return the rows as a Markdown table."""
    lines = [HEADINGS, tuple("---" for _ in HEADINGS), *rows_of(outcomes)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_plot(path: Path, title: str, outcomes: Outcomes) -> None:
    """Draw the success rate of each policy with its interval, as SVG."""
    height = _TOP + _ROW * len(outcomes) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_LEFT + _WIDTH + 60}" height="{height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="100%" height="100%" fill="white"/><text x="16" y="26" font-size="16">{escape(title)}</text>',
    ]
    for percent in range(0, 101, 25):
        x = _LEFT + _WIDTH * percent / 100
        parts.append(f'<path d="M{x} {_TOP - 8}V{height - 34}" stroke="#dddddd"/>')
        parts.append(f'<text x="{x}" y="{height - 16}" text-anchor="middle">{percent} %</text>')
    for index, (policy, episodes) in enumerate(outcomes.items()):
        good = sum(each.success for each in episodes)
        low, high = (_LEFT + _WIDTH * each for each in wilson(good, len(episodes)))
        y, x = _TOP + _ROW * index + 10, _LEFT + _WIDTH * good / max(1, len(episodes))
        parts.append(f'<text x="16" y="{y + 5}">{escape(policy)}</text>')
        parts.append(f'<path d="M{low:.1f} {y}H{high:.1f}" stroke="#1f5a94" stroke-width="3"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y}" r="6" fill="#1f5a94"/>')
    path.write_text("\n".join([*parts, "</svg>", ""]), encoding="utf-8")
