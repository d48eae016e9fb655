"""Physics of one world in real time, and the lock discipline of simulations.

This is the only place that documents it. A world has three locks, always taken in this order, and one published value:

1. The *starting lock* (``Simulation.starting``, re-entrant) is held while the world is rebuilt or reset, and while a
   rollout or a teleoperation starts; a start takes the lock of its robot's line before it (``TaskEngine.line``). A stop
   takes neither, so nothing that is built or loaded delays a stop.
2. The *step lock* protects the model and the data. The stepping thread holds it for one chunk of steps.
3. The *command lock* protects the setpoints. A writer holds it for the few microseconds of a write, and checks its
   permit under it; the stepping thread holds it just as briefly, to copy the setpoints, before each chunk. So a
   command never waits for physics, and once :meth:`Physics.hold` has returned no earlier command can follow it.
4. The *snapshot* is an immutable copy of the state, replaced as a whole after each chunk. Every read (observations,
   state, pictures) takes the reference and no lock: a read never waits, and never sees half a step.

The holder of the command lock never asks for the step lock. Nothing calls foreign code under either. The locks of
:mod:`~strands_robots.simulation.physics` protect only counters and the list of worlds; physics never runs under them.
Pictures are drawn from a snapshot, on a thread of their own, without any of these locks.

Stepping releases the GIL, and thirty worlds that each wake a thread two hundred times a second would spend more
time passing it on than computing; one thread visits them in turn instead. A world runs while a rollout or a
teleoperation holds a lease (:meth:`WorldClock.running`), and for :data:`SETTLE_S` after a command. After a step by
hand commands alone start nothing until the next lease, so the same steps give the same numbers.
"""

from __future__ import annotations

import contextlib
import copy
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from strands_robots.safety.gate import Permit, PermitVoidError
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.model import CompiledScene, Floats, RobotParts
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, shown, yaw_of

T = TypeVar("T")

CHUNK = 128
"""Steps between two snapshots when stepping by hand: about a millisecond for an arm, 1 % of it for the snapshot."""

# Numbers of a joint in qpos and in qvel, by mjtJoint: free, ball, slide, hinge.
_QPOS = {0: 7, 1: 4, 2: 1, 3: 1}
_QVEL = {0: 6, 1: 3, 2: 1, 3: 1}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State after a step: time in seconds, steps since the start; it never changes."""

    compiled: CompiledScene
    time: float
    steps: int
    qpos: Floats
    qvel: Floats
    lengths: Floats

    def joints(self, robot: RobotParts) -> dict[str, float]:
        """Return the joint positions by name: radians, or metres for a sliding joint."""
        qpos = self.qpos
        return {key: float(qpos[joint.qpos]) for key, joint in robot.joints.items()}

    def observation(self, robot: RobotParts) -> dict[str, float]:
        """Return joints, and ``base_x``, ``base_y`` (m), ``base_yaw`` (rad) of a base."""
        if robot.base is None:
            return self.joints(robot)
        x, y, _, *quat = (float(v) for v in self.qpos[robot.base : robot.base + 7])
        return {**self.joints(robot), "base_x": x, "base_y": y, "base_yaw": yaw_of(quat)}

    def pose(self, data: Any) -> None:
        """Put this state into ``data``, and compute bodies, sites, cameras and lights."""
        model = self.compiled.model
        data.qpos[:] = self.qpos
        data.qvel[:] = self.qvel
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def data(self) -> Any:
        """Return fresh MuJoCo data in this state; physics' own data is not touched."""
        data = mujoco.MjData(self.compiled.model)
        self.pose(data)
        return data


