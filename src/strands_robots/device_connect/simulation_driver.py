"""A simulated world as a device: policies on its robots, physics by hand, and observations of every robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Optional

from device_connect_edge.types import DeviceIdentity

from strands_robots import settings
from strands_robots.contract import RolloutEvent, WorldRobot
from strands_robots.device_connect._compat import Labels, emit, rpc
from strands_robots.device_connect.base_driver import Call, RobotDriver
from strands_robots.device_connect.live_driver import Activity
from strands_robots.device_connect.robot_driver import task_arguments
from strands_robots.device_connect.telemetry import numbers, paced
from strands_robots.envelope import Envelope, error, fields_of, success
from strands_robots.safety.approval import Approval
from strands_robots.safety.authorization import Authorization
from strands_robots.safety.stopping import explain, halt_each
from strands_robots.utils import ValidationError, shown, text, whole

STEPS_MAX = 100_000
"""Physics steps of one ``step``: a few seconds of computing, within the time that a motion has to answer."""

WORLD_VERBS = (
    *("tool_name_str", "gate", "halt", "subscribe", "list_robots", "start_policy", "stop_policy"),
    *("list_policies_running", "get_state", "get_features", "step", "reset"),
)
"""What makes an object a world."""


class SimulationDeviceDriver(RobotDriver):
    """A simulated world with one or more robots. Start a policy with execute, end all of them with stop.

    Args:
        sim: a :class:`~strands_robots.contract.WorldRobot`.
    """

    device_type = "strands_sim"
    labels: ClassVar[Labels] = {"category": ["robot", "simulation"]}

    def __init__(
        self,
        sim: Any,
        *,
        hardware: bool = False,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        world = _world(sim)
        super().__init__(world, hardware=hardware, authorization=authorization, approval=approval)
        self.world = world
        self._model = world.tool_name_str
        self._observed: dict[str, dict[str, float]] = {}

    @property
    def identity(self) -> DeviceIdentity:
        """Who this device is; ``model`` is the simulation's own name."""
        return DeviceIdentity(
            device_type=self.device_type,
            manufacturer="strands-robots",
            model=self._model,
            description=f"Simulation {self._model}",
        )

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def execute(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, robot_name: str = ""
    ) -> dict[str, Any]:
        """Start a policy on a simulated robot and return at once; follow it with getStatus or policyComplete.

        Args:
            instruction: What to do, in plain language, 1 to 2000 characters
            policy_provider: Policy that decides the actions, such as mock, remote or lerobot_local
            duration: Longest time the policy may run, in seconds, above 0 and at most 3600
            robot_name: Which robot of the world; empty for the first one
        """

        def prepare() -> Call:
            what, provider, seconds = task_arguments(self.authorization, instruction, policy_provider, duration)
            asked = text("robot_name", robot_name, longest=128, empty=True)
            return lambda: self._start_policy(asked, what, provider, seconds)

        return await self.move("execute", prepare)

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def stop(self) -> dict[str, Any]:
        """Stop everything that moves in the simulation; the answer names what stopped and what did not."""
        return await self.halted(self._stop_all)

    @rpc(labels={"direction": "read"})
    async def getStatus(self) -> dict[str, Any]:
        """Simulated time, physics steps, joints of every robot and the policies that run."""
        return await self.read("getStatus", self.with_safety(self.world.get_state))

    @rpc(labels={"direction": "read"})
    async def getFeatures(self) -> dict[str, Any]:
        """Joints, actuators and cameras by robot."""
        return await self.read("getFeatures", self.world.get_features)

    @rpc(labels={"direction": "write"})
    async def step(self, n_steps: int = 1) -> dict[str, Any]:
        """Step physics by hand, as fast as it computes.

        Args:
            n_steps: Physics steps to take, 1 to 100000
        """

        def prepare() -> Call:
            steps = whole("n_steps", n_steps, low=1, high=STEPS_MAX)
            return lambda: self.world.step(steps)

        return await self.move("step", prepare)

    @rpc(labels={"direction": "write"})
    async def reset(self) -> dict[str, Any]:
        """Halt everything and put the world back to its initial state."""
        return await self.move("reset", lambda: self.world.reset)

    @emit()
    async def policyStarted(self, robot_name: str, instruction: str, policy_provider: str) -> None:
        """A policy began.

        Args:
            robot_name: The simulated robot
            instruction: What it was told
            policy_provider: Policy that decides the actions
        """

    @emit()
    async def policyComplete(
        self, robot_name: str, instruction: str, steps: int, state: str = "completed", error: str = ""
    ) -> None:
        """A policy ended.

        Args:
            robot_name: The simulated robot
            instruction: What it was told
            steps: Steps executed
            state: How it ended: completed, stopped or error
            error: What went wrong, when state is error
        """

    @emit()
    async def stateUpdate(
        self,
        sim_time: float = 0.0,
        step_count: int = 0,
        running_policies: Optional[dict[str, Any]] = None,  # noqa: UP045 - the framework reads no `X | None`
    ) -> None:
        """State of the simulation, told at a steady rate.

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
        """Joint positions of one robot, told at a steady rate.

        Args:
            robot_name: The simulated robot
            sim_time: Simulated time in seconds
            step_count: Physics steps so far
            joints: Position by joint name, in radians
        """

    @emit(labels={"modality": "motion"})
    async def streamStep(
        self, step: int, observation: dict[str, Any], action: dict[str, Any], robot_name: str = ""
    ) -> None:
        """One step of a running policy.

        Args:
            step: Number of the step
            observation: Joint positions by name, numbers only
            action: What the policy told the joints, by name
            robot_name: The simulated robot
        """

    def glance(self) -> Activity:
        """Time, steps and running policies of the world; keeps the joints for :meth:`observationUpdate`."""
        facts = fields_of(self.world.get_state())
        rows = self.world.list_policies_running()
        running = {str(row.get("robot", "")): {k: v for k, v in row.items() if k != "robot"} for row in rows}
        robots = facts.get("robots")
        self._observed = {
            str(name): numbers(joints) for name, joints in (robots.items() if isinstance(robots, Mapping) else ())
        }
        told = numbers({key: facts.get(key) for key in ("sim_time", "step_count")})
        return Activity(
            bool(running),
            {
                "sim_time": told.get("sim_time", 0.0),
                "step_count": int(told.get("step_count", 0)),
                "running_policies": running,
            },
        )

    def watches(self) -> list[Any]:
        """State as every robot, and observations besides."""
        hz = settings.number("STRANDS_DC_OBSERVATION_HZ")
        return [*super().watches(), paced(lambda: hz, self._tell_observations)]

    async def tell(self, activity: Activity) -> None:
        """Emit ``stateUpdate``."""
        await self.stateUpdate(**activity.facts)

    async def _tell_observations(self) -> None:
        activity = await self.refresh()
        if activity.fault:
            return
        for name, joints in self._observed.items():
            await self.observationUpdate(
                robot_name=name,
                sim_time=activity.facts["sim_time"],
                step_count=activity.facts["step_count"],
                joints=joints,
            )

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit ``policyStarted``, ``streamStep`` or ``policyComplete``."""
        if event.kind == "started":
            await self.policyStarted(
                robot_name=event.robot, instruction=event.instruction, policy_provider=event.policy
            )
        elif event.kind == "step":
            await self.streamStep(
                step=event.step,
                observation=numbers(event.observation),
                action=numbers(event.action),
                robot_name=event.robot,
            )
        else:
            await self.policyComplete(
                robot_name=event.robot,
                instruction=event.instruction,
                steps=event.step,
                state=event.state,
                error=event.error,
            )

    def _start_policy(self, asked: str, instruction: str, provider: str, seconds: float) -> Envelope:
        robots = self.world.list_robots()
        if not robots:
            return error("The simulation has no robot; add one before execute.")
        if asked and asked not in robots:
            return error(f"robot_name must be one of {', '.join(robots)}, not {shown(asked)}.")
        name = asked or robots[0]
        answer = self.world.start_policy(name, instruction, policy_provider=provider, duration=seconds)
        return {**answer, "robot_name": name}

    def _stop_all(self) -> Envelope:
        """Everything that moves at once, then each rollout's own word; one answer for all."""
        running: list[str] = []
        unlisted: dict[str, str] = {}
        try:
            running = [str(row.get("robot", "")) for row in self.world.list_policies_running()]
        except Exception as exc:  # noqa: BLE001 - a world that changes under the stop is halted as a whole below
            unlisted = {"rollouts": explain(exc)}
        # The halt comes first: a policy that hangs would have the others move on while its own stop waits for it.
        rest = self.halt("stop")
        open_ = [name for name in running if name not in rest.not_stopped]
        rollouts = halt_each({name: _stopping(self.world, name) for name in open_})
        stopped = [*rollouts.halted, *(name for name in rest.halted if name not in running)]
        refused = {**unlisted, **rollouts.not_stopped, **rollouts.unknown, **rest.not_stopped, **rest.unknown}
        fields = {"stopped": stopped, "not_stopped": sorted(refused), "reasons": refused}
        if refused:
            said = "; ".join(f"{name}: {why}" for name, why in refused.items())
            return error(f"Not everything stopped: {said}", **fields)
        return success(f"Stopped {', '.join(stopped)}." if stopped else "Nothing was moving.", **fields)


def _stopping(world: WorldRobot, name: str) -> Callable[[], object]:
    return lambda: world.stop_policy(name)


def _world(sim: Any) -> WorldRobot:
    if isinstance(sim, WorldRobot):
        return sim
    lacking = [verb for verb in WORLD_VERBS if not hasattr(sim, verb)]
    raise ValidationError(f"a simulation must have {', '.join(WORLD_VERBS)}; {shown(sim)} lacks {', '.join(lacking)}.")
