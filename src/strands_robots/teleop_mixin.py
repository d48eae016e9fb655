"""A leader in place of a policy: teleoperation of a robot of this process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.motions import TELEOPERATION, Motions
from strands_robots.policies.base import Action, Task
from strands_robots.rollout import Body, Plan
from strands_robots.safety.gate import MotionRefused
from strands_robots.utils import ValidationError, flag, mapping, number, shown, teleoperator_contract_error

SLEW_PER_S = 10.0
"""Fastest a leader may drag an action key, in its unit a second, where the caller sets nothing else."""

HZ_MAX = 500.0
FOREVER_S = 30 * 24 * 3600.0


class Leader(Protocol):
    """What leads: LeRobot's teleoperators, a keyboard, a script."""

    def get_action(self) -> Mapping[str, float]:
        """Where the leader is now, by action key."""


class LeaderPolicy:
    """A leader as a policy: each action clamped to the robot's bounds and held to a slew limit."""

    def __init__(self, leader: Leader, slew: float) -> None:
        self._leader = leader
        self._slew = slew
        self._task = Task("")
        self._last: dict[str, float] = {}

    def reset(self, task: Task) -> None:
        self._task = task
        self._last = {}

    def act(self, observation: Mapping[str, Any]) -> Sequence[Action]:
        if not self._last:
            self._last = {k: float(v) for k, v in observation.items() if isinstance(v, int | float)}
        step = self._slew / self._task.hz
        action: Action = {}
        for key, value in mapping("the leader's action", dict(self._leader.get_action())).items():
            if key not in self._task.bounds:
                raise ValidationError(f"the leader moves {shown(key)}; the robot has {', '.join(self._task.bounds)}.")
            low, high = self._task.bounds[key]
            wanted = min(max(number(f"the leader's {key}", value), low), high)
            last = self._last.get(key, 0.0)
            action[key] = min(max(wanted, last - step), last + step)
        self._last.update(action)
        # An empty frame says that the leader has not moved, not that the session is over.
        return [action]

    def close(self) -> None:
        """The leader belongs to whoever attached it."""


class TeleopMixin:
    """The teleoperation verbs. The host has ``motions`` and says which body a robot name means."""

    motions: Motions

    def teleop_body(self, robot_name: str | None) -> Body:
        """The body that ``robot_name`` means, None the only or first one. Raises ValidationError for no such robot."""
        raise NotImplementedError

    def attach_teleop(self, leader: Leader, robot_name: str | None = None, slew: float = SLEW_PER_S) -> Envelope:
        """Let ``leader`` lead a robot once :meth:`teleoperate` is called; it replaces an earlier leader.

        Args:
            leader: any object with a callable ``get_action()``.
            robot_name: which robot of a world; None for the only or first one.
            slew: fastest change of an action key, in its unit a second.
        """
        refusal = teleoperator_contract_error(leader)
        if refusal is not None:
            return error(refusal)
        try:
            body = self.teleop_body(robot_name)
            policy = LeaderPolicy(leader, number("slew", slew, above=0))
        except ValidationError as exc:
            return error(str(exc))
        self._leaders[body.name] = policy
        return success(f"{shown(leader)} leads {body.name}.", robot=body.name)

    def teleoperate(
        self,
        duration: float | None = None,
        hz: float | None = None,
        publish: bool = False,
        robot_name: str | None = None,
    ) -> Envelope:
        """Follow the attached leader; returns at once.

        Args:
            duration: seconds; None until :meth:`stop_teleoperate`.
            hz: actions a second, up to 500; None for ``STRANDS_CONTROL_HZ``.
            publish: stream the actions to the mesh; refused while no mesh carries this robot.
            robot_name: which robot of a world; None for the only or first one.
        """
        try:
            body = self.teleop_body(robot_name)
            seconds = FOREVER_S if duration is None else number("duration", duration, above=0, high=FOREVER_S)
            rate = settings.number("STRANDS_CONTROL_HZ") if hz is None else number("hz", hz, above=0, high=HZ_MAX)
            if flag("publish", publish):
                return error("publish needs a mesh, and this robot is on none.")
            leader = self._leaders.get(body.name)
            if leader is None:
                return error(f"No leader is attached to {body.name}; attach_teleop(leader) attaches one.")
            self.motions.start(TELEOPERATION, body, leader, Plan("", "teleoperation", seconds, rate))
        except ValidationError as exc:
            return error(str(exc))
        except MotionRefused as exc:
            return exc.envelope
        return success(f"{body.name} follows its leader at {rate:g} Hz.", robot=body.name, hz=rate)

    def stop_teleoperate(self, robot_name: str | None = None) -> Envelope:
        """Stop following; ``stopped`` is false when the loop outlived its join."""
        try:
            body = self.teleop_body(robot_name)
        except ValidationError as exc:
            return error(str(exc))
        return self.motions.stop(body.name, TELEOPERATION, settings.number("STRANDS_HALT_DEADLINE_S"))

    @property
    def _leaders(self) -> dict[str, LeaderPolicy]:
        leaders: dict[str, LeaderPolicy] = self.__dict__.setdefault("_attached_leaders", {})
        return leaders
