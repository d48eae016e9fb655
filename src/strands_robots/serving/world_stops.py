"""Stops of a world, and of one of its robots, for the stop executor."""

from __future__ import annotations

from dataclasses import dataclass

from strands_robots import settings
from strands_robots.contract import WorldRobot
from strands_robots.envelope import Envelope
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict, explain, halt_each, verdict_of
from strands_robots.utils import ValidationError


@dataclass(frozen=True)
class WorldStop:
    """Stop everything in a world: halt all, then read each rollout's end."""

    world: WorldRobot

    def halt(self, reason: str = "") -> StopVerdict:
        """Halt the world and grade each rollout; an error outweighs success."""
        world, running = self.world, list[str]()
        unlisted: dict[str, str] = {}
        try:
            running = [str(row.get("robot", "")) for row in world.list_policies_running()]
        except Exception as exc:  # noqa: BLE001 - a world that changes under the stop is halted as a whole below
            unlisted = {"rollouts": explain(exc)}
        # The halt comes first: a policy that hangs would have the others move on while its own stop waits for it.
        # It has its own deadline, so that one that hangs leaves the rollouts their own stops.
        rest = stop_executor().halt(world, world.tool_name_str, reason)
        # A world that settles has answered for its rollouts, and a second stop would freeze it.
        asked = [] if rest.settling else [name for name in running if name not in rest.not_stopped]
        rollouts = halt_each({name: RobotStop(world, name).stop for name in asked})
        return StopVerdict(
            (*rollouts.halted, *(name for name in rest.halted if name not in asked)),
            {**rest.not_stopped, **rollouts.not_stopped},
            {**rest.unknown, **rollouts.unknown, **unlisted},
            rest.elapsed_ms + rollouts.elapsed_ms,
            rest.settling,
        )


@dataclass(frozen=True)
class RobotStop:
    """The stop of one robot of a world."""

    world: WorldRobot
    name: str

    def stop(self) -> Envelope:
        """Stop the robot's rollout."""
        return self.world.stop_policy(self.name)

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop the robot's rollout and grade the answer."""
        return verdict_of(self.stop, self.name)


def robot_stop(world: WorldRobot, name: str) -> RobotStop:
    """Return the stop of the named robot of a world.

    Raises:
        ValidationError: the world has no robot of this name.
    """
    robots = world.list_robots()
    if name not in robots:
        raise ValidationError(f"there is no robot of this name; the robots here are {', '.join(robots) or 'none'}")
    return RobotStop(world, name)


def stop_within(target: object) -> float | None:
    """Return the seconds for a stop; None for the halt deadline.

    A stop of a world or of one of its robots waits for the rollouts' own answers besides.
    """
    own_word = isinstance(target, WorldStop | RobotStop)
    return 2 * settings.number("STRANDS_HALT_DEADLINE_S") + 1.0 if own_word else None
