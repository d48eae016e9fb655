"""Real robot behind the contract: tasks, teleoperation, actions, and halt."""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from strands_robots import settings
from strands_robots.arm_mixin import ArmMixin
from strands_robots.audit import queue_safety_event
from strands_robots.contract import Observer, Unsubscribe
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.hardware.body import DeviceBody
from strands_robots.hardware.device_facts import (
    arm_parts,
    feature_type,
    has_temperatures,
    is_picture,
    joint_units,
    kind,
    model_name,
    stable_id,
    stated_joints,
    still_action,
    temperatures,
)
from strands_robots.kinematics import ArmParts, StatedJoint
from strands_robots.policies.base import Action, checked_action, is_velocity, numbers
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.rollout import Rollout, instruction_note
from strands_robots.policies.settling import Settling, checked_rest_pose
from strands_robots.policies.task_engine import RolloutsEnd, TaskEngine, failure, unfrozen
from strands_robots.recording.cameras import LazyFrames
from strands_robots.safety.gate import (
    REFUSALS,
    MotionRefused,
    MotionRequest,
    PermitVoidError,
    answered,
    refusal_envelope,
)
from strands_robots.safety.persistence import hardware_key
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import StopOfRobot, note_motion
from strands_robots.safety.stopping import PendingVerdict, StopLevel, StopVerdict, checked_level, halts_in_parts
from strands_robots.stop_log import stop_logger
from strands_robots.teleop_mixin import TeleopMixin
from strands_robots.utils import ValidationError, choice, number, text

if TYPE_CHECKING:  # numpy and MuJoCo are loaded with the first motion
    from strands_robots.kinematics.arm import Arm

logger = stop_logger(__name__)

WIND_DOWN_S = 5.0
"""Seconds beyond its duration that :meth:`HardwareRobot.run_task` waits for a task."""


