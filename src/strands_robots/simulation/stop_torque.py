"""Torque of simulated robots after a stop: hold, limp or settle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from strands_robots.policies.rollout import RolloutObservers
from strands_robots.policies.settling import Settling, checked_rest_pose
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.stopping import StopVerdict, checked_level
from strands_robots.simulation.body import RobotBody
from strands_robots.simulation.model import RobotParts
from strands_robots.simulation.physics import Physics, WorldClock
from strands_robots.utils import ValidationError, mapping


class StopTorque:
    """Stop level of a world and, with ``settle``, the settling of each of its arms.

    Args:
        level: ``hold``, ``limp`` or ``settle``; None asks ``STRANDS_ESTOP_TORQUE``.
        rest_pose: targets of every robot by action key, or those by robot.
        gate: of the world.
        observers: of the world.

    Raises:
        ValidationError: no such level, or ``settle`` without a pose.
    """

    def __init__(self, level: object, rest_pose: object, gate: MotionGate, observers: RolloutObservers) -> None:
        self._level = checked_level(level, rest_pose)
        self._pose = None if rest_pose is None else mapping("rest_pose", rest_pose)
        self._gate, self._observers = gate, observers
        self._settlings: dict[str, Settling] = {}

    def check(self, robots: Mapping[str, RobotParts]) -> None:
        """Raise :class:`ValidationError` unless the rest pose fits every robot."""
        for parts in robots.values():
            self._pose_of(parts)

    def fit(self, bodies: Mapping[str, RobotBody]) -> None:
        """Make the settling of each robot that joined, and forget that of others."""
        # A halt may be reading the present map, so that a new one takes its place as a whole.
        settlings = {name: each for name, each in self._settlings.items() if name in bodies}
        for name, body in bodies.items():
            pose = self._pose_of(body.parts)
            if self._level == "settle" and pose and name not in settlings:
                ranges = {key: body.bounds[key] for key in pose}
                settling = Settling(body, self._gate, pose, ranges, self._observers, clock=body.clock)
                settlings[name], body.on_motion = settling, settling.note_motion
        self._settlings = settlings

    def freeze(self, physics: Physics, clock: WorldClock) -> None:
        """Freeze every robot of a world, and let it go where the level says so."""
        physics.hold()
        if self._level == "limp":
            physics.release()
            clock.commanded()

    def freeze_one(self, body: RobotBody) -> None:
        """Freeze one robot for good, also one that settles, or let it go."""
        settling = self._settlings.get(body.name)
        if settling is not None:
            settling.give_up()
            # It has stopped: the next halt finds it at rest.
            settling.take()
        body.hold()
        if self._level == "limp":
            body.let_go()

    def after(self, verdict: StopVerdict, generation: int, given: int) -> StopVerdict:
        """Let the arms settle that moved since the last stop, if everything stopped.

        Args:
            verdict: of the halt, which has frozen every robot.
            generation: of that halt.
            given: the gate's count of permits at that halt.
        """
        if self._gate.under_way:
            # A verb of the world's own goes on, or halts its own world.
            return verdict
        if generation != self._gate.generation:
            # Another stop came meanwhile: the two are one, and the later one lets the arms settle.
            return replace(verdict, settling=bool(self.settling))
        due = [each for each in self._settlings.values() if each.take()]
        if not due or not verdict.stopped:
            return verdict
        begun = [each.begin(generation, given) for each in due]
        return replace(verdict, settling=any(begun))

    @property
    def settling(self) -> list[str]:
        """Names of the robots that settle."""
        return [name for name, each in self._settlings.items() if each.running]

    def wait(self) -> str:
        """Wait for the end of every settling under way; return a sentence on each."""
        for each in self._settlings.values():
            each.wait()
        ends = {name: each.ending() for name, each in self._settlings.items()}
        return " ".join(f"{name} {end}." for name, end in ends.items() if end)

    def _pose_of(self, parts: RobotParts) -> dict[str, float]:
        """Return the checked rest pose of a robot; empty for none, or without servos."""
        servos = {key: (each.low, each.high) for key, each in parts.actuators.items() if each.servo}
        if self._pose is None or not servos:
            return {}
        pose: object = self._pose
        if any(isinstance(each, Mapping) for each in self._pose.values()):
            if parts.name not in self._pose:
                raise ValidationError(f"rest_pose must have a pose of {parts.name}; it has {', '.join(self._pose)}.")
            pose = self._pose[parts.name]
        return dict(checked_rest_pose(pose, servos))
