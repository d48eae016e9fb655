"""Stops of a world, and of one of its robots, for the stop executor."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace

from strands_robots import settings
from strands_robots.contract import WorldRobot
from strands_robots.envelope import Envelope
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import StopOfRobot
from strands_robots.safety.stopping import (
    PendingVerdict,
    StopVerdict,
    explain,
    graded,
    halt_each,
    halts_in_parts,
    read_verdict,
    verdict_of,
)
from strands_robots.utils import ValidationError


@dataclass(frozen=True)
class WorldStop:
    """Stop everything in a world: halt all, then read each rollout's end."""

    world: WorldRobot

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """Halt the world and grade each rollout; an error outweighs success."""
        return read_verdict(self.halt_here(reason, 0.0))

    def halt_here(self, reason: str, deadline: float) -> PendingVerdict:
        """Order the halt of the world; leave its rollouts to be read.

        The halt comes first: a policy that hangs would have the others move on while its own stop waits for it. It has
        its own deadline, so that one that hangs leaves the rollouts their own stops.
        """
        world = self.world
        # A world that notes its motion lists it at once. Any other is listed after its halt, for that may hang.
        before = _Rollouts(world) if hasattr(type(world), "halt_ordered") else None
        return _WorldEnds(world, stop_executor().submit(world, world.tool_name_str, reason), before)


class _Rollouts:
    """Names of the robots of a world whose rollouts run, or the reason why they are not known."""

    def __init__(self, world: WorldRobot) -> None:
        self.running: list[str] = []
        self.unlisted: dict[str, str] = {}
        try:
            self.running = [str(row.get("robot", "")) for row in world.list_policies_running()]
        except Exception as exc:  # noqa: BLE001 - a world that changes under the stop is halted as a whole
            self.unlisted = {"rollouts": explain(exc)}


class _WorldEnds(PendingVerdict):
    """Verdict on a world whose halt was ordered, and on each of its rollouts."""

    def __init__(self, world: WorldRobot, halting: Future[StopVerdict], before: _Rollouts | None) -> None:
        super().__init__(0.0)
        self._world, self._halting, self._before = world, halting, before

    def known(self) -> None:
        return None

    def read(self) -> StopVerdict:
        rest = self._rest()
        listed = self._before or _Rollouts(self._world)
        # A world that settles has answered for its rollouts, and a second stop would freeze it.
        asked = [] if rest.settling else [name for name in listed.running if name not in rest.not_stopped]
        rollouts = halt_each({name: RobotStop(self._world, name).stop for name in asked})
        return replace(rollouts, unknown={**rollouts.unknown, **listed.unlisted})

    def judged(self, reading: object, *, last: bool) -> StopVerdict:
        rest, rollouts = self._rest(), graded(reading, self._world.tool_name_str)
        return StopVerdict(
            (*rollouts.halted, *(name for name in rest.halted if name not in rollouts.halted)),
            {**rest.not_stopped, **rollouts.not_stopped},
            {**rest.unknown, **rollouts.unknown},
            rest.elapsed_ms + rollouts.elapsed_ms,
            rest.settling,
        )

    def unread(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={self._world.tool_name_str: why})

    def _rest(self) -> StopVerdict:
        # The executor answers at the latest when the deadline is over, behind another halt when it is over twice.
        return self._halting.result(2 * settings.number("STRANDS_HALT_DEADLINE_S") + 1.0)


@dataclass(frozen=True)
class RobotStop(StopOfRobot):
    """The stop of one robot of a world."""

    world: WorldRobot
    name: str

    def stopped_robot(self) -> WorldRobot:
        """Return the world, of whose own verbs each may move this robot."""
        return self.world

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