class HardwareRobot(ArmMixin, TeleopMixin):
    """Device with LeRobot's robot interface, driven by tasks, leaders or actions.

    Args:
        device: has ``observation_features``, ``action_features``, ``get_observation``, ``send_action``, ``connect``,
            ``disconnect``, and may have ``is_connected``, ``joint_ranges``, ``get_joints``, ``get_currents``, ``hold``,
            and ``holds_unconnected``, true where ``hold`` needs no connection.
        tool_name: what the robot is called on a network, 1 to 128 characters.
        control_hz: control rate, 1 to 2000; ``STRANDS_CONTROL_HZ`` by default.
        joint_ranges: lowest and highest target by action key, in the device's unit; what is not named is asked of
            the device, and unbounded where it does not know.
        stop_level: what a halt leaves: ``hold`` (frozen, torque on), ``limp`` (torque off: an arm falls; also
            ``release``) or ``settle`` (frozen, then to ``rest_pose`` at bounded speed, then limp); by default as
            ``STRANDS_ESTOP_TORQUE`` says.
        rest_pose: where a robot that settles goes: a target for every action key that is a position.
        model: of the arm for motions to a point: so100, so101 or an MJCF file; that of the device's type by default.
        speed_limit: greatest speed in a rollout, for every position or by action key, in its unit a second; 2 rad/s by
            default where that unit is an angle.

    Raises:
        ValidationError: an argument outside its domain, or a device that lacks a part of the interface.
    """

    runs_policies = True
    """Its ``policy_provider`` is one of :mod:`strands_robots.policies`, on real hardware."""

    def __init__(
        self,
        device: Any,
        tool_name: str = "robot",
        control_hz: float | None = None,
        *,
        joint_ranges: Mapping[str, tuple[float, float]] | None = None,
        stop_level: StopLevel | Literal["release"] | None = None,
        rest_pose: Mapping[str, float] | None = None,
        model: str | None = None,
        speed_limit: float | Mapping[str, float] | None = None,
    ) -> None:
        name = text("tool_name", tool_name, longest=128)
        rate = settings.number("STRANDS_CONTROL_HZ") if control_hz is None else control_hz
        level = checked_level(stop_level, rest_pose)
        self.tool_name_str = name
        self.control_hz = number("control_hz", rate, low=1, high=2000)
        self.device = device
        self._body = DeviceBody(name, device, joint_ranges, level, speed_limit)
        self.tasks = TaskEngine(
            name, self.body, facts=lambda _: self.policy_facts(), rate=lambda: self.control_hz, ready=self._make_ready
        )
        self.gate, self.starting, self.observers = self.tasks.gate, self.tasks.starting, self.tasks.observers
        self._settling = _settling_of(self._body, self.tasks, level, rest_pose)
        self._arm: Arm | None = None
        self._model = None if model is None else text("model", model)
        self._ready, self._readying = False, threading.Lock()
        self._frozen_at = -1
        self._latest_halt: StopVerdict | PendingVerdict = StopVerdict()

    @property
    def safety_key(self) -> str:
        """Return the hardware's own id, the key of its lockout; empty for none."""
        given = getattr(self.device, "safety_key", "")
        if given:
            return str(given)
        own = stable_id(self.device)
        return "" if own is None else hardware_key(kind(self.device), own)

    def connect(self) -> None:
        """Connect the device without calibration, again after its port was gone.

        Raises what the device raises.
        """
        self._body.connect()
        self._stand_by()
        if self.gate.refusal("connect") is not None:
            # The halt found no port: a servo that is back goes on to its last goal. Whoever plugged it in is near it.
            if self._settling is not None:
                self._settling.take()
            verdict = self.halt("it is locked and connected again")
            if not verdict.stopped:
                raise ConnectionError(f"{self.tool_name_str} is locked: {verdict.envelope()['reason']}")

    def get_features(self) -> Envelope:
        """Return observation and action features as data, with ranges."""
        return success(
            f"{len(self._body.bounds)} action keys.",
            observation_features={
                key: feature_type(feature) for key, feature in self.device.observation_features.items()
            },
            action_features={key: feature_type(feature) for key, feature in self.device.action_features.items()},
            ranges={key: [low, high] for key, (low, high) in self._body.bounds.items() if high - low < float("inf")},
            joint_units=self.joint_units,
        )

    def get_state(self) -> Envelope:
        """``joints`` by name in the device's unit, ``joints_age_s``, and ``task``.

        While a loop drives the robot the joints are those of its last read, at most two control periods old, or read
        in a turn on the bus that is waited for for at most a control period; while nothing does, for at most 1 s.
        Where no turn comes, or a stop waits for the bus, they are those of the last read, and ``joints_error`` says
        why. A camera that fails does not touch them.
        """
        led = bool(self.tasks.driving())
        problem = self._body.refresh(led=led, rate=self.control_hz)
        age, joints = self._body.latest_joints or (None, {})
        fields: dict[str, Any] = {"joints": joints, "task": self._task_fields()}
        fields["joints_age_s"] = None if age is None else round(age, 4)
        if problem:
            fields["joints_error"] = problem
        return success(problem or f"{len(joints)} joints.", **fields)

    @property
    def is_connected(self) -> bool:
        """The device is connected, and its port is there."""
        return self._body.is_connected and not self._body.lost

    @property
    def hardware_name(self) -> str:
        """The device's type, such as ``so100_follower``."""
        return kind(self.device)

    @property
    def joint_units(self) -> dict[str, str]:
        """Return the unit by action key; a key without a stated unit is left out.

        ``normalized`` (-100 to 100), ``percent`` (0 to 100), ``degrees`` or the device's own.
        """
        return joint_units(self.device)

    def get_health(self) -> Envelope:
        """Return ``temps``, Celsius by motor; wait a control period for the bus."""
        if not self._body.is_connected or self._body.lost or not has_temperatures(self.device):
            return success("Nothing is known of its motors' health.")
        if not self._body.lock.acquire(timeout=1 / self.control_hz):
            return error("The bus was busy; the motors' temperatures are not known now.")
        try:
            if self._body.stop_waits:
                return error("A stop waits for the bus; the motors' temperatures are not known now.")
            temps = temperatures(self.device)
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the answer says what
            return error(f"The motors' temperatures could not be read: {type(exc).__name__}: {exc}")
        finally:
            self._body.lock.release()
        return success(f"The warmest motor has {max(temps.values(), default=0.0):g} degrees Celsius.", temps=temps)

    def get_observation(self) -> dict[str, Any]:
        """Read joints and images in its turn on the bus."""
        return self._body.get_observation()

    def camera_frames(self) -> Mapping[str, Any]:
        """Return the newest RGB picture (height, width, 3) of each camera.

        A picture is taken when it is asked for by its name; that raises what its camera raises.
        """
        cameras = getattr(self.device, "cameras", None)
        return LazyFrames({str(name): partial(_picture, camera) for name, camera in (cameras or {}).items()})

    def send_action(self, action: Mapping[str, float], *, request: MotionRequest | None = None) -> Envelope:
        """Set targets once; ``sent`` has the values taken. Refused while it is driven."""
        try:
            permit = self.gate.permit("send_action", request)
            with self.tasks.line(self.tool_name_str):
                self._stand_by()
                self.tasks.require_free(self.tool_name_str)
                targets = checked_action(dict(action) if isinstance(action, Mapping) else action, self._body.bounds)
            with self.tasks.sending(permit):
                sent = self._body.send_action(targets, permit)
        except MotionRefused as refused:
            return refused.envelope
        except PermitVoidError as void:
            return error(f"send_action was overtaken by a stop: {void}.")
        except Exception as exc:
            if not isinstance(exc, ValidationError):
                logger.exception("%s did not take an action.", self.tool_name_str)
            return error(str(exc) if isinstance(exc, ValidationError) else f"{type(exc).__name__}: {exc}")
        return success(f"Sent {len(targets)} targets.", sent=dict(sent))

    def policy_facts(self) -> RobotFacts:
        """Return what a policy is checked against; the joints are read."""
        pictures = {key: tuple(shape) for key, shape in self.device.observation_features.items() if is_picture(shape)}
        return RobotFacts(
            self.tool_name_str,
            numbers(self._body.get_joints()),
            list(self._body.bounds),
            joint_units(self.device),
            {key: (size[0], size[1], size[2]) for key, size in pictures.items()},
            self.control_hz,
            self._body.bounds,
            kind(self.device),
        )

    def body(self, robot_name: str | None = None) -> DeviceBody:
        """The one body of this robot, by its name or without one."""
        if robot_name not in (None, "", self.tool_name_str):
            raise ValidationError(f"robot_name must be {self.tool_name_str}, not {robot_name!r}.")
        return self._body

    def arm(self, robot_name: str = "") -> Arm:
        """Return the arm. Raises :class:`ValidationError` where no model of it fits."""
        from strands_robots.hardware.arm import arm_of  # noqa: PLC0415 - numpy and MuJoCo, with the first motion

        body = self.body(robot_name)
        if self._arm is None:
            self._arm = arm_of(self.device, body.bounds, self._model, body.speeds)
        return self._arm

    def arm_parts(self, robot_name: str = "") -> ArmParts:
        """Return what the device has of an arm; of its model once that is loaded."""
        body, arm = self.body(robot_name), self._arm
        return arm_parts(self.device, body.bounds, self._model) if arm is None else arm.parts

    def stated_joints(self, robot_name: str = "") -> Sequence[StatedJoint]:
        """Return the joints that a device without a known model states."""
        body = self.body(robot_name)
        known = model_name(self.device, self._model)
        return () if known else stated_joints(self.device, body.bounds, body.speeds)

    def still_action(self, robot_name: str = "") -> Action:
        """Return the targets that leave every joint where it was told to be, or is."""
        body = self.body(robot_name)
        _, observed = body.latest_joints or (None, {})
        return still_action(self.device, body.bounds, body.targets, observed)

    @property
    def has_cameras(self) -> bool:
        """True where the device has a camera."""
        return bool(getattr(self.device, "cameras", None))

    @property
    def releases_torque(self) -> bool:
        """True where the torque of the motors can be switched off."""
        return bool(self._body.motors)

    def targets(self, robot_name: str = "") -> Mapping[str, float]:
        """Return the last action; empty once the arm was frozen or let go."""
        return self.body(robot_name).targets

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every task event until the returned callable is called."""
        return self.observers.subscribe(observer)

    def start_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        *,
        request: MotionRequest | None = None,
        **policy: Any,
    ) -> Envelope:
        """Start a task and return at once; refused while something drives the robot.

        Args:
            instruction: what it shall do, 1 to 2000 characters.
            policy_provider: a registered policy, such as mock, remote or lerobot_local.
            duration: seconds, above 0 up to an hour.
            policy_port: port of the policy's server; 0 for the provider's own.
            request: what it begins for; made now by default.
            policy: what that policy's constructor takes besides, ``control_frequency`` (Hz, at most the robot's rate)
                and ``n_steps`` (actions after which it ends).
        """
        try:
            new = self.tasks.of_policy(instruction, policy_provider, duration, {"policy_port": policy_port, **policy})
            task = self.tasks.start("start_task", self.tool_name_str, new, request)
        except REFUSALS as refused:
            return refusal_envelope("start_task", refused)
        problem = task.not_begun()
        if problem:
            return error(f"start_task: {problem}.", **self._task_fields())
        return success(
            f"{self.tool_name_str} started: {task.instruction}.{instruction_note(task)}",
            task_status="running",
            follows_instruction=task.follows_instruction,
            instruction=task.instruction,
            policy=task.policy_name,
            duration=task.duration,
        )

    @answered
    def run_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        **policy: Any,
    ) -> Envelope:
        """Run a task to its end; an error when the policy failed or ran too long."""
        new = self.tasks.of_policy(instruction, policy_provider, duration, {"policy_port": policy_port, **policy})
        task = self.tasks.start("start_task", self.tool_name_str, new)
        if not task.join((task.duration or 0.0) + WIND_DOWN_S):
            task.request_stop()
            return error(f"The task was still running {WIND_DOWN_S:g} s after its time.", **self._task_fields())
        if task.state == "error":
            return error(f"The task failed: {task.error}", **self._task_fields())
        return success(f"The task {task.state} after {task.step_count} steps.", **self._task_fields())

    def stop_task(self) -> Envelope:
        """Stop the task and freeze the robot, within the halt deadline."""
        self.tasks.waiting.void()
        if self.gate.under_way or self.tasks.leading():
            return self.halt("stop_task").envelope()
        task = self.tasks.by_body.get(self.tool_name_str)
        if task is None or not task.running:
            return success("No task runs.", stopped=True, was_running=False, **self._task_fields())
        task.void()
        verdict = stop_executor().halt(TaskStop(self._body, task), self.tool_name_str, "stop_task")
        fields = {"stopped": bool(verdict.stopped), "was_running": True, **self._task_fields()}
        if verdict.stopped:
            return success(f"Stopped after {task.step_count} steps.", **fields)
        return error(next(iter([*verdict.not_stopped.values(), *verdict.unknown.values()])), **fields)

    def get_task_status(self) -> Envelope:
        """Return the state of the current or last task.

        The session of a leader is one while it runs.

        ``task_status`` (idle, running, completed, stopped, error), ``instruction``, ``policy``, ``step_count``,
        ``duration`` (seconds it has taken), ``error`` and ``outcome``.
        """
        fields = self._task_fields()
        return success(f"Task {fields['task_status']} after {fields['step_count']} steps.", **fields)

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """Stop every motion and freeze, within ``STRANDS_HALT_DEADLINE_S``.

        Every permit is void first. A verdict of stopped means: no write is in flight, none will follow until a motion
        is started anew, and the robot was frozen. A bus that does not answer is ``not_stopped``, and the robot is
        frozen as soon as it does.
        """
        return stop_executor().halt(self, self.tool_name_str, reason)

    def halt_ordered(self) -> None:
        """Note what moves; a loop whose permit is void counts as halted."""
        self.tasks.note_motion()
        # A device that asks a daemon to stop does so at once, though a halt before this one still waits for it.
        note_motion(self.device)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Halt on the stop executor's thread, unless the bus blocks; wait for no loop."""
        ordered = self.gate.generation
        settles = self._settling is not None and self._settling.running
        if ordered == self._frozen_at and (settles or not self._body.driven):
            # A halt that waited for the bus when this one was ordered has frozen the robot for both.
            return self._latest_halt
        with self.tasks.halting(deadline) as halt, self._body.stopping():
            # A halt that was ordered while this one waited for the bus is served by this freeze.
            halt.generation = self.gate.generation
            self._body.stop()
            self._frozen_at = halt.generation
        self._latest_halt = halt.verdict
        return halt.verdict

    def release_here(self, motors: Collection[str], deadline: float) -> StopVerdict | PendingVerdict:
        """Halt and switch torque off on the stop executor's thread."""
        if self._settling is not None:
            self._settling.take()
        with self.tasks.halting(deadline, settles=False) as halt:
            self._body.release(motors)
        return halt.verdict

    def unanswered(self, why: str) -> StopVerdict:
        """Return the verdict while the bus does not answer."""
        if self._frozen_at == self.gate.generation:
            return RolloutsEnd((), self.tasks.void(), 0.0).unread(why)
        return unfrozen(why, self.tasks.noted())

    @answered
    def release_torque(self, motor_ids: str = "") -> Envelope:
        """Stop every motion and switch torque off, within the halt deadline.

        It works while the robot is locked. The torque comes back with the next motion.

        Args:
            motor_ids: motors, by name with commas; the others are frozen. Empty for all.
        """
        if not self._body.motors:
            return error(f"{self.tool_name_str} cannot switch the torque of its motors off.")
        asked = tuple(part.strip() for part in motor_ids.split(",") if part.strip())
        for motor in asked:
            choice("motor_ids", motor, self._body.motors)
        verdict = stop_executor().halt(TorqueRelease(self, ",".join(asked)), self.tool_name_str, "releaseTorque")
        answer = {**verdict.envelope(), "released": list(self._body.limp_motors)}
        queue_safety_event(
            "torque_released", self.tool_name_str, {"motors": answer["released"], "stopped": verdict.stopped}
        )
        if is_error(answer):
            return answer
        fields = {name: value for name, value in answer.items() if name not in ("status", "content")}
        return success(f"Torque is off: {', '.join(answer['released'])}.", **fields)

    def wait_settled(self) -> str:
        """Wait for the end of a settling, at most 6 s; return a sentence on it."""
        return self.tasks.settlings.wait()

    def cleanup(self) -> Envelope:
        """Halt and disconnect; a robot that did not stop or settle stays connected.

        A settling under way ends first.
        """
        self.wait_settled()
        verdict = self.halt("cleanup")
        if not verdict.stopped and (self._body.is_connected or self._body.driven or self._body.lost):
            return verdict.envelope()
        unsettled = self.wait_settled()
        if self._settling is not None and self._settling.state == "failed":
            return error(unsettled, stopped=True)
        with self._readying:
            if self._ready:
                stop_executor().detach(self)
                self._ready = False
        if self._body.is_connected:
            try:
                with self._body.lock:
                    self.device.disconnect()
            except Exception as exc:
                logger.exception("%s did not disconnect.", self.tool_name_str)
                return error(f"Halted, but the device did not disconnect: {type(exc).__name__}: {exc}")
        if not verdict.stopped:
            return success("It was not connected; whether it moves is not known.", stopped=None)
        return success("Halted and disconnected.", stopped=True)

    def _stand_by(self) -> None:
        """Have a thread ready for this robot's stops before its first motion."""
        with self._readying:
            if not self._ready:
                stop_executor().attach(self, self.tool_name_str)
                self._ready = True

    def _make_ready(self) -> None:
        """Connect again if the port is back, and have a thread ready for a stop."""
        if not self._ready:
            self._stand_by()
        if self._body.lost:
            try:
                self._body.connect()
            except Exception as exc:
                raise ValidationError(
                    f"{self.tool_name_str} lost its port and could not be connected again: {type(exc).__name__}: {exc}."
                ) from exc
            logger.warning("%s lost its port and is connected again.", self.tool_name_str)
        if not self._body.is_connected:
            raise ValidationError(f"{self.tool_name_str} is not connected; connect() it first.")

    def _task_fields(self) -> dict[str, Any]:
        task = next(iter(self.tasks.driving()), self.tasks.by_body.get(self.tool_name_str))
        return {
            "task_status": "idle" if task is None else task.state,
            "instruction": "" if task is None else task.instruction,
            "policy": "" if task is None else task.policy_name,
            "step_count": 0 if task is None else task.step_count,
            "clamped_steps": 0 if task is None else task.clamped_steps,
            "loop": {} if task is None else task.counts,
            "duration": 0.0 if task is None else round(task.elapsed_s, 3),
            "error": "" if task is None else task.error,
            "outcome": self.outcome_of(task),
            **({} if self._settling is None else {"settling": self._settling.state}),
        }


