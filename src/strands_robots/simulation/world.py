"""``Simulation``: a MuJoCo world with robots in it, behind the robot contract."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from strands_robots import settings
from strands_robots.arm_mixin import ArmMixin
from strands_robots.contract import Observer, Unsubscribe
from strands_robots.envelope import Envelope, error, success
from strands_robots.kinematics import ArmParts
from strands_robots.kinematics.arm import Arm
from strands_robots.kinematics.objects import SeenObject
from strands_robots.policies.base import SPEED_MAX
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.rollout import (
    STOP_JOIN_S,
    Rollout,
    instruction_note,
)
from strands_robots.policies.task_engine import TaskEngine
from strands_robots.safety.gate import MotionRequest, answered
from strands_robots.safety.stop_targets import halted_with_verbs
from strands_robots.safety.stopping import PendingVerdict, StopLevel, StopVerdict, halts_in_parts, read_verdict
from strands_robots.simulation.body import RobotBody, StopTorque, targets_of
from strands_robots.simulation.model import PICTURE, compile_scene, in_floor, sunk_sentence
from strands_robots.simulation.physics import CHUNK, Physics, WorldClock
from strands_robots.simulation.rendering import PicturesMixin, Renderer, camera_names
from strands_robots.simulation.scene import Scene, SceneObject, SceneRobot
from strands_robots.stop_log import stop_logger
from strands_robots.teleop_mixin import TeleopMixin
from strands_robots.utils import ValidationError, choice, flag, identifier, number, shown, text, whole

logger = stop_logger(__name__)

STEPS_MAX = 1_000_000
"""Most steps of one call: about half a minute of computing for one arm."""

TEARDOWN_S = 5.0
"""How much longer than its duration :meth:`Simulation.run_policy` waits for a rollout to end."""


class _CleanedUp:
    """Latch of a world that was cleaned up."""

    def refusal(self, verb: str) -> Envelope:
        return error(f"{verb} is refused: this simulation was cleaned up; make a new one.")


class Simulation(PicturesMixin, ArmMixin, TeleopMixin):
    """A world of simulated robots, each with its own rollout: a :class:`WorldRobot`.

    Physics keeps real time while a rollout or a teleoperation runs, and for a moment after a single command;
    :meth:`step` advances it as fast as it computes. Verbs answer envelopes; a wrong argument is refused by name and
    nothing moves. The contents of the world change only while no rollout and no teleoperation runs.
    :mod:`~strands_robots.simulation.physics` documents the locks.

    Args:
        tool_name: name of the simulation on a network.
        timestep: physics step in seconds, 0.0001 to 0.02.
        gravity: along z, m/s².
        density: of the medium, kg/m³: 0 without one, 1.2 for air, 1000 for water; at most 20,000.
        viscosity: of the medium, Pa·s, 0 to 1000.
        realtime: false if single commands shall start no clock, so that only :meth:`step` and rollouts move time.
        stop_level: ``hold``, ``limp`` or ``settle``, as of a real robot; by default as ``STRANDS_ESTOP_TORQUE`` says.
        rest_pose: where an arm that settles goes: a target for each position servo, or those by robot.
        speed_limit: greatest speed of every position servo in a rollout, radians or metres a second; None for none.

    Raises:
        ValidationError: an argument outside its domain.
    """

    knows_objects = True

    def __init__(
        self,
        tool_name: str = "simulation",
        *,
        timestep: float = 0.002,
        gravity: float = -9.81,
        density: float = 0.0,
        viscosity: float = 0.0,
        realtime: bool = True,
        speed_limit: float | None = None,
        stop_level: StopLevel | Literal["release"] | None = None,
        rest_pose: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.tool_name_str = text("tool_name", tool_name, longest=128)
        self.tasks = TaskEngine(
            self.tool_name_str,
            self.body,
            facts=self.policy_facts,
            rate=lambda: settings.number("STRANDS_CONTROL_HZ"),
            ready=self._require_open,
            of_world=True,
        )
        self.gate, self.starting, self.observers = self.tasks.gate, self.tasks.starting, self.tasks.observers
        self._torque = StopTorque(stop_level, rest_pose, self.tasks)
        self.physics = Physics(compile_scene(Scene.checked(timestep, gravity, density, viscosity)))
        self._clock = WorldClock(self.physics, on_command=flag("realtime", realtime), held=lambda: self.gate.held)
        self._speed_limit = None if speed_limit is None else number("speed_limit", speed_limit, above=0, high=SPEED_MAX)
        self._bodies: dict[str, RobotBody] = {}
        self._renderer = Renderer()
        self._closed = False

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Call ``observer`` with every rollout event; the returned callable ends that."""
        return self.observers.subscribe(observer)

    def list_robots(self) -> list[str]:
        """Return the robots' names, in the order in which they were added."""
        return list(self._bodies)

    def body(self, robot_name: str | None = None) -> RobotBody:
        """Return one robot of the world; without a name, the first.

        Raises:
            ValidationError: no robot of that name, or none at all.
        """
        bodies = self._bodies
        if not bodies:
            raise ValidationError("there is no robot in this world yet; add_robot(name, model) adds one.")
        if robot_name is None or robot_name == "":
            return next(iter(bodies.values()))
        body = bodies.get(robot_name) if isinstance(robot_name, str) else None
        if body is None:
            raise ValidationError(f"robot_name must be one of {', '.join(bodies)}, not {shown(robot_name)}.")
        return body

    @answered
    def create_world(
        self, timestep: float = 0.002, gravity: float = -9.81, *, density: float = 0.0, viscosity: float = 0.0
    ) -> Envelope:
        """Start over with an empty world.

        Args:
            timestep: 0.0001 to 0.02 s.
            gravity: along z, -100 to 100 m/s².
            density: of the medium, 0 to 20,000 kg/m³.
            viscosity: of the medium, 0 to 1000 Pa·s.
        """
        scene = Scene.checked(timestep, gravity, density, viscosity)
        with self.starting:
            self._require_idle("create_world")
            permit = self.gate.permit("create_world")
            self._rebuild(scene)
            self.physics.reset(permit)
        return success("An empty world with a floor.", timestep=scene.timestep, gravity=scene.gravity)

    @answered
    def add_robot(
        self,
        name: str = "so100",
        model: str | Path | None = None,
        position: Any = None,
        yaw: float = 0.0,
        *,
        tip: str = "",
    ) -> Envelope:
        """Put a robot into the world; the others keep their state.

        Args:
            name: its name in this world, an identifier that no robot or object has.
            model: ``so100``, ``so101``, ``rover``, the path of an MJCF or URDF file, or a ``robot_descriptions``
                name; by default ``name``.
            position: of its base, metres; by default beside the robots that are there.
            yaw: heading, radians from -2π to 2π.
            tip: site or body of the model that motions place; by default as
                :mod:`~strands_robots.kinematics.model_file` finds it.

        ``in_floor`` of the answer has the depth of each body that starts in the floor, metres.
        """
        robot = SceneRobot.checked(name, model, position, yaw, tip)
        with self.starting:
            self._require_idle("add_robot")
            self._rebuild(self.physics.compiled.scene.with_robot(robot, beside=position is None))
            parts = self.body(robot.name).parts
            sunk = self._in_floor(robot.name)
        return success(
            f"Added {robot.name} ({robot.source.label}) with {len(parts.actuators)} actuators.{sunk_sentence(sunk)}",
            robot=robot.name,
            model=robot.source.label,
            joints=list(parts.joints),
            actuators=list(parts.actuators),
            cameras=list(parts.cameras),
            in_floor=sunk,
        )

    @answered
    def remove_robot(self, name: str) -> Envelope:
        """Take a robot out of the world; the others keep their state."""
        with self.starting:
            self._require_idle("remove_robot")
            label = self.body(identifier("name", name)).name
            self._rebuild(self.physics.compiled.scene.without_robot(label))
        return success(f"Removed {label}.", robot=label, robots=self.list_robots())

    @answered
    def add_object(
        self,
        name: str,
        shape: str = "box",
        size: Any = (0.02, 0.02, 0.02),
        position: Any = (0.2, 0.0, 0.02),
        *,
        color: Any = (0.85, 0.2, 0.2, 1.0),
        mass: float = 0.05,
        fixed: bool = False,
        yaw: float = 0.0,
    ) -> Envelope:
        """Put an object of primitive shape into the world.

        Args:
            name: an identifier that no robot or object has.
            shape: box, sphere, cylinder or capsule.
            size: metres from 0.001 to 10: half lengths of a box, radius of a sphere, radius and half length else.
            position: of its centre, metres.
            color: red, green, blue and alpha from 0 to 1.
            mass: kilograms, 0.0001 to 1000.
            fixed: true for an object that never moves.
            yaw: its turn about z, radians from -2π to 2π.
        """
        item = SceneObject.checked(
            name=name, shape=shape, size=size, position=position, color=color, mass=mass, fixed=fixed, yaw=yaw
        )
        with self.starting:
            self._require_idle("add_object")
            self._rebuild(self.physics.compiled.scene.with_object(item))
            sunk = {} if item.fixed else self._in_floor(item.name)
        summary = f"Added {item.shape} {item.name}.{sunk_sentence(sunk)}"
        return success(summary, object=item.name, position=list(item.position), in_floor=sunk)

    @answered
    def remove_object(self, name: str) -> Envelope:
        """Take an object out of the world."""
        with self.starting:
            self._require_idle("remove_object")
            self._rebuild(self.physics.compiled.scene.without_object(name))
        return success(f"Removed {name}.", object=name)

    @answered
    def step(self, n: int = 1) -> Envelope:
        """Advance physics by ``n`` time steps (1 to 1,000,000) as fast as they compute."""
        count = whole("n", n, low=1, high=STEPS_MAX)
        self._require_open()
        self._clock.by_hand()
        left = count
        while left and not self._closed:
            self.physics.advance(min(left, CHUNK))
            left -= min(left, CHUNK)
        snapshot = self.physics.snapshot
        return success(
            f"Stepped {count - left} times, to {snapshot.time:.3f} s.",
            steps=count - left,
            sim_time=snapshot.time,
            step_count=snapshot.steps,
        )

    @answered
    def reset(self, *, request: MotionRequest | None = None) -> Envelope:
        """Halt, then restore the initial state of the world; refused while it is locked."""
        self._require_open()
        permit = self.gate.permit("reset", request)
        with self.starting:
            # Nothing starts a rollout while this lock is held; a stop that comes meanwhile voids the fresh permit.
            permit = self.gate.renew(permit)
            deadline = time.monotonic() + settings.number("STRANDS_HALT_DEADLINE_S")
            with self.tasks.halting(deadline, revoke=False, settles=False) as halt:
                self._torque.freeze(self.physics, self._clock)
            verdict = read_verdict(halt.verdict)
            if not verdict.stopped:
                return verdict.envelope()
            self.physics.reset(permit)
        return success("The world is back at its start.", sim_time=self.physics.snapshot.time, halted=verdict.halted)

    @answered
    def get_state(self) -> Envelope:
        """Return the state of physics and of every robot.

        ``sim_time`` (s), ``step_count``, ``robots`` (name to joints in radians), ``running_policies`` (rows by robot),
        ``failed_policies`` (reason by robot, until its next policy), ``outcomes`` (how the last policy or motion of a
        robot ended, until its next one), ``real_time_factor`` and ``diverged``.
        """
        snapshot = self.physics.snapshot
        robots = {name: snapshot.observation(parts) for name, parts in snapshot.compiled.robots.items()}
        latest = dict(self.tasks.by_body)
        return success(
            f"{_count(robots)} at {snapshot.time:.3f} s of simulated time.",
            sim_time=snapshot.time,
            step_count=snapshot.steps,
            robots=robots,
            running_policies={row["robot"]: row for row in self.list_policies_running()},
            failed_policies={name: each.error for name, each in latest.items() if each.state == "error"},
            outcomes=self.outcomes(),
            real_time_factor=round(self._clock.real_time_factor, 4),
            diverged=self.physics.diverged,
        )

    @answered
    def get_features(self) -> Envelope:
        """Return joints, actuators and cameras by robot; a range is null without limit."""
        snapshot = self.physics.snapshot
        compiled = snapshot.compiled
        robots: dict[str, Any] = {
            name: {
                "model": parts.model,
                "joints": {key: _range(j.low, j.high) for key, j in parts.joints.items()},
                "joint_units": {key: j.unit for key, j in parts.joints.items()},
                "actuators": {key: _range(a.low, a.high) for key, a in parts.actuators.items()},
                "cameras": list(parts.cameras),
                "observation_features": list(snapshot.observation(parts)),
                "action_features": list(parts.actuators),
            }
            for name, parts in compiled.robots.items()
        }
        return success(
            f"{_count(robots)}.",
            robots=robots,
            cameras=camera_names(compiled),
            objects=[o.name for o in compiled.scene.objects],
            timestep=compiled.scene.timestep,
        )

    def get_observation(self, robot_name: str | None = None, cameras: Iterable[str] = ()) -> dict[str, Any]:
        """Return joint positions of one robot, and the pictures of some cameras."""
        body = self.body(robot_name)
        observed, names = body.get_observation(), [choice("cameras", each, tuple(body.cameras)) for each in cameras]
        return {**observed.joints, **{name: observed[name] for name in names}}

    @answered
    def get_pose(self, robot_name: str | None = None) -> Envelope:
        """Return the pose of a robot's base, with ``source`` and ``frame``.

        The fields are those of :meth:`RobotBody.base_pose`. The name may be left out where there is one robot.
        """
        body = self._only(robot_name)
        pose = body.base_pose()
        summary = f"{body.name} is at {pose['x']:.3f}, {pose['y']:.3f} m."
        return success(summary, **pose, source="simulation", frame="world")

    @answered
    def get_odom(self, robot_name: str | None = None) -> Envelope:
        """Return the pose of a mobile robot, with :meth:`RobotBody.base_velocity`."""
        body = self._only(robot_name)
        velocity = body.base_velocity()
        if velocity is None:
            return error(f"{body.name} does not move about.")
        return success(f"{body.name} moves about.", **body.base_pose(), **velocity, source="simulation", frame="world")

    @property
    def joint_units(self) -> dict[str, str]:
        """Units of the robot that an action without a name goes to."""
        return self.body().joint_units if self._bodies else {}

    @answered
    def send_action(
        self, action: dict[str, float], robot_name: str | None = None, *, request: MotionRequest | None = None
    ) -> Envelope:
        """Set targets of one robot; ``sent`` has them clamped to each actuator's range."""
        self._require_open()
        body = self.body(robot_name)
        permit = self.gate.permit("send_action", request)
        with self.tasks.waiting.until_begun(permit, body.name):
            self.tasks.require_free(body.name)
            sent = body.send_action(action, permit)
        return success(f"Sent {len(sent)} targets to {body.name}.", robot=body.name, sent=sent)

    @answered
    def start_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        *,
        request: MotionRequest | None = None,
        **policy: Any,
    ) -> Envelope:
        """Start a rollout of one robot and return at once.

        Args:
            robot_name: a robot of this world; empty for the first.
            instruction: the task, 1 to 2000 characters.
            policy_provider: a registered policy, such as mock.
            duration: seconds, above 0 up to a day.
            request: what it begins for; made now by default.
            policy: arguments of that policy's constructor; besides, ``control_frequency`` (Hz, at most the robot's
                rate) and ``n_steps`` (actions after which it ends).
        """
        new = self.tasks.of_policy(instruction, policy_provider, duration, policy)
        rollout = self.tasks.start("start_policy", robot_name, new, request)
        problem = rollout.not_begun()
        if problem:
            return error(f"start_policy: {problem}.", **_row(rollout))
        return success(
            f"{rollout.robot} started: {rollout.instruction}.{instruction_note(rollout)}",
            robot=rollout.robot,
            instruction=rollout.instruction,
            policy_provider=rollout.policy_name,
            follows_instruction=rollout.follows_instruction,
            duration=rollout.duration,
        )

    @answered
    def run_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        **policy: Any,
    ) -> Envelope:
        """Run a rollout as :meth:`start_policy` does, and wait for its end."""
        new = self.tasks.of_policy(instruction, policy_provider, duration, policy)
        rollout = self.tasks.start("start_policy", robot_name, new)
        if not rollout.join((rollout.duration or 0.0) + TEARDOWN_S):
            rollout.request_stop()
            return error(f"{rollout.robot} was still running {TEARDOWN_S:g} s after its time.", **_row(rollout))
        if rollout.state == "error":
            return error(f"{rollout.robot} failed: {rollout.error}", **_row(rollout))
        return success(f"{rollout.robot} {rollout.state} after {rollout.step_count} steps.", **_row(rollout))

    @answered
    def stop_policy(self, robot_name: str) -> Envelope:
        """Stop the policy or the leader of one robot, and freeze the robot where it is.

        ``stopped`` is false if the loop outlived it. A policy or a leader that is still loading never starts, and the
        targets of a single action are given up.
        """
        body = self.body(robot_name)
        self.tasks.waiting.void(body.name)
        self.void_leaders(body.name)
        rollout = self.tasks.running().get(body.name) or self.teleoperating().get(self.teleoperated_by(body.name))
        if rollout is None:
            # After a single action the servos go on to its targets.
            self._torque.freeze_one(body)
            return success(f"{body.name} ran no policy; it is held.", robot=body.name, stopped=True, was_running=False)
        rollout.void()
        self._torque.freeze_one(body)
        rollout.interrupt()
        stopped = bool(rollout.ended_by(time.monotonic() + STOP_JOIN_S)["stopped"])
        row = {**_row(rollout), "stopped": stopped, "was_running": True}
        if not stopped:
            return error(f"{body.name} is frozen, but its policy {rollout.policy_name} has not returned yet.", **row)
        return success(f"{body.name} stopped after {rollout.step_count} steps.", **row)

    def list_policies_running(self) -> list[dict[str, Any]]:
        """Return a row of each running rollout; leaders have theirs, too."""
        return [rollout.row() for rollout in self.tasks.driving()]

    def outcomes(self) -> dict[str, dict[str, Any]]:
        """Return how the last rollout of each robot ended, until its next one."""
        ended = {name: self.outcome_of(each) for name, each in dict(self.tasks.by_body).items()}
        return {name: outcome for name, outcome in ended.items() if outcome is not None and name in self._bodies}

    def policy_facts(self, robot_name: str | None = None) -> RobotFacts:
        """Return what a policy is checked against."""
        body = self.body(robot_name)
        pictures, rate = dict.fromkeys(body.cameras, PICTURE), settings.number("STRANDS_CONTROL_HZ")
        facts = (body.get_joints(), list(body.bounds), body.joint_units, pictures, rate)
        return RobotFacts(body.name, *facts, body.bounds, body.parts.model)

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """Stop everything that moves a robot, freeze all; then as the stop level says."""
        deadline = time.monotonic() + settings.number("STRANDS_HALT_DEADLINE_S")
        return halted_with_verbs(self, lambda: self.halt_here(reason, deadline), deadline)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Void every permit, freeze, and leave the ends of the loops to be read."""
        with self.tasks.halting(deadline) as halt:
            self._torque.freeze(self.physics, self._clock)
        return halt.verdict

    def halt_ordered(self) -> None:
        """Note what moves; a loop whose permit is void counts as halted."""
        self.tasks.note_motion()

    def wait_settled(self) -> str:
        """Wait for the end of every settling; return a sentence on each arm."""
        return self.tasks.settlings.wait()

    def cleanup(self) -> Envelope:
        """Halt, let settle, stop the clock and free the pictures, once."""
        if self._closed:
            return success("Already cleaned up.")
        with self.starting:
            self._closed = True
            self.gate.attach(_CleanedUp())
        self.wait_settled()
        verdict = self.halt("cleanup")
        self.wait_settled()
        self._clock.close()
        self._renderer.close()
        return verdict.envelope()

    def tip_position(self, robot_name: str | None = None) -> tuple[float, float, float]:
        """Return the place of one robot's tip, as :meth:`RobotBody.tip_position`."""
        return self.body(robot_name).tip_position()

    def arm(self, robot_name: str = "") -> Arm:
        """Return the arm of one robot.

        Raises:
            ValidationError: no such robot, or one without an arm.
        """
        return self.body(robot_name).arm

    def arm_parts(self, robot_name: str = "") -> ArmParts:
        """Return what one robot has of an arm; nothing for one that is not there."""
        try:
            return self.body(robot_name).arm_parts
        except ValidationError:
            return ArmParts()

    def targets(self, robot_name: str = "") -> dict[str, float]:
        """Return the setpoints of one robot, as :attr:`RobotBody.targets`."""
        return self.body(robot_name).targets

    def objects(self, robot_name: str = "") -> list[SeenObject]:
        """Return the objects of the world in the base frame of one robot."""
        return targets_of(self.physics.snapshot, self.body(robot_name).base_pose())

    def _require_open(self) -> None:
        if self._closed:
            raise ValidationError("this simulation was cleaned up; make a new one.")

    def _require_idle(self, verb: str) -> None:
        self._require_open()
        leaders = [f"{leader} leading {session.robot}" for leader, session in self.teleoperating().items()]
        moving = [f"policy on {name}" for name in self.tasks.running()] + leaders
        moving += [f"{name}, which settles" for name in self.tasks.settlings.running()]
        if moving:
            raise ValidationError(f"{verb} is refused while something moves: {', '.join(moving)}. Stop it first.")

    def _only(self, robot_name: str | None) -> RobotBody:
        if not robot_name and len(self._bodies) != 1:
            raise ValidationError(f"robot_name must be one of {self.list_robots()}, not {shown(robot_name)}.")
        return self.body(robot_name)

    def _rebuild(self, scene: Scene) -> None:
        """Compile ``scene`` and switch to it; nothing changes when it does not compile."""
        compiled = compile_scene(scene)
        self._torque.check(compiled.robots)
        self.physics.replace(compiled)
        self._bodies = {
            r.name: self._bodies.get(r.name)
            or RobotBody(r.name, self.physics, self._clock, self._speed_limit, self._draw)
            for r in scene.robots
        }
        self._torque.fit(self._bodies)

    def _in_floor(self, owner: str) -> dict[str, float]:
        """Return and log the depths of the bodies that start in the floor."""
        sunk = in_floor(self.physics.snapshot.data(), owner)
        if sunk:
            logger.warning("%s:%s", owner, sunk_sentence(sunk))
        return sunk


def _row(rollout: Rollout) -> dict[str, Any]:
    return {
        **rollout.row(),
        "state": rollout.state,
        "error": rollout.error,
        "clamped_steps": rollout.clamped_steps,
        "loop": rollout.counts,
    }


def _range(low: float, high: float) -> list[float] | None:
    return [low, high] if low > float("-inf") or high < float("inf") else None


def _count(robots: dict[str, Any]) -> str:
    return "1 robot" if len(robots) == 1 else f"{len(robots)} robots"
