"""A robot with one body as a device: its verbs, and the events of its tasks."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, ClassVar, Optional

from strands_robots.adapted import adapt
from strands_robots.bus_access import read_joints
from strands_robots.contract import RUNNING, RolloutEvent, body_of
from strands_robots.device_connect._compat import Labels, emit
from strands_robots.device_connect.base_driver import RobotDriver, stated_type
from strands_robots.device_connect.telemetry import Activity, rollout_fields
from strands_robots.envelope import fields_of
from strands_robots.policies.base import plain_numbers
from strands_robots.safety.authorization import Approval, Authorization
from strands_robots.serving.robot_verbs import BASE_VERBS, NAVIGATING_BASE_VERBS, TASK_VERBS
from strands_robots.serving.verbs import Verb


class RobotDeviceDriver(RobotDriver):
    """A robot arm or vehicle that runs tasks by instruction. Start one with execute, end it with stop.

    Args:
        robot: a :class:`~strands_robots.contract.TaskRobot`, or any object: ``adapted.adapt`` makes it one, and what
            it lacks is refused by name.
    """

    device_type = "strands_robot"
    labels: ClassVar[Labels] = {"category": "robot"}
    verbs: ClassVar[Mapping[str, Verb]] = TASK_VERBS

    def __init__(
        self,
        robot: Any,
        *,
        hardware: bool = True,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        task_robot = adapt(robot, read_joints)
        super().__init__(task_robot, hardware=hardware, authorization=authorization, approval=approval)
        self.task_robot = task_robot
        wrapped = body_of(task_robot)
        self.device_type = stated_type(wrapped, self.device_type)
        self._tells = callable(getattr(wrapped, "subscribe", None))
        self._began: float | None = None

    @emit()
    async def taskStarted(self, instruction: str, policy_provider: str, follows_instruction: bool = True) -> None:
        """A task began.

        Args:
            instruction: What the robot was told
            policy_provider: Policy that decides the actions
            follows_instruction: False for a policy that moves by itself, as mock does
        """

    @emit()
    async def taskComplete(
        self,
        instruction: str,
        steps: int,
        duration: float,
        state: str = "completed",
        error: str = "",
        *,
        loop: Optional[dict[str, Any]] = None,  # noqa: UP045 - the framework reads no `X | None`
    ) -> None:
        """A task ended.

        Args:
            instruction: What the robot was told
            steps: Steps executed
            duration: Seconds from its start to its end
            state: How it ended: completed, stopped or error
            error: What went wrong, when state is error
            loop: Figures of the control loop, such as underruns and latency_p99_ms
        """

    @emit(labels={"modality": "motion"})
    async def streamStep(
        self, step: int, observation: dict[str, Any], action: dict[str, Any], led_by: str = ""
    ) -> None:
        """One step of the running task.

        Args:
            step: Number of the step
            observation: Joint positions by name, numbers only
            action: What the joints were told, by name
            led_by: The leader that had taken over from the policy; empty for none
        """

    @emit(labels={"modality": "motion"})
    async def turnChanged(self, state: str, leader: str, why: str = "") -> None:
        """Another drives from now on, of a robot that a leader elsewhere has.

        Args:
            state: policy, led or held
            leader: The leader's name
            why: Reason of a hold
        """

    @emit()
    async def stateUpdate(self, task_status: str = "", instruction: str = "", step_count: int = 0) -> None:
        """Activity of the robot, told when it changes.

        Args:
            task_status: State of the current or last task
            instruction: What the robot was told
            step_count: Steps so far
        """

    def glance(self) -> Activity:
        """The task's state."""
        facts = fields_of(self.task_robot.get_task_status())
        state = str(facts.get("task_status", "")).lower()
        reported = {
            "task_status": state,
            "instruction": str(facts.get("instruction", "")),
            "step_count": int(plain_numbers(facts).get("step_count", 0)),
        }
        return Activity(state in RUNNING, reported)

    async def tell(self, activity: Activity) -> None:
        """Emit ``stateUpdate``, and start and end of a foreign robot's task."""
        if not self._tells:
            await self._tell_change(activity)
        await self.stateUpdate(**activity.facts)

    async def _tell_change(self, activity: Activity) -> None:
        instruction = activity.facts["instruction"]
        # The robot's own verbs tell their begin and end themselves.
        runs = activity.facts["task_status"] in RUNNING and instruction not in self.own_verbs
        if runs and self._began is None:
            self._began = time.monotonic()
            await self.taskStarted(instruction=instruction, policy_provider=self.policy_provider)
        elif not runs and self._began is not None:
            duration, self._began = time.monotonic() - self._began, None
            state = activity.facts["task_status"]
            await self.taskComplete(
                instruction=instruction, steps=activity.facts["step_count"], duration=duration, state=state
            )

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit ``taskStarted``, ``streamStep`` or ``taskComplete``."""
        fields = rollout_fields(event)
        if event.kind == "started":
            await self.taskStarted(**fields)
        elif event.kind == "step":
            await self.streamStep(**fields)
        elif event.kind == "turn":
            await self.turnChanged(**fields)
        else:
            await self.taskComplete(duration=event.elapsed_s, **fields)


class MobileBaseDeviceDriver(RobotDeviceDriver):
    """A mobile base. Start it with drive, end it with stop."""

    labels: ClassVar[Labels] = {"category": "mobile_base"}
    verbs: ClassVar[Mapping[str, Verb]] = BASE_VERBS


class NavigatingBaseDeviceDriver(MobileBaseDeviceDriver):
    """A mobile base that was made with a ``nav_action``. Start it with drive or navigateTo, end it with stop."""

    verbs: ClassVar[Mapping[str, Verb]] = NAVIGATING_BASE_VERBS