def _picture(camera: Any) -> Any:
    """Return the newest picture; older LeRobot cameras only give new ones."""
    newest = getattr(camera, "read_latest", None)
    return newest() if callable(newest) else camera.async_read()


@dataclass(frozen=True)
class TaskStop:
    """Stops a task that was asked to end, and leaves what waits to start."""

    body: DeviceBody
    task: Rollout

    def halt_ordered(self) -> None:
        """The caller has noted the task."""

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        try:
            self.body.stop()
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the verdict says what
            return self.unanswered(failure(self.body.name, exc))
        return RolloutsEnd((), {"task": self.task}, deadline)

    def unanswered(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={"task": why})


@dataclass(frozen=True)
class TorqueRelease(StopOfRobot):
    """Stops a robot and takes the torque of some motors, or all, away."""

    robot: HardwareRobot
    motors: str

    def stopped_robot(self) -> object:
        """Return the robot, whose own verbs it stops as well."""
        return self.robot

    def halt_ordered(self) -> None:
        """Note what moves."""
        self.robot.halt_ordered()

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        return self.robot.release_here(self.motors.split(",") if self.motors else (), deadline)

    def unanswered(self, why: str) -> StopVerdict:
        return self.robot.unanswered(why)


def _settling_of(body: DeviceBody, tasks: TaskEngine, level: StopLevel, rest_pose: object) -> Settling | None:
    """Return the settling that a stop level asks for; check the pose in any case."""
    if rest_pose is None:
        return None
    ranges = {key: each for key, each in body.bounds.items() if not is_velocity(key)}
    pose = checked_rest_pose(rest_pose, ranges)
    if level != "settle":
        return None
    settling = Settling(body, tasks.gate, pose, ranges, tasks.observers)
    tasks.gate.watch(settling.note_motion)
    tasks.settlings.by_body = {body.name: settling}
    return settling
