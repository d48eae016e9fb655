"""Building the world: robots and objects, added and removed by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from strands_robots.envelope import Envelope, success
from strands_robots.simulation.arguments import TIMESTEP_MAX, TIMESTEP_MIN, answered, object_plan, triple
from strands_robots.simulation.catalog import find
from strands_robots.simulation.core import WorldCore
from strands_robots.simulation.stage import Plan, RobotPlan
from strands_robots.utils import ValidationError, identifier, number, shown

SPACING_M = 0.45
"""Distance between robots that are added without a position, in metres."""


class Construction(WorldCore):
    """The verbs that change what stands in the world. Each is refused while a rollout or a teleoperation runs."""

    @answered
    def create_world(self, timestep: float = 0.002, gravity: float = -9.81) -> Envelope:
        """Start over with an empty room. ``timestep`` 0.0001 to 0.02 s, ``gravity`` -100 to 100 m/s² along z."""
        plan = checked_plan(timestep, gravity)
        with self.starting:
            self._changeable("create_world")
            permit = self.gate.permit("create_world")
            self._rebuild(plan)
            self._physics.reset(permit)
        return success("An empty world with a floor.", timestep=plan.timestep, gravity=plan.gravity)

    @answered
    def add_robot(
        self,
        name: str = "so100",
        model: str | Path | None = None,
        position: Any = None,
        yaw: float = 0.0,
    ) -> Envelope:
        """Put a robot into the world; the others keep their state.

        Args:
            name: what it is called here, an identifier that no robot or object has.
            model: ``so100``, ``so101``, ``rover``, the path of an MJCF or URDF file, or a ``robot_descriptions``
                name; left out, ``name`` says it.
            position: where its base stands, metres; left out, beside the robots that are there.
            yaw: heading, radians from -2π to 2π.
        """
        label = identifier("name", name)
        heading = number("yaw", yaw, low=-6.2831853072, high=6.2831853072)
        source = find(name if model is None else model)
        with self.starting:
            self._changeable("add_robot")
            plan = self._physics.stage.plan
            self._free(label, plan)
            place = (0.0, -SPACING_M * len(plan.robots), 0.0) if position is None else triple("position", position)
            self._rebuild(plan.with_robot(RobotPlan(label, source, place, heading)))
            parts = self._parts(label)
        return success(
            f"Added {label} ({source.label}) with {len(parts.actuators)} actuators.",
            robot=label,
            model=source.label,
            joints=list(parts.joints),
            actuators=list(parts.actuators),
            cameras=list(parts.cameras),
        )

    @answered
    def remove_robot(self, name: str) -> Envelope:
        """Take a robot out of the world; the others keep their state."""
        with self.starting:
            self._changeable("remove_robot")
            label = self.body(identifier("name", name)).name
            self._rebuild(self._physics.stage.plan.without_robot(label))
        return success(f"Removed {label}.", robot=label, robots=self.list_robots())

    @answered
    def add_object(
        self,
        name: str,
        shape: str = "box",
        size: Any = (0.02, 0.02, 0.02),
        position: Any = (0.2, 0.0, 0.02),
        *,
        color: Any = (0.85, 0.2, 0.2, 1.0),
        mass: float = 0.05,
        fixed: bool = False,
    ) -> Envelope:
        """Put an object of primitive shape into the world.

        Args:
            name: an identifier that no robot or object has.
            shape: box, sphere, cylinder or capsule.
            size: metres from 0.001 to 10: half lengths of a box, radius of a sphere, radius and half length else.
            position: of its centre, metres.
            color: red, green, blue and alpha from 0 to 1.
            mass: kilograms, 0.0001 to 1000.
            fixed: true for a thing that never moves.
        """
        item = object_plan(name=name, shape=shape, size=size, position=position, color=color, mass=mass, fixed=fixed)
        with self.starting:
            self._changeable("add_object")
            plan = self._physics.stage.plan
            self._free(item.name, plan)
            self._rebuild(plan.with_object(item))
        return success(f"Added {item.shape} {item.name}.", object=item.name, position=list(item.position))

    @answered
    def remove_object(self, name: str) -> Envelope:
        """Take an object out of the world."""
        with self.starting:
            self._changeable("remove_object")
            plan = self._physics.stage.plan
            names = [o.name for o in plan.objects]
            if name not in names:
                raise ValidationError(f"name must be one of {names}, not {shown(name)}.")
            self._rebuild(plan.without_object(name))
        return success(f"Removed {name}.", object=name)

    def moving(self) -> list[str]:
        """What moves a robot right now: rollouts and teleoperation sessions, by name."""
        return []

    def _changeable(self, verb: str) -> None:
        self._open()
        busy = self.moving()
        if busy:
            raise ValidationError(f"{verb} is refused while something moves: {', '.join(busy)}. Stop it first.")

    def _free(self, name: str, plan: Plan) -> None:
        if name in [r.name for r in plan.robots] or name in [o.name for o in plan.objects] or name in _ROOM:
            raise ValidationError(f"name {shown(name)} is taken; choose another.")


_ROOM = ("floor", "world")


def checked_plan(timestep: object, gravity: object) -> Plan:
    """An empty plan of checked numbers."""
    return Plan(
        number("timestep", timestep, low=TIMESTEP_MIN, high=TIMESTEP_MAX),
        number("gravity", gravity, low=-100, high=100),
    )
