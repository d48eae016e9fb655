"""What the parts of ``Simulation`` share: the plan, the physics, the clock, the gate and the robots' bodies."""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager
from typing import Any

from strands_robots.safety.gate import MotionGate
from strands_robots.simulation.body import RobotBody
from strands_robots.simulation.pacing import WorldClock
from strands_robots.simulation.parts import RobotParts
from strands_robots.simulation.physics import Physics
from strands_robots.simulation.stage import Plan, compile_stage
from strands_robots.utils import ValidationError, shown


class WorldCore:
    """The state of one simulated world. ``gate`` is the motion gate of every robot in it."""

    def __init__(self, plan: Plan, *, realtime: bool) -> None:
        self.gate = MotionGate()
        # Whoever builds the world or starts a motion holds this; whoever stops one never does.
        self.starting: AbstractContextManager[Any] = threading.RLock()
        self._physics = Physics(compile_stage(plan))
        self._clock = WorldClock(self._physics, on_command=realtime)
        self._bodies: dict[str, RobotBody] = {}
        self._closed = False

    def list_robots(self) -> list[str]:
        """Names, in the order in which they were added."""
        return list(self._bodies)

    def body(self, robot_name: str | None = None) -> RobotBody:
        """One robot of the world as a body of its own; without a name, the first.

        Raises:
            ValidationError: no robot of that name, or none at all.
        """
        bodies = self._bodies
        if not bodies:
            raise ValidationError("there is no robot in this world yet; add_robot(name, model) adds one.")
        if robot_name is None or robot_name == "":
            return next(iter(bodies.values()))
        body = bodies.get(robot_name) if isinstance(robot_name, str) else None
        if body is None:
            raise ValidationError(f"robot_name must be one of {', '.join(bodies)}, not {shown(robot_name)}.")
        return body

    def _open(self) -> None:
        if self._closed:
            raise ValidationError("this simulation was cleaned up; make a new one.")

    def _parts(self, robot_name: str | None) -> RobotParts:
        return self.body(robot_name).parts

    def _rebuild(self, plan: Plan) -> None:
        """Compile ``plan`` and go on with it; when it does not compile nothing has changed."""
        self._physics.replace(compile_stage(plan))
        self._bodies = {
            r.name: self._bodies.get(r.name) or RobotBody(r.name, self._physics, self._clock) for r in plan.robots
        }
