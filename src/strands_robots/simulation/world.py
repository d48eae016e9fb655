"""``Simulation``: a MuJoCo world with robots in it, as the networks, tools and people use it."""

from __future__ import annotations

import logging
import time
from typing import Any

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import PermitVoidError
from strands_robots.safety.stopping import StopVerdict, halt_each
from strands_robots.simulation import whereabouts
from strands_robots.simulation.arguments import STEPS_MAX, answered
from strands_robots.simulation.construction import checked_plan
from strands_robots.simulation.motion import Rollouts
from strands_robots.simulation.parts import RobotParts
from strands_robots.simulation.physics import CHUNK, Snapshot
from strands_robots.simulation.views import camera_names
from strands_robots.utils import ValidationError, flag, shown, text, whole

logger = logging.getLogger(__name__)


class _Closed:
    """The latch of a world that is gone."""

    def refusal(self, verb: str) -> Envelope:
        return error(f"{verb} is refused: this simulation was cleaned up; make a new one.")


class Simulation(Rollouts):
    """A world of simulated robots, each with its own rollout, behind the contract :class:`WorldRobot`.

    Physics keeps real time while a rollout or a teleoperation runs, and for a moment after a single command;
    :meth:`step` advances it as fast as it computes. Verbs answer envelopes; what a caller gets wrong is refused
    by name and nothing moves.

    Args:
        tool_name: what the simulation is called on a network.
        timestep: physics step in seconds, 0.0001 to 0.02.
        gravity: along z, m/s².
        realtime: false if single commands shall start no clock, so that only :meth:`step` and rollouts move time.

    Raises:
        ValidationError: an argument outside its domain.
    """

    def __init__(
        self,
        tool_name: str = "simulation",
        *,
        timestep: float = 0.002,
        gravity: float = -9.81,
        realtime: bool = True,
    ) -> None:
        self.tool_name_str = text("tool_name", tool_name, longest=128)
        super().__init__(checked_plan(timestep, gravity), realtime=flag("realtime", realtime))

    def get_observation(self, robot_name: str | None = None) -> dict[str, float]:
        """Joint positions of one robot (rad, or m for a sliding joint) and its base's pose where it has one.

        Raises:
            ValidationError: no such robot.
        """
        return self.body(robot_name).get_observation()

    @answered
    def send_action(self, action: dict[str, float], robot_name: str | None = None) -> Envelope:
        """Set targets of one robot; ``sent`` holds what was really set, clamped to each actuator's range."""
        self._open()
        body = self.body(robot_name)
        permit = self.gate.permit("send_action")
        with self._waiting.until_begun(permit, body.name):
            self._idle(body.name)
            try:
                sent = body.send_action(action, permit)
            except PermitVoidError as void:
                raise ValidationError(f"send_action was overtaken by a stop: {void}.") from None
        return success(f"Sent {len(sent)} targets to {body.name}.", robot=body.name, sent=sent)

    @answered
    def step(self, n: int = 1) -> Envelope:
        """Advance physics by ``n`` time steps (1 to 1,000,000) as fast as they compute; setpoints stay as they are."""
        count = whole("n", n, low=1, high=STEPS_MAX)
        self._open()
        self._clock.by_hand()
        left = count
        while left and not self._closed:
            self._physics.advance(min(left, CHUNK))
            left -= min(left, CHUNK)
        snapshot = self._physics.snapshot
        return success(
            f"Stepped {count - left} times, to {snapshot.time:.3f} s.",
            steps=count - left,
            sim_time=snapshot.time,
            step_count=snapshot.steps,
        )

    @answered
    def reset(self) -> Envelope:
        """Halt, then put the world back to its initial state. Refused while the robot is locked."""
        self._open()
        permit = self.gate.permit("reset")
        with self.starting:
            # Nothing starts a rollout while this lock is held; a stop that comes meanwhile voids the fresh permit.
            permit = self.gate.renew(permit)
            verdict = self._frozen("reset")
            if not verdict.stopped:
                return verdict.envelope()
            self._physics.reset(permit)
        return success("The world is back at its start.", sim_time=self._physics.snapshot.time, halted=verdict.halted)

    @answered
    def get_state(self) -> Envelope:
        """``sim_time`` (s), ``step_count``, ``robots`` (name to joints in radians), ``running_policies``, and more."""
        snapshot = self._physics.snapshot
        robots = {name: {**snapshot.joints(p), **snapshot.base_pose(p)} for name, p in snapshot.stage.robots.items()}
        return success(
            f"{_count(robots)} at {snapshot.time:.3f} s of simulated time.",
            sim_time=snapshot.time,
            step_count=snapshot.steps,
            robots=robots,
            running_policies={row["robot"]: row for row in self.list_policies_running()},
            real_time_factor=round(self._clock.real_time_factor, 4),
            diverged=self._physics.diverged,
        )

    @answered
    def get_features(self) -> Envelope:
        """Joints, actuators and cameras by robot, with ranges in the joint's unit (null where there is no limit)."""
        stage = self._physics.snapshot.stage
        robots: dict[str, Any] = {
            name: {
                "model": parts.model,
                "joints": {key: _range(j.low, j.high) for key, j in parts.joints.items()},
                "actuators": {key: _range(a.low, a.high) for key, a in parts.actuators.items()},
                "cameras": list(parts.cameras),
                "observation_features": list(self.body(name).observation_features),
                "action_features": list(parts.actuators),
            }
            for name, parts in stage.robots.items()
        }
        objects = [o.name for o in stage.plan.objects]
        return success(
            f"{len(robots)} robot{'' if len(robots) == 1 else 's'}.",
            robots=robots,
            cameras=camera_names(stage),
            objects=objects,
            timestep=stage.plan.timestep,
        )

    @answered
    def get_pose(self, robot_name: str | None = None) -> Envelope:
        """Where a robot's base is: ``x``, ``y``, ``z`` (m), ``theta`` (yaw, rad), ``quat`` (w, x, y, z), ``source``
        and ``frame``. The name may be left out where there is one robot."""
        snapshot, robot = self._only(robot_name)
        pose = whereabouts.base_pose(snapshot, robot)
        where = f"{robot.name} is at {pose['x']:.3f}, {pose['y']:.3f} m."
        return success(where, **pose, source="simulation", frame="world")

    @answered
    def get_odom(self, robot_name: str | None = None) -> Envelope:
        """The same of a robot that moves about, with ``linear`` (m/s) and ``angular`` (rad/s) along its own axes."""
        snapshot, robot = self._only(robot_name)
        if not whereabouts.moves_about(snapshot, robot):
            return error(f"{robot.name} does not move about.")
        pose, velocity = whereabouts.base_pose(snapshot, robot), whereabouts.base_velocity(snapshot, robot)
        return success(f"{robot.name} moves about.", **pose, **velocity, source="simulation", frame="world")

    @property
    def joint_units(self) -> dict[str, str]:
        """``radians`` or ``metres`` by action key, of the robot that an action without a name goes to."""
        snapshot = self._physics.snapshot
        first = next(iter(snapshot.stage.robots.values()), None)
        return {} if first is None else whereabouts.joint_units(snapshot, first)

    def _only(self, robot_name: str | None) -> tuple[Snapshot, RobotParts]:
        snapshot = self._physics.snapshot
        robots = snapshot.stage.robots
        name = robot_name or (next(iter(robots)) if len(robots) == 1 else "")
        if name not in robots:
            raise ValidationError(f"robot_name must be one of {list(robots)}, not {shown(robot_name)}.")
        return snapshot, robots[name]

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop everything that moves a robot of this world, and freeze them where they are.

        The gate goes first and the freeze second; both take microseconds, and after them no action is written,
        whatever a policy is doing. Waiting for the loops to end, so as to say whether they did, comes last.
        """
        self.gate.revoke()
        return self._frozen(reason)

    def _frozen(self, reason: str) -> StopVerdict:
        deadline = time.monotonic() + settings.number("STRANDS_HALT_DEADLINE_S")
        self._physics.hold()
        stops = self._stops(deadline)
        logger.info("Halting %s (%s): %s.", self.tool_name_str, reason or "no reason given", ", ".join(stops) or "-")
        return halt_each(stops)

    def cleanup(self) -> Envelope:
        """Halt, stop the clock and free the pictures. A second call does nothing."""
        if self._closed:
            return success("Already cleaned up.")
        with self.starting:
            self._closed = True
            self.gate.attach(_Closed())
        verdict = self.halt("cleanup")
        self._clock.close()
        self._close_pictures()
        return verdict.envelope()


def _range(low: float, high: float) -> list[float] | None:
    return [low, high] if low > float("-inf") or high < float("inf") else None


def _count(robots: dict[str, Any]) -> str:
    return "1 robot" if len(robots) == 1 else f"{len(robots)} robots"
