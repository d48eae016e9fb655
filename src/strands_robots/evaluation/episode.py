"""Episodes: a task in a world that is stepped by hand, and the report of many."""

from __future__ import annotations

import math
import threading
import time
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
from strands_robots.evaluation.tasks import ROBOT, EvaluationTask, task_of
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start
from strands_robots.policies import create_policy
from strands_robots.policies.base import Action, Policy, PolicyError, Ranges, numbers
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.rollout import Clock, Rollout, RolloutObservers
from strands_robots.recording.file import STEP, Recorder
from strands_robots.safety.gate import Permit
from strands_robots.simulation.world import Simulation
from strands_robots.utils import ValidationError

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
