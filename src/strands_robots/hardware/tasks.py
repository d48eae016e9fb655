"""The tasks of a real robot: one rollout at a time on its one body."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

from strands_robots import settings
from strands_robots.contract import Observer, Unsubscribe
from strands_robots.envelope import Envelope, error, success
from strands_robots.hardware.body import DeviceBody
from strands_robots.hardware.freezer import Freezer, NoAnswerError
from strands_robots.policies.registry import create_policy, resolve_provider
from strands_robots.policies.rollout import Rollout, RolloutObservers, rollout_options
from strands_robots.safety.gate import MotionGate, MotionRefused, Waiting
from strands_robots.teleop_mixin import TeleopMixin
from strands_robots.utils import MissingExtraError, ValidationError

logger = logging.getLogger(__name__)

WIND_DOWN_S = 5.0
"""How much longer than its duration :meth:`Tasks.run_task` waits for a task to end."""

ANSWER_SHARE = 0.9
"""Part of the halt deadline that a stop waits; the rest is for its verdict to reach who asked in time."""


class Tasks(TeleopMixin):
    """The verbs that start, watch and stop tasks on ``body``."""

    def __init__(self, body: DeviceBody, control_hz: float) -> None:
        self.tool_name_str = body.name
        self.control_hz = control_hz
        self.gate = MotionGate()
        self.starting = threading.RLock()
        self._body = body
        self._freezer = Freezer(body)
        self.observers = RolloutObservers()
        self._task: Rollout | None = None
        self._waiting = Waiting()

    def body(self, robot_name: str | None = None) -> DeviceBody:
        """The one body of this robot, by its name or without one."""
        if robot_name not in (None, "", self.tool_name_str):
            raise ValidationError(f"robot_name must be {self.tool_name_str}, not {robot_name!r}.")
        return self._body

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every task event until the returned callable is called."""
        return self.observers.subscribe(observer)

    def start_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        **policy: Any,
    ) -> Envelope:
        """Start a task and return at once; refused while something drives the robot.

        Args:
            instruction: what it shall do, 1 to 2000 characters.
            policy_provider: a registered policy, such as mock, remote or lerobot_local.
            duration: seconds, above 0 up to a day.
            policy_port: port of the policy's server; 0 for the provider's own.
            policy: what that policy's constructor takes besides, ``control_frequency`` (Hz, at most the robot's rate)
                and ``n_steps`` (actions after which it ends).
        """
        task = self._start(instruction, policy_provider, duration, {"policy_port": policy_port, **policy})
        if isinstance(task, dict):
            return task
        return success(
            f"{self.tool_name_str} started: {task.instruction}",
            task_status="running",
            instruction=task.instruction,
            policy=task.policy_name,
            duration=task.duration,
        )

    def run_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        **policy: Any,
    ) -> Envelope:
        """The same, but wait for the end; an error when the policy failed or did not end in its time."""
        task = self._start(instruction, policy_provider, duration, {"policy_port": policy_port, **policy})
        if isinstance(task, dict):
            return task
        if not task.join((task.duration or 0.0) + WIND_DOWN_S):
            task.request_stop()
            return error(f"The task was still running {WIND_DOWN_S:g} s after its time.", **self._task_fields())
        if task.state == "error":
            return error(f"The task failed: {task.error}", **self._task_fields())
        return success(f"The task {task.state} after {task.step_count} steps.", **self._task_fields())

    def stop_task(self) -> Envelope:
        """Stop the task and freeze the robot; ``stopped`` is false when the loop outlived the halt deadline."""
        self._waiting.void()
        task = self._task
        if task is None or not task.running:
            return success("No task runs.", stopped=True, was_running=False, **self._task_fields())
        deadline = time.monotonic() + ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        task.request_stop()
        frozen = self._freeze(deadline)
        answer = task.ended_by(deadline)
        stopped = frozen is None and answer["status"] == "success"
        fields = {"stopped": stopped, "was_running": True, **self._task_fields()}
        if stopped:
            return success(f"Stopped after {task.step_count} steps.", **fields)
        return error(frozen or str(answer["reason"]), **fields)

    def get_task_status(self) -> Envelope:
        """``task_status`` (idle, running, completed, stopped, error), ``instruction``, ``policy``, ``step_count``,
        ``duration`` (seconds it has taken) and ``error`` of the current or last task."""
        fields = self._task_fields()
        return success(f"Task {fields['task_status']} after {fields['step_count']} steps.", **fields)

    def occupied(self, robot: str) -> str:
        """The running task, for a refusal; empty when none runs."""
        task = self._task
        return f"the task {task.instruction!r}" if task is not None and task.running else ""

    def _start(self, instruction: str, provider: str, duration: float, options: dict[str, Any]) -> Rollout | Envelope:
        try:
            return self._begin(instruction, provider, duration, options)
        except MotionRefused as refused:
            return refused.envelope
        except (ValidationError, MissingExtraError) as exc:
            return error(str(exc))

    def _begin(self, instruction: str, provider: str, duration: float, options: dict[str, Any]) -> Rollout:
        chosen = rollout_options(instruction, duration, options, self.control_hz)
        name = resolve_provider(provider)
        # Before the line for the robot: a stop that comes while this waits, connects or loads is newer.
        permit = self.gate.permit("start_task")
        with self._waiting.until_begun(permit), self.starting:
            permit.check()
            self._freezer.ready()
            self._free()
            self._reconnect()
            if not self._body.is_connected:
                raise ValidationError(f"{self.tool_name_str} is not connected; connect() it first.")
            policy = create_policy(name, **options)
            permit.check()
            rollout = Rollout(
                self._body,
                policy,
                permit=permit,
                policy_name=name,
                observers=self.observers,
                **chosen,
            )
            self._task = rollout
            rollout.start()
            return rollout

    def _reconnect(self) -> None:
        """Whoever asks for a motion after the cable was out gets the robot back, if the port is."""
        if not self._body.lost:
            return
        try:
            self._body.connect()
        except Exception as exc:
            raise ValidationError(
                f"{self.tool_name_str} lost its port and could not be connected again: {type(exc).__name__}: {exc}."
            ) from exc
        logger.warning("%s lost its port and is connected again.", self.tool_name_str)

    def _free(self) -> None:
        leader = self.teleoperated_by(self.tool_name_str)
        busy = self.occupied(self.tool_name_str) or (f"the leader {leader}" if leader else "")
        if busy:
            raise ValidationError(f"{self.tool_name_str} is driven by {busy}; stop that first.")

    def _freeze(self, deadline: float) -> str | None:
        """None when frozen, else why not."""
        try:
            self._freezer.freeze(max(0.0, deadline - time.monotonic()))
        except NoAnswerError:
            return f"no answer in {settings.number('STRANDS_HALT_DEADLINE_S'):g} s"
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the verdict says what
            return f"it could not be frozen: {type(exc).__name__}: {exc}"
        return None

    def _task_fields(self) -> dict[str, Any]:
        task = self._task
        return {
            "task_status": "idle" if task is None else task.state,
            "instruction": "" if task is None else task.instruction,
            "policy": "" if task is None else task.policy_name,
            "step_count": 0 if task is None else task.step_count,
            "duration": 0.0 if task is None else round(task.elapsed_s, 3),
            "error": "" if task is None else task.error,
        }
