"""Motion gates of robots, by the robot's identity."""

from __future__ import annotations

from strands_robots.identity_map import IdentityMap
from strands_robots.safety.gate import MotionGate

_gates: IdentityMap[MotionGate] = IdentityMap()


def gate_of(robot: object) -> MotionGate:
    """Return a robot's own ``gate``, or one that is made for it; it is kept."""
    own = getattr(robot, "gate", None)
    return _gates.of(robot, lambda: own if isinstance(own, MotionGate) else MotionGate())


def kept_gate(robot: object) -> MotionGate | None:
    """Return the gate that is kept of a robot, or None; asks the robot nothing."""
    return _gates.get(robot)
