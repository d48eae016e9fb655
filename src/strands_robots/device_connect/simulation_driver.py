"""Simulated world as a device: policies, physics by hand, observations."""

from __future__ import annotations

from collections.abc import Mapping
from operator import eq
from typing import Any, ClassVar, Optional

from strands_robots import settings
from strands_robots.adapted import adapt_world
from strands_robots.contract import Haltable, RolloutEvent
from strands_robots.device_connect._compat import Labels, emit
from strands_robots.device_connect.base_driver import RobotDriver, stated_type
from strands_robots.device_connect.telemetry import Activity, rollout_fields
from strands_robots.envelope import Envelope, fields_of
from strands_robots.policies.base import plain_numbers
from strands_robots.safety.authorization import Approval, Authorization
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.robot_verbs import WORLD_VERBS, world_stop_answer
from strands_robots.serving.stops import WorldStop, robot_stop
from strands_robots.serving.verbs import Verb

Observed = tuple[float, int, Mapping[str, dict[str, float]]]
"""Simulated time, physics steps, and the joints of each robot."""


class SimulationDeviceDriver(RobotDriver):
    """A simulated world with one or more robots. Start a policy with execute, end all of them with stop.

    Args:
        sim: a :class:`~strands_robots.contract.WorldRobot`, or any object; what it lacks is refused by name.
    """

    device_type = "strands_sim"
    noun = "Simulation"
    labels: ClassVar[Labels] = {"category": ["robot", "simulation"]}
    verbs: ClassVar[Mapping[str, Verb]] = WORLD_VERBS

    def __init__(
        self,
        sim: Any,
        *,
        hardware: bool = False,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        world = adapt_world(sim)
        super().__init__(world, hardware=hardware, authorization=authorization, approval=approval)
        self.world = world
        self.device_type = stated_type(sim, self.device_type)

    def stop_target(self, robot_name: str = "") -> Haltable:
        """Return what ``stop`` halts: one robot, or the world and each rollout."""
        return robot_stop(self.world, robot_name) if robot_name else WorldStop(self.world)

    def stop_envelope(self, verdict: StopVerdict) -> Envelope:
        """Return the names of what stopped and of what did not."""
        return world_stop_answer(verdict)

    @emit()
    async def policyStarted(
        self, robot_name: str, instruction: str, policy_provider: str, follows_instruction: bool = True
    ) -> None:
        """A policy began.

        Args:
            robot_name: The simulated robot
            instruction: What it was told
            policy_provider: Policy that decides the actions
            follows_instruction: False for a policy that moves by itself, as mock does
        """

    @emit()
    async def policyComplete(
        self,
        robot_name: str,
        instruction: str,
        steps: int,
        state: str = "completed",
        error: str = "",
        *,
        loop: Optional[dict[str, Any]] = None,  # noqa: UP045 - the framework reads no `X | None`
    ) -> None:
        """A policy ended.

        Args:
            robot_name: The simulated robot
            instruction: What it was told
            steps: Steps executed
            state: How it ended: completed, stopped or error
            error: What went wrong, when state is error
            loop: Figures of the control loop, such as underruns and latency_p99_ms
        """

    @emit()
    async def stateUpdate(
        self,
        sim_time: float = 0.0,
        step_count: int = 0,
        running_policies: Optional[dict[str, Any]] = None,  # noqa: UP045 - the framework reads no `X | None`
    ) -> None:
        """State of the simulation, told when it changes.

        Args:
            sim_time: Simulated time in seconds
            step_count: Physics steps so far
            running_policies: What runs, by robot
        """

    @emit(labels={"modality": "motion"})
    async def observationUpdate(
        self,
        robot_name: str = "",
        sim_time: float = 0.0,
        step_count: int = 0,
        joints: Optional[dict[str, float]] = None,  # noqa: UP045 - the framework reads no `X | None`
    ) -> None:
        """Joint positions of one robot, told when they change.

        Args:
            robot_name: The simulated robot
            sim_time: Simulated time in seconds
            step_count: Physics steps so far
            joints: Position by joint name, in radians
        """

    @emit(labels={"modality": "motion"})
    async def streamStep(
        self,
        step: int,
        observation: dict[str, Any],
        action: dict[str, Any],
        robot_name: str = "",
        *,
        led_by: str = "",
    ) -> None:
        """One step of a running policy.

        Args:
            step: Number of the step
            observation: Joint positions by name, numbers only
            action: What the joints were told, by name
            robot_name: The simulated robot
            led_by: The leader that had taken over from the policy; empty for none
        """

    @emit(labels={"modality": "motion"})
    async def turnChanged(self, state: str, leader: str, why: str = "", robot_name: str = "") -> None:
        """Another drives from now on, of a robot that a leader elsewhere has.

        Args:
            state: policy, led or held
            leader: The leader's name
            why: Reason of a hold
            robot_name: The simulated robot
        """

    def glance(self) -> Activity:
        """Return time, steps, policies and joints of the world."""
        facts = fields_of(self.world.get_state())
        rows = self.world.list_policies_running()
        running = {str(row.get("robot", "")): {k: v for k, v in row.items() if k != "robot"} for row in rows}
        robots = facts.get("robots")
        joints = {
            str(name): plain_numbers(each) for name, each in (robots.items() if isinstance(robots, Mapping) else ())
        }
        clock = plain_numbers({key: facts.get(key) for key in ("sim_time", "step_count")})
        state = {
            "sim_time": clock.get("sim_time", 0.0),
            "step_count": int(clock.get("step_count", 0)),
            "running_policies": running,
        }
        return Activity(bool(running), state, joints=joints)

    def watches(self) -> list[Any]:
        """State as every robot, and observations besides."""
        hz = settings.number("STRANDS_DC_OBSERVATION_HZ")
        return [*super().watches(), self.reports.watch(self._look_at_joints, self._tell_observations, eq, hz, hz)]

    async def tell(self, activity: Activity) -> None:
        """Emit ``stateUpdate``."""
        await self.stateUpdate(**activity.facts)

    async def _look_at_joints(self) -> Observed | None:
        activity = await self.reports.refresh()
        return None if activity.fault else (activity.facts["sim_time"], activity.facts["step_count"], activity.joints)

    async def _tell_observations(self, observed: Observed) -> None:
        sim_time, step_count, robots = observed
        for name, joints in robots.items():
            await self.observationUpdate(robot_name=name, sim_time=sim_time, step_count=step_count, joints=joints)

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit ``policyStarted``, ``streamStep`` or ``policyComplete``."""
        fields = {"robot_name": event.robot, **rollout_fields(event)}
        if event.kind == "started":
            await self.policyStarted(**fields)
        elif event.kind == "step":
            await self.streamStep(**fields)
        elif event.kind == "turn":
            await self.turnChanged(**fields)
        else:
            await self.policyComplete(**fields)
