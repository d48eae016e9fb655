"""One robot of a world, seen as a single body: what a rollout or a teleoperation session drives."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from strands_robots.safety.gate import Permit
from strands_robots.simulation.pacing import WorldClock
from strands_robots.simulation.parts import RobotParts
from strands_robots.simulation.physics import Physics
from strands_robots.utils import ValidationError, mapping, number


class RobotBody:
    """Observations and actions of one robot by joint and actuator name, without its prefix in the world."""

    def __init__(self, name: str, physics: Physics, clock: WorldClock) -> None:
        self.name = name
        self._physics = physics
        self._clock = clock

    @property
    def parts(self) -> RobotParts:
        """Where the robot is in the present model. Raises :class:`ValidationError` once it was removed."""
        parts = self._physics.stage.robots.get(self.name)
        if parts is None:
            raise ValidationError(f"robot {self.name} is not in the world any more.")
        return parts

    @property
    def action_features(self) -> dict[str, Any]:
        """Each action key with its type, as LeRobot robots give it."""
        return dict.fromkeys(self.parts.actuators, float)

    @property
    def observation_features(self) -> dict[str, Any]:
        """Each observation key with its type."""
        return dict.fromkeys(self.get_observation(), float)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest command of each action key; infinite where the model gives none."""
        return {key: (a.low, a.high) for key, a in self.parts.actuators.items()}

    @property
    def targets(self) -> dict[str, float]:
        """The setpoints that physics follows now, by action key."""
        setpoints = self._physics.setpoints
        return {key: float(setpoints[actuator.index]) for key, actuator in self.parts.actuators.items()}

    def get_observation(self) -> dict[str, float]:
        """Joint positions (rad, or m for a sliding joint), and the base's pose where there is one. Never waits."""
        snapshot = self._physics.snapshot
        parts = snapshot.stage.robots.get(self.name)
        if parts is None:
            raise ValidationError(f"robot {self.name} is not in the world any more.")
        return {**snapshot.joints(parts), **snapshot.base_pose(parts)}

    def get_joints(self) -> dict[str, float]:
        """The same: an observation of a simulated robot holds numbers alone."""
        return self.get_observation()

    def send_action(self, action: Mapping[str, float], permit: Permit | None = None) -> dict[str, float]:
        """Set targets and let physics follow; returns what was really set, clamped to the actuators' ranges.

        Raises:
            ValidationError: a key the robot has not, or a value that is no finite number; nothing was written.
            PermitVoidError: ``permit`` is void; nothing was written.
        """
        checked = {key: number(f"action[{key!r}]", value) for key, value in mapping("action", action).items()}
        sent = self._physics.command(self.name, checked, permit)
        self._clock.commanded()
        return sent

    def hold(self, permit: Permit | None = None) -> None:
        """Freeze where it is now; nothing when ``permit`` was revoked, for then the halt has frozen it."""
        self._physics.hold(self.name, permit)

    def running(self) -> AbstractContextManager[None]:
        """Held while a loop drives this robot: physics keeps real time."""
        return self._clock.running()