class Physics:
    """Model, data and setpoints of one world; thread-safe as the module says."""

    def __init__(self, compiled: CompiledScene) -> None:
        self._step_lock = threading.Lock()
        self._command_lock = threading.Lock()
        self._steps = 0
        self._model = compiled.model
        self._data = mujoco.MjData(compiled.model)
        self._setpoints = compiled.start_ctrl.copy()
        self._limp: frozenset[str] = frozenset()
        self._without_torque: frozenset[str] = frozenset()
        self.snapshot = self._start(compiled)

    @property
    def compiled(self) -> CompiledScene:
        """The compiled world of the last snapshot."""
        return self.snapshot.compiled

    @property
    def setpoints(self) -> Floats:
        """A copy of the present targets, in the model's actuator order."""
        with self._command_lock:
            return self._setpoints.copy()

    def advance(self, steps: int) -> None:
        """Take ``steps`` time steps in one chunk, with the setpoints of its start."""
        with self._step_lock:
            with self._command_lock:
                self._data.ctrl[:] = self._setpoints
                limp = self._limp
            if limp != self._without_torque:
                self._without_torque, self._model = limp, _without_torque(self.compiled, limp)
            mujoco.mj_step(self._model, self._data, nstep=steps)
            self._steps += steps
            self.snapshot = self._copy_state(self.compiled)
            if limp:
                with self._command_lock:
                    # The targets go along, so that torque that comes back keeps the robot where it is.
                    self._keep_present(self._robot(name) for name in self._limp)

    def command(self, robot_name: str, action: Mapping[str, float], permit: Permit | None = None) -> dict[str, float]:
        """Set targets of one robot, clamped to each actuator's range, and return them.

        Raises:
            PermitVoidError: ``permit`` is void; nothing was written.
            ValidationError: no such robot or key; nothing was written.
        """

        def write() -> dict[str, float]:
            actuators = self._robot(robot_name).actuators
            sent: dict[str, float] = {}
            for key, value in action.items():
                actuator = actuators.get(key)
                if actuator is None:
                    raise ValidationError(f"action has no key {shown(key)}; {robot_name} has {', '.join(actuators)}.")
                sent[key] = actuator.clamp(value)
            if permit is not None and not permit.valid:
                raise PermitVoidError(f"{robot_name} was halted")
            self._limp -= {robot_name}
            for key, value in sent.items():
                self._setpoints[actuators[key].index] = value
            return sent

        return _written(self._command_lock, write, permit)

    def hold(self, robot_name: str | None = None, permit: Permit | None = None) -> None:
        """Freeze one robot, or all.

        Servos keep their present position, everything else is commanded to zero. Nothing is
        written when ``permit`` was revoked: the halt that revoked it has frozen the robot.
        """
        with self._command_lock:
            if permit is not None and permit.revoked:
                return
            robots: Iterable[RobotParts] = (
                self.compiled.robots.values() if robot_name is None else (self._robot(robot_name),)
            )
            self._keep_present(robots)

    def release(self, robot_name: str | None = None, permit: Permit | None = None) -> None:
        """Switch the torque of one robot off, or of all, until its next command.

        Raises:
            PermitVoidError: ``permit`` is void; nothing was changed.
        """

        def write() -> None:
            if permit is not None and not permit.valid:
                raise PermitVoidError(f"{robot_name} was halted")
            self._limp |= frozenset(self.compiled.robots if robot_name is None else (self._robot(robot_name).name,))

        _written(self._command_lock, write, permit)

    @property
    def limp(self) -> frozenset[str]:
        """Names of the robots without torque."""
        return self._limp

    def reset(self, permit: Permit) -> None:
        """Go back to the start state; the step count goes on.

        Raises:
            MotionRefused: ``permit`` is void; nothing was changed.
        """
        permit.wait()
        with self._step_lock, self._command_lock:
            permit.check()
            self.snapshot = self._start(self.compiled)

    def replace(self, compiled: CompiledScene) -> None:
        """Switch to another scene; what both have by name keeps state and setpoint."""
        with self._step_lock, self._command_lock:
            old_model, old_data, old_setpoints = self._model, self._data, self._setpoints
            self._model, self._without_torque = compiled.model, frozenset()
            self._limp &= frozenset(compiled.robots)
            self._data = mujoco.MjData(compiled.model)
            self._setpoints = compiled.start_ctrl.copy()
            self._data.qpos[:] = compiled.start_qpos
            self._data.time = old_data.time
            _carry_state(old_model, old_data, self._model, self._data)
            _carry_setpoints(old_model, old_setpoints, self._model, self._setpoints)
            mujoco.mj_forward(self._model, self._data)
            self.snapshot = self._copy_state(compiled)

    @property
    def diverged(self) -> bool:
        """True once MuJoCo reset a diverging world since the last reset."""
        warnings = self._data.warning
        kinds = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        return any(warnings[kind].number for kind in kinds)

    def _robot(self, name: str) -> RobotParts:
        robot = self.compiled.robots.get(name)
        if robot is None:
            raise ValidationError(f"robot_name must be one of {list(self.compiled.robots)}, not {shown(name)}.")
        return robot

    def _keep_present(self, robots: Iterable[RobotParts]) -> None:
        lengths = self.snapshot.lengths
        for robot in robots:
            for actuator in robot.actuators.values():
                self._setpoints[actuator.index] = actuator.still(float(lengths[actuator.index]))

    def _start(self, compiled: CompiledScene) -> Snapshot:
        self._limp = frozenset()
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = compiled.start_qpos
        self._data.ctrl[:] = compiled.start_ctrl
        self._setpoints = compiled.start_ctrl.copy()
        mujoco.mj_forward(self._model, self._data)
        return self._copy_state(compiled)

    def _copy_state(self, compiled: CompiledScene) -> Snapshot:
        data = self._data
        lengths = data.actuator_length.copy()
        return Snapshot(compiled, data.time, self._steps, data.qpos.copy(), data.qvel.copy(), lengths)


