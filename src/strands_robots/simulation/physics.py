"""The physics of one world, and its lock discipline, which is written down here and nowhere else.

There are two locks, always taken in this order, and one published value:

1. The *step lock* owns the model and the data. Whoever advances physics holds it for one chunk of steps.
2. The *command lock* owns the setpoints. A writer holds it for the few microseconds of a write, and checks its
   permit under it; the stepper holds it just as briefly, to copy the setpoints, before each chunk. So a command
   never waits for physics, and once :meth:`Physics.hold` has returned no earlier command can follow it.
3. The *snapshot* is an immutable copy of the state, replaced whole after each chunk. Every read (observations,
   state, pictures) takes the reference and no lock: a read never waits at all, and never sees half a step.

The holder of the command lock never asks for the step lock. Nothing calls foreign code under either.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from strands_robots.safety.gate import Permit, PermitVoidError
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.parts import Actuator, RobotParts
from strands_robots.simulation.stage import Floats, Stage
from strands_robots.utils import ValidationError, shown

CHUNK = 128
"""Steps between two snapshots when stepping by hand: about a millisecond for an arm, 1 % of it for the snapshot."""


# Numbers a joint has in qpos and in qvel, by mjtJoint: free, ball, slide, hinge.
_QPOS = {0: 7, 1: 4, 2: 1, 3: 1}
_QVEL = {0: 6, 1: 3, 2: 1, 3: 1}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state after some step. ``time`` in seconds, ``steps`` since the world was made; the arrays never change."""

    stage: Stage
    time: float
    steps: int
    qpos: Floats
    qvel: Floats
    lengths: Floats

    def joints(self, robot: RobotParts) -> dict[str, float]:
        """Joint positions by name: radians, or metres for a sliding joint."""
        qpos = self.qpos
        return {key: float(qpos[joint.qpos]) for key, joint in robot.joints.items()}

    def velocities(self, robot: RobotParts) -> dict[str, float]:
        """Joint velocities by name: rad/s, or m/s for a sliding joint."""
        return {key: float(self.qvel[joint.qvel]) for key, joint in robot.joints.items()}

    def base_pose(self, robot: RobotParts) -> dict[str, float]:
        """``base_x`` and ``base_y`` (m) and ``base_yaw`` (rad) of a robot that moves about; else nothing."""
        if robot.base is None:
            return {}
        x, y, _, w, i, j, k = (float(v) for v in self.qpos[robot.base : robot.base + 7])
        yaw = float(np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)))
        return {"base_x": x, "base_y": y, "base_yaw": yaw}


