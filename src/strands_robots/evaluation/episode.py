"""One episode: a task in a world of its own, stepped by hand in the control loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from strands_robots.contract import RolloutEvent
from strands_robots.envelope import is_error
from strands_robots.evaluation.expert import EXPERT, ExpertPolicy
from strands_robots.evaluation.tasks import ROBOT, EvaluationTask, task_of
from strands_robots.policies import create_policy
from strands_robots.policies.base import Action, Policy, Ranges
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.rollout import Clock, Rollout, RolloutObservers
from strands_robots.recording.file import STEP, Recorder
from strands_robots.safety.gate import Permit
from strands_robots.simulation.world import Simulation
from strands_robots.utils import ValidationError

HZ = 50.0
"""Control rate of an episode, unless another is asked for."""

KEPT_STEPS = 10
"""Control steps for which the goal must be reached without a break."""


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
        self._kept = 0

    def look(self) -> None:
        """Look once, after every control step."""
        self._kept = self._kept + 1 if self._task.achieved(self._world) else 0
        if self._kept >= KEPT_STEPS and not self.success:
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
    for _ in range(2 * KEPT_STEPS):
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