def _written(lock: threading.Lock, write: Callable[[], T], permit: Permit | None) -> T:
    """Run a write under the command lock, once no hold is left for its permit."""
    if permit is not None:
        return permit.write(lock, write)
    with lock:
        return write()


def _without_torque(compiled: CompiledScene, robots: Iterable[str]) -> Any:
    """Return the model with actuators of ``robots`` that exert no force."""
    if not robots:
        return compiled.model
    model = copy.copy(compiled.model)
    for name in robots:
        for actuator in compiled.robots[name].actuators.values():
            at = actuator.index
            model.actuator_gaintype[at] = mujoco.mjtGain.mjGAIN_FIXED
            model.actuator_biastype[at] = mujoco.mjtBias.mjBIAS_NONE
            model.actuator_gainprm[at], model.actuator_biasprm[at] = 0.0, 0.0
    return model


def _carry_state(old_model: Any, old: Any, new_model: Any, new: Any) -> None:
    """Copy position and velocity of the joints that both models have by name."""
    before = {old_model.joint(i).name: i for i in range(old_model.njnt)}
    for index in range(new_model.njnt):
        source = before.get(new_model.joint(index).name)
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


logger = stop_logger(__name__)

TICK_S = 0.005
"""Period in which the pacing thread visits each running world."""

WORLDS_A_TICK = 10
"""Worlds visited every tick. More are visited less often, in longer steps, because every visit has to get the
interpreter back from the threads that ran meanwhile."""

SETTLE_S = 2.0
"""Seconds that physics goes on after a single command."""

MAX_BEHIND_S = 1.0
"""A world that is further behind real time than this drops the rest: it will not catch up."""

VISIT_S = 0.01
"""Longest visit while a world catches up, so that it does not starve the others."""

_CHUNK = 16


