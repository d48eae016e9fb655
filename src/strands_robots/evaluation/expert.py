"""Scripted experts, which plan a task's motions from the simulator's truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from strands_robots.evaluation.tasks import ROBOT, EvaluationTask
from strands_robots.kinematics.motion import Motion
from strands_robots.kinematics.moves import Start
from strands_robots.policies.base import Action, PolicyError, Ranges, numbers
from strands_robots.simulation.world import Simulation
from strands_robots.utils import ValidationError

EXPERT = "expert:"
"""Prefix of the name of a scripted expert, before that of its task."""

SPEED = 0.5
"""Share of full speed at which an expert moves."""


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