class Physics:
    """One world's model, data and setpoints. Thread-safe as the module's text says."""

    def __init__(self, stage: Stage) -> None:
        self._step_lock = threading.Lock()
        self._command_lock = threading.Lock()
        self._steps = 0
        self._model = stage.model
        self._data = mujoco.MjData(stage.model)
        self._setpoints = stage.start_ctrl.copy()
        self.snapshot = self._start(stage)

    @property
    def stage(self) -> Stage:
        return self.snapshot.stage

    @property
    def setpoints(self) -> Floats:
        """A copy of the present targets, in the model's actuator order."""
        with self._command_lock:
            return self._setpoints.copy()

    def advance(self, steps: int) -> None:
        """Take ``steps`` time steps in one chunk, with the setpoints as they are at its start."""
        with self._step_lock:
            with self._command_lock:
                self._data.ctrl[:] = self._setpoints
            mujoco.mj_step(self._model, self._data, nstep=steps)
            self._steps += steps
            self.snapshot = self._seen(self.stage)

    def command(self, robot_name: str, action: Mapping[str, float], permit: Permit | None = None) -> dict[str, float]:
        """Set targets of one robot; the answer is what was really set, clamped to each actuator's range.

        Raises:
            PermitVoidError: ``permit`` is void; nothing was written.
            ValidationError: the robot or a key is not there; nothing was written.
        """
        with self._command_lock:
            actuators = self._robot(robot_name).actuators
            sent: dict[str, float] = {}
            for key, value in action.items():
                actuator = actuators.get(key)
                if actuator is None:
                    raise ValidationError(f"action has no key {shown(key)}; {robot_name} has {', '.join(actuators)}.")
                sent[key] = actuator.clamp(value)
            if permit is not None and not permit.valid:
                raise PermitVoidError(f"{robot_name} was halted")
            for key, value in sent.items():
                self._setpoints[actuators[key].index] = value
            return sent

    def hold(self, robot_name: str | None = None, permit: Permit | None = None) -> None:
        """Freeze one robot, or all: servos hold where they are now, everything else is commanded to zero.

        Nothing is written when ``permit`` was revoked: the halt that did it has frozen the robot.
        """
        with self._command_lock:
            if permit is not None and permit.revoked:
                return
            robots: Iterable[RobotParts] = (
                self.stage.robots.values() if robot_name is None else (self._robot(robot_name),)
            )
            lengths = self.snapshot.lengths
            for robot in robots:
                for actuator in robot.actuators.values():
                    self._setpoints[actuator.index] = _still(actuator, lengths)

    def reset(self, permit: Permit) -> None:
        """Back to the start state; the step count goes on. Raises :class:`MotionRefused` when ``permit`` is void."""
        with self._step_lock, self._command_lock:
            permit.check()
            self.snapshot = self._start(self.stage)

    def replace(self, stage: Stage) -> None:
        """Go on with another stage: what is in both, by name, keeps its position, velocity and setpoint."""
        with self._step_lock, self._command_lock:
            old_model, old_data, old_setpoints = self._model, self._data, self._setpoints
            self._model = stage.model
            self._data = mujoco.MjData(stage.model)
            self._setpoints = stage.start_ctrl.copy()
            self._data.qpos[:] = stage.start_qpos
            self._data.time = old_data.time
            _carry_state(old_model, old_data, self._model, self._data)
            _carry_setpoints(old_model, old_setpoints, self._model, self._setpoints)
            mujoco.mj_forward(self._model, self._data)
            self.snapshot = self._seen(stage)

    @property
    def diverged(self) -> bool:
        """True once MuJoCo had to reset the world because a number ran away since the last reset."""
        warnings = self._data.warning
        kinds = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        return any(warnings[kind].number for kind in kinds)

    def _robot(self, name: str) -> RobotParts:
        robot = self.stage.robots.get(name)
        if robot is None:
            raise ValidationError(f"robot_name must be one of {list(self.stage.robots)}, not {shown(name)}.")
        return robot

    def _start(self, stage: Stage) -> Snapshot:
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = stage.start_qpos
        self._data.ctrl[:] = stage.start_ctrl
        self._setpoints = stage.start_ctrl.copy()
        mujoco.mj_forward(self._model, self._data)
        return self._seen(stage)

    def _seen(self, stage: Stage) -> Snapshot:
        data = self._data
        return Snapshot(
            stage,
            data.time,
            self._steps,
            data.qpos.copy(),
            data.qvel.copy(),
            data.actuator_length.copy(),
        )


def _still(actuator: Actuator, lengths: Floats) -> float:
    return actuator.clamp(float(lengths[actuator.index]) if actuator.servo else 0.0)


def _carry_state(old_model: Any, old: Any, new_model: Any, new: Any) -> None:
    """Copy position and velocity of the joints that both models have by name."""
    theirs = {old_model.joint(i).name: i for i in range(old_model.njnt)}
    for index in range(new_model.njnt):
        source = theirs.get(new_model.joint(index).name)
        if source is None or old_model.jnt_type[source] != new_model.jnt_type[index]:
            continue
        kind = int(new_model.jnt_type[index])
        for width, old_at, new_at, old_values, new_values in (
            (_QPOS[kind], old_model.jnt_qposadr[source], new_model.jnt_qposadr[index], old.qpos, new.qpos),
            (_QVEL[kind], old_model.jnt_dofadr[source], new_model.jnt_dofadr[index], old.qvel, new.qvel),
        ):
            new_values[new_at : new_at + width] = old_values[old_at : old_at + width]


def _carry_setpoints(old_model: Any, old_ctrl: Floats, new_model: Any, new_ctrl: Floats) -> None:
    """Copy the setpoints of the actuators that both models have by name."""
    commands = {old_model.actuator(i).name: i for i in range(old_model.nu)}
    for index in range(new_model.nu):
        at = commands.get(new_model.actuator(index).name)
        if at is not None:
            new_ctrl[index] = old_ctrl[at]