class WorldClock:
    """Pacing of one world; ``slipped_s`` is simulated time dropped when late.

    Args:
        held: returns True while no robot of the world may move; its time then stands still, and is not made up for.
    """

    def __init__(self, physics: Physics, *, on_command: bool = True, held: Callable[[], bool] = lambda: False) -> None:
        self._physics = physics
        self._held = held
        self._on_command = on_command
        self._lock = threading.Lock()
        self._leases = 0
        self._until = 0.0
        self._by_hand = False
        self._due: float | None = None
        self.slipped_s = 0.0
        self.paced_s = 0.0
        self.closed = False

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Take a lease: real time passes while it is held, and for a moment afterwards."""
        with self._lock:
            self._leases += 1
            self._by_hand = False
        _pacer.wake(self)
        try:
            yield
        finally:
            with self._lock:
                self._leases -= 1
                self._until = time.monotonic() + SETTLE_S / 4

    def commanded(self) -> None:
        """Let physics follow a new setpoint, unless the world is stepped by hand."""
        with self._lock:
            if self.closed or self._by_hand or not self._on_command:
                return
            self._until = time.monotonic() + SETTLE_S
        _pacer.wake(self)

    def by_hand(self) -> None:
        """Mark a step by hand: commands alone do not start the clock from now on."""
        with self._lock:
            self._by_hand = True
            self._until = 0.0

    def close(self) -> None:
        """Stop for good; return when the pacing thread has left this world."""
        with self._lock:
            self.closed = True
        _pacer.forget(self)

    @property
    def wanted(self) -> bool:
        """True while real time should pass."""
        with self._lock:
            return not self.closed and (self._leases > 0 or time.monotonic() < self._until)

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds for each real one: 1.0 unless the machine is too slow."""
        with self._lock:
            return 1.0 if self.paced_s <= 0 else max(0.0, 1.0 - self.slipped_s / self.paced_s)

    def tick(self, now: float) -> None:
        """Catch up with ``now``; called by the pacing thread alone."""
        timestep = self._physics.compiled.scene.timestep
        if self._due is None or self._held():
            self._due = now
            return
        behind = now - self._due
        if behind > MAX_BEHIND_S:
            with self._lock:
                self.slipped_s += behind - MAX_BEHIND_S
                self.paced_s += behind - MAX_BEHIND_S
            self._due = now - MAX_BEHIND_S
            behind = MAX_BEHIND_S
        left = int(behind / timestep)
        leave = time.monotonic() + VISIT_S
        while left:
            steps = min(left, _CHUNK)
            self._physics.advance(steps)
            left -= steps
            self._due += steps * timestep
            with self._lock:
                self.paced_s += steps * timestep
            if time.monotonic() > leave:
                return

    def rest(self) -> None:
        """Forget when the next step was due, because nothing runs any more."""
        self._due = None


class _Pacer:
    """The pacing thread and the worlds it visits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clocks: list[WorldClock] = []
        self._thread: threading.Thread | None = None

    def wake(self, clock: WorldClock) -> None:
        with self._lock:
            if clock.closed:
                return
            if clock not in self._clocks:
                self._clocks.append(clock)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="simulation-pacer", daemon=True)
                self._thread.start()

    def forget(self, clock: WorldClock) -> None:
        """Remove ``clock``, and wait for the end of the thread when it was the last."""
        with self._lock:
            thread = self._thread
            if clock in self._clocks:
                self._clocks.remove(clock)
            others = bool(self._clocks)
        if thread is not None and thread is not threading.current_thread() and not others:
            thread.join(timeout=2.0)

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            clocks = self._still_running()
            if not clocks:
                return
            now = time.monotonic()
            for clock in clocks:
                self._visit(clock, now)
            due = max(due + TICK_S * max(1.0, len(clocks) / WORLDS_A_TICK), time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))

    def _still_running(self) -> list[WorldClock]:
        """Return the clocks that still run; without any, mark the thread as ended."""
        with self._lock:
            for clock in [c for c in self._clocks if not c.wanted]:
                self._clocks.remove(clock)
                clock.rest()
            if not self._clocks:
                self._thread = None
            return list(self._clocks)

    def _visit(self, clock: WorldClock, now: float) -> None:
        try:
            clock.tick(now)
        except Exception:
            logger.exception("A simulated world cannot be stepped and is paused for good.")
            with self._lock:
                clock.closed = True


_pacer = _Pacer()
