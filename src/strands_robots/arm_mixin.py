"""Motions of an arm for any robot: planned, run as a rollout, reported."""

from __future__ import annotations

import functools
import itertools
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ParamSpec

from strands_robots.contract import RUNNING, for_request
from strands_robots.envelope import Envelope, error, success
from strands_robots.kinematics import ArmParts, StatedJoint, load_places, save_places
from strands_robots.policies.base import Action
from strands_robots.policies.rollout import Body, Rollout
from strands_robots.policies.task_engine import NewTask, TaskEngine
from strands_robots.recording.cameras import frames_of
from strands_robots.safety.gate import MotionRequest, Permit, answered
from strands_robots.stop_log import stop_logger
from strands_robots.utils import WAIT_S as WAIT_S  # noqa: PLC0414 - part of what callers of the motions import
from strands_robots.utils import ValidationError, choice, identifier, missing_extra, number, shown

if TYPE_CHECKING:  # numpy and MuJoCo are loaded with the first motion
    from strands_robots.kinematics.arm import Arm, ArmState
    from strands_robots.kinematics.motion import ArmTask, JointSpace, Motion
    from strands_robots.kinematics.moves import Start
    from strands_robots.kinematics.objects import Asking, Held, ObjectDetector, SeenObject, Sight

logger = stop_logger(__name__)

P = ParamSpec("P")

FRESH_S = 0.02
"""Greatest age of joints that are not read again, so that a pose takes no turn on the bus from a running motion."""

PLAN_S = 2.0
"""Longest search for a way around objects."""

LOOK_S = 2.0
"""Longest wait for the answer of a detector."""

HOME = "home"
"""Place that every arm has: the home pose of its model."""

PlanMotion = Callable[["Start"], "Motion"]


def planned(verb: Callable[P, Envelope]) -> Callable[P, Envelope]:
    """Answer refusals, and a missing MuJoCo, with their envelope."""
    answering = answered(verb)

    @functools.wraps(verb)
    def asked(*args: P.args, **kwargs: P.kwargs) -> Envelope:
        try:
            return answering(*args, **kwargs)
        except ModuleNotFoundError as exc:
            if exc.name not in ("mujoco", "numpy"):
                raise
            return error(str(missing_extra("Planning the motion of an arm", "sim")))

    return asked


class ArmMixin:
    """Verbs of an arm for a host that has the members declared here.

    Positions are metres and angles degrees in the base frame of the arm, x forward; the gripper's opening is 0 closed
    to 1 open. ``robot_name`` names one robot of a world; empty for the first.
    """

    tool_name_str: str
    tasks: TaskEngine
    detector: ObjectDetector | None = None
    """Sees the objects of a real robot; a simulation knows its own."""

    knows_objects = False
    """True where :meth:`objects` costs no picture, so that every motion may ask it."""

    @abstractmethod
    def body(self, robot_name: str | None = None) -> Body:
        """Return the body of that name, or the first; raises :class:`ValidationError`."""

    @abstractmethod
    def arm(self, robot_name: str = "") -> Arm:
        """Return the arm of a body; raises :class:`ValidationError` without one."""

    @abstractmethod
    def targets(self, robot_name: str = "") -> Mapping[str, float]:
        """Return what a body was told last, by action key; empty where it is not known."""

    def objects(self, robot_name: str = "") -> list[SeenObject]:
        """Return the objects in the base frame of a body, as its detector sees them.

        Raises:
            ValidationError: it has no detector, or that failed.
        """
        name = self.body(robot_name).name
        if self.detector is None:
            raise ValidationError(f"{name} has no detector of objects; give a position instead.")
        from strands_robots.kinematics.objects import detected  # noqa: PLC0415 - numpy, with the first motion

        frames = frames_of(self)
        return detected(self.detector, {} if frames is None else frames())

    def arm_parts(self, robot_name: str = "") -> ArmParts:
        """Return what a body has of an arm; nothing is loaded, read or waited for."""
        return ArmParts()

    def arm_verbs(self, robot_name: str = "") -> frozenset[str]:
        """Return the names of the verbs of an arm that a body carries out now."""
        return self.arm_parts(robot_name).verbs(sees=self.knows_objects or self.detector is not None)

    def stated_joints(self, robot_name: str = "") -> Sequence[StatedJoint]:
        """Return the joints that a body without a model states; none with a model."""
        return ()

    def still_action(self, robot_name: str = "") -> Action:
        """Return the targets that keep a body without a model where it was told to be."""
        return {}

    def start_motion(
        self,
        robot_name: str,
        verb: str,
        plan: Callable[[float, Permit], Motion],
        *,
        request: MotionRequest | None = None,
    ) -> Rollout:
        """Plan with the control rate (Hz) and start, once the body is found free.

        The plan's search ends when its permit is void. A halt since the request was made refuses the motion.
        """

        def make(body: Body, permit: Permit, _: object) -> Rollout:
            hz = self.tasks.rate()
            motion = plan(hz, permit)
            # What it grips in the end it keeps.
            return Rollout(
                body,
                motion,
                permit=permit,
                instruction=motion.instruction,
                policy_name="motion",
                duration=motion.duration,
                hz=hz,
                observers=self.tasks.observers,
                ends_at_rest=True,
            )

        return self.tasks.start(verb, robot_name, NewTask(make), request)

    @planned
    def arm_pose(self, robot_name: str = "") -> Envelope:
        """Return the pose of the tip, the joints (degrees) and the gripper's opening.

        ``x``, ``y``, ``z`` in metres, ``approach`` in degrees below the horizontal, ``holding``, and the ``model``.
        """
        import numpy as np  # noqa: PLC0415 - loaded with the first motion

        arm, body = self.arm(robot_name).whole(), self.body(robot_name)
        age_s, observed = _observed(body)
        state = arm.state(observed)
        pose = arm.chain.forward(state.joints)
        x, y, z = (round(float(v), 5) for v in pose.position)
        joints = {
            joint.name: round(float(np.degrees(at)) if joint.turns else float(at), 3)
            for joint, at in zip(arm.chain.joints, state.joints, strict=True)
        }
        approach = round(pose.approach_deg, 2)
        return success(
            f"The tip is at ({x:.3f}, {y:.3f}, {z:.3f}) m, {approach:.0f} degrees below the horizontal.",
            x=x,
            y=y,
            z=z,
            approach=approach,
            joints=joints,
            gripper=None if state.opening is None else round(min(max(state.opening, 0.0), 1.0), 4),
            holding=self._holding(body.name, arm),
            model=arm.chain.label,
            frame="base",
            age_s=round(age_s, 4),
        )

    @planned
    def move_joints(
        self,
        joints: Mapping[str, float],
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        *,
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Move joints to positions in degrees, by name; the others stay.

        A robot without a model moves them between the limits that it states: ``checked`` is then ``limits``, for
        nothing is known of contacts.
        """
        stated = self.stated_joints(robot_name)
        if stated:
            return self._move_stated(stated, joints, speed, wait, robot_name, request=request)
        from strands_robots.kinematics import moves  # noqa: PLC0415 - loaded with the first motion

        plan = partial(moves.move_joints, degrees=joints)
        return self._move("moveJoints", plan, speed, wait, robot_name, request=request, whole=True, around=around)

    @planned
    def move_to(
        self,
        x: float,
        y: float,
        z: float,
        *,
        approach: float | None = None,
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Move the tip to a point; ``approach`` is the steepest reachable by default."""
        from strands_robots.kinematics import moves  # noqa: PLC0415 - loaded with the first motion

        plan = partial(moves.move_to, position=_vector(x, y, z), approach=approach)
        return self._move("moveTo", plan, speed, wait, robot_name, request=request, around=around)

    @planned
    def move_by(
        self,
        dx: float = 0.0,
        dy: float = 0.0,
        dz: float = 0.0,
        *,
        direction: str = "",
        distance: float = 0.05,
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Move the tip on a straight line, by an offset or a distance in a direction."""
        from strands_robots.kinematics import moves  # noqa: PLC0415 - loaded with the first motion

        offset = _vector(dx, dy, dz)
        if direction:
            if offset.any():
                raise ValidationError("moveBy takes dx, dy and dz, or direction and distance, not both.")
            offset = distance * _vector(*moves.DIRECTIONS[choice("direction", direction, tuple(moves.DIRECTIONS))])
        if not offset.any():
            raise ValidationError("moveBy needs dx, dy or dz, or a direction.")
        plan = partial(moves.move_by, offset=offset)
        return self._move("moveBy", plan, speed, wait, robot_name, request=request, around=around)

    @planned
    def set_gripper(
        self, opening: float, wait: bool = True, robot_name: str = "", *, request: MotionRequest | None = None
    ) -> Envelope:
        """Move the gripper; ``holding`` says whether something is between the jaws."""
        from strands_robots.kinematics import moves  # noqa: PLC0415 - loaded with the first motion

        plan = partial(moves.set_gripper, opening=opening)
        return self._move("setGripper", plan, 1.0, wait, robot_name, request=request)

    @planned
    def get_objects(self, robot_name: str = "") -> Envelope:
        """Return the objects by name: centre, extents (m) and yaw (degrees)."""
        import numpy as np  # noqa: PLC0415 - loaded with the first motion

        rows = {
            each.name: {
                **{axis: round(float(value), 4) for axis, value in zip("xyz", each.position, strict=True)},
                "yaw": round(float(np.degrees(each.yaw)), 1),
                "size": [round(float(value), 4) for value in each.size],
                "fixed": each.fixed,
            }
            for each in self._objects_in_time(robot_name)
        }
        return success(f"{len(rows)} objects: {', '.join(rows) or 'none'}.", objects=rows, frame="base")

    @planned
    def pick(
        self,
        object: str = "",  # noqa: A002 - the verb's parameter is called so
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        *,
        width: float = 0.025,
        yaw: float = 0.0,
        approach: float | None = None,
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Pick up an object by its name, or one of a width at a point."""
        from strands_robots.kinematics import moves, objects  # noqa: PLC0415 - loaded with the first motion

        body, seen = self.body(robot_name), self._seen(robot_name, "pick")
        if object:
            target = _of_name(object, self._objects_in_time(body.name) if seen is None else seen)
            objects.require_uncovered(target, seen or ())
        elif x is None or y is None or z is None:
            raise ValidationError("pick needs object, or x, y and z.")
        else:
            given, size = _vector(x, y, z), _vector(width, width, 2 * min(z, width))
            target = objects.SeenObject(objects.nearest(given, seen or ()), given, math.radians(yaw), size)
        held: list[Held] = []

        def plan(start: Start) -> Motion:
            motion, grasped = moves.pick(start, target, approach)
            held.append(grasped)
            if looked is not None:
                looked.wanted = grasped.centre(start.arm.chain.forward(motion.end_joints))
            return motion

        looked = None if seen is None else objects.Sight(seen, target.name, within_mm=objects.CARRIED_MM)
        kept = lambda: self._held.update({body.name: held[-1]})  # noqa: E731 - one argument of the call below
        return self._move(
            "pick", plan, speed, wait, robot_name, request=request, started=kept, sight=looked, around=around
        )

    @planned
    def place(
        self,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        *,
        on: str = "",
        approach: float | None = None,
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Put the held object down on the table at a point, or on another object."""
        from strands_robots.kinematics import moves, objects  # noqa: PLC0415 - loaded with the first motion

        body, seen = self.body(robot_name), self._seen(robot_name, "place")
        held = self._held.get(body.name)
        holding = self._holding(body.name, self.arm(robot_name))
        if held is None or holding is False:
            raise ValidationError(f"{body.name} holds nothing that it picked up.")
        if holding is None:
            raise ValidationError(
                f"{body.name} was stopped, so what it holds is not known; setGripper with opening 0 tells."
            )
        if on:
            under = _of_name(on, self._objects_in_time(body.name) if seen is None else seen)
            position = under.position + _vector(0.0, 0.0, float(under.size[2]) / 2)
        elif x is None or y is None:
            raise ValidationError("place needs on, or x and y.")
        else:
            position = _vector(x, y, self.arm(robot_name).chain.table_z if z is None else z)
        objects.require_vacant(position, held, seen or (), on)
        plan = partial(moves.place, position=position, approach=approach, held=held, on=on)
        stands = position + _vector(0.0, 0.0, held.below)
        looked = None if seen is None else objects.Sight(seen, held.name, stands)
        return self._move("place", plan, speed, wait, robot_name, request=request, sight=looked, around=around)

    @planned
    def go_to(
        self,
        place: str,
        speed: float = 0.5,
        wait: bool = True,
        robot_name: str = "",
        *,
        around: bool = True,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Move to the joints of a saved place, or to ``home``."""
        from strands_robots.kinematics import moves  # noqa: PLC0415 - loaded with the first motion

        name = identifier("place", place)
        arm = self.arm(robot_name).whole()
        places: dict[str, dict[str, float]] = {HOME: _degrees(arm, arm.chain.rest)}
        places |= self._saved_places(self.body(robot_name).name)
        if name not in places:
            raise ValidationError(f"place must be one of {', '.join(places)}, not {shown(name)}.")
        plan = partial(moves.go_to, place=name, degrees=places[name])
        return self._move("goTo", plan, speed, wait, robot_name, request=request, whole=True, around=around)

    @planned
    def save_place(self, place: str, robot_name: str = "") -> Envelope:
        """Save the present joints as a place of :meth:`go_to`, in the state directory.

        ``kept`` is false where that cannot be written: the place is then lost with this process.
        """
        name, body, arm = identifier("place", place), self.body(robot_name), self.arm(robot_name).whole()
        if name == HOME:
            raise ValidationError(f"place must not be {HOME}, which is that of the model.")
        joints = _degrees(arm, arm.state(_observed(body)[1]).joints)
        saved = {**self._saved_places(body.name), name: joints}
        why = ""
        try:
            save_places(self._place_key(body.name), saved)
        except OSError as exc:
            why = f" It is lost with this process: {exc}."
        self._places[body.name] = saved
        return success(f"Saved {name}.{why}", place=name, joints=joints, places=[HOME, *saved], kept=not why)

    def _place_key(self, name: str) -> str:
        # A place of a simulation must not move the real arm of the same name: their zeros may differ.
        kind = "simulation" if hasattr(self, "list_robots") else "arm"
        own = str(getattr(self, "safety_key", "")) or f"{kind}:{self.tool_name_str}"
        return own if name == self.tool_name_str else f"{own}:{name}"

    def _saved_places(self, name: str) -> dict[str, dict[str, float]]:
        if name not in self._places:
            self._places[name] = load_places(self._place_key(name))
        return self._places[name]

    @planned
    def wait_for(self, task_id: str = "", seconds: float = WAIT_S, robot_name: str = "") -> Envelope:
        """Wait for the end of a motion, the last one by default, and return its result.

        Before the first motion this answers at once, that there was none.
        """
        name, longest = self.body(robot_name).name, number("seconds", seconds, low=0, high=WAIT_S)
        task = self._tasks.get(name)
        if task_id:
            task = next((each for each in self._recent if each.task_id == task_id), None)
        if task is None and not task_id:
            status = "running" if name in self.tasks.running() else "idle"
            return success(f"{name} has made no motion of this kind yet.", task_id="", task_status=status)
        if task is None:
            known = ", ".join(each.task_id for each in self._recent) or "none"
            raise ValidationError(f"task_id must be a motion of this robot ({known}), not {shown(task_id)}.")
        task.join(longest)
        return self._result(task)

    def outcome_of(self, rollout: Rollout | None) -> dict[str, Any] | None:
        """Return how a rollout ended, and of a motion what it reached.

        It was measured at the end and reads no bus. None while it runs, and before the first one.
        """
        if rollout is None or rollout.running:
            return None
        task = self._tasks.get(rollout.robot)
        if task is not None and task.rollout is rollout:
            outcome = self._outcome(task)
            return None if outcome["task_status"] in RUNNING else outcome
        why = rollout.error or ("it is done" if rollout.state == "completed" else "it was stopped")
        return {
            "task_status": rollout.state,
            "instruction": rollout.instruction,
            "policy": rollout.policy_name,
            "step_count": rollout.step_count,
            "duration": round(rollout.elapsed_s, 3),
            "why": why,
        }

    @cached_property
    def _tasks(self) -> dict[str, ArmTask]:
        return {}

    @cached_property
    def _recent(self) -> list[ArmTask]:
        return []

    @cached_property
    def _places(self) -> dict[str, dict[str, dict[str, float]]]:
        return {}

    @cached_property
    def _held(self) -> dict[str, Held]:
        return {}

    @cached_property
    def _task_numbers(self) -> itertools.count[int]:
        return itertools.count(1)

    def _seen(self, robot_name: str, verb: str) -> list[SeenObject] | None:
        """Return the objects before a motion; None where they are not looked for."""
        asked = self.knows_objects or (self.detector is not None and verb in ("pick", "place"))
        return self._objects_in_time(robot_name) if asked else None

    def _objects_in_time(self, robot_name: str) -> list[SeenObject]:
        """Return the objects; a detector has :data:`LOOK_S` to answer."""
        if self.knows_objects or self.detector is None:
            return self.objects(robot_name)
        return self._asking.within(partial(self.objects, robot_name), LOOK_S)

    @cached_property
    def _asking(self) -> Asking:
        from strands_robots.kinematics.objects import Asking  # noqa: PLC0415 - numpy, with the first motion

        return Asking()

    def _look(self, task: ArmTask, sight: Sight) -> None:
        """Wait for the end of a motion, then look at the objects unless it was stopped."""
        task.rollout.join()
        try:
            if self.knows_objects or task.rollout.state == "completed":
                sight.after = self._objects_in_time(task.rollout.robot)
        except Exception as exc:  # noqa: BLE001 - an end that cannot be seen is an end all the same
            logger.warning("The objects after %s of %s are not known: %s", task.task_id, task.rollout.robot, exc)
        finally:
            task.looked.set()

    def _move(
        self,
        verb: str,
        plan: PlanMotion,
        speed: float,
        wait: bool,
        robot_name: str,
        *,
        request: MotionRequest | None,
        whole: bool = False,
        started: Callable[[], object] = lambda: None,
        sight: Sight | None = None,
        around: bool = False,
    ) -> Envelope:
        from strands_robots.kinematics.moves import Start  # noqa: PLC0415 - loaded with the first motion
        from strands_robots.kinematics.objects import Sight  # noqa: PLC0415 - as above

        body, arm = self.body(robot_name), self.arm(robot_name)
        arm = arm.whole() if whole else arm
        seen: Sequence[SeenObject] = () if sight is None else sight.before
        if sight is None and (self.knows_objects or (around and self.detector is not None)):
            try:
                seen = self._objects_in_time(robot_name)
            except ValidationError as exc:
                raise ValidationError(f"{str(exc).rstrip('.')}; around=false moves without it.") from exc
            sight = Sight(seen) if self.knows_objects else None

        def planned_at(hz: float, permit: Permit) -> Motion:
            observed = arm.state(_observed(body)[1])
            state = observed.at_setpoints(arm.setpoints(self.targets(body.name)))
            held = self._held.get(body.name) if self._holding(body.name, arm, observed) else None
            until = time.monotonic() + PLAN_S
            going = lambda: permit.valid and time.monotonic() < until  # noqa: E731 - one argument of the next call
            return plan(Start(arm, state, hz, speed, seen if around else (), held, going))

        return self._play(verb, body, planned_at, wait, request=request, started=started, sight=sight)

    def _move_stated(
        self,
        stated: Sequence[StatedJoint],
        joints: Mapping[str, float],
        speed: float,
        wait: bool,
        robot_name: str,
        *,
        request: MotionRequest | None,
    ) -> Envelope:
        from strands_robots.kinematics import motion  # noqa: PLC0415 - numpy, with the first motion

        body, goals = self.body(robot_name), motion.chosen(stated, joints)

        def planned_at(hz: float, permit: Permit) -> Motion:
            space = motion.StatedJoints(tuple(goals))
            state = space.state(_observed(body)[1]).at_setpoints(space.setpoints(self.targets(body.name)))
            still = self.still_action(body.name)
            return motion.move_joints(goals, state, still, joints, hz=hz, speed=speed)

        return self._play("moveJoints", body, planned_at, wait, request=request)

    def _play(
        self,
        verb: str,
        body: Body,
        plan: Callable[[float, Permit], Motion],
        wait: bool,
        *,
        request: MotionRequest | None,
        started: Callable[[], object] = lambda: None,
        sight: Sight | None = None,
    ) -> Envelope:
        """Plan a motion, start it, and answer at its end or at once."""
        from strands_robots.kinematics.motion import ArmTask  # noqa: PLC0415 - numpy, with the first motion

        planned: list[Motion] = []

        def planned_at(hz: float, permit: Permit) -> Motion:
            motion = plan(hz, permit)
            motion.clock = getattr(body, "clock", motion.clock)
            motion.stall_lag = getattr(body, "stall_lag", motion.stall_lag)
            motion.currents = getattr(body, "get_currents", None)
            planned.append(motion)
            return motion

        rollout = for_request(request, self.start_motion)(body.name, verb, planned_at)
        task = ArmTask(f"{verb}-{next(self._task_numbers)}", rollout, planned[-1], sight=sight)
        self._tasks[body.name] = task
        self._recent[:] = [*self._recent[-15:], task]
        started()
        if sight is not None:
            threading.Thread(target=self._look, args=(task, sight), name=f"look-{body.name}", daemon=True).start()
        if wait:
            task.join(WAIT_S)
        return self._result(task)

    def _result(self, task: ArmTask) -> Envelope:
        outcome = self._outcome(task)
        if outcome["task_status"] in RUNNING:
            return success(f"{task.motion.verb} is under way; wait for {task.task_id}.", **outcome)
        text = f"{task.motion.verb} {outcome['task_status']}: {outcome['why']}."
        return success(text, **outcome) if outcome["task_status"] == "completed" else error(text, **outcome)

    def _outcome(self, task: ArmTask) -> dict[str, Any]:
        """Return what was asked, what was reached, and why the motion ended."""
        if not task.rollout.running and task.sight is not None and self.knows_objects and not task.looked.is_set():
            self._look(task, task.sight)
        if task.running or task.unseen:
            return self._measured(task, running=True)
        if task.outcome is None:
            task.outcome = self._measured(task, running=False)
        return task.outcome

    def _measured(self, task: ArmTask, *, running: bool) -> dict[str, Any]:
        rollout, motion, sight = task.rollout, task.motion, task.sight
        state = rollout.state
        end = motion.arm.reached(motion.state, motion.goal, motion.wanted)
        why = "it is under way"
        holding = None if running else self._holding(rollout.robot, motion.arm, motion.state)
        if not running:
            why = motion.contact or rollout.error or "it was stopped"
            if state == "completed":
                problem = (
                    motion.problem(end["error_mm"], holding) or (sight.problem() if sight is not None else "")
                    if motion.finished
                    else "its time was over before it was done"
                )
                state, why = ("error", problem) if problem else (state, "it is done")
            if sight is not None and sight.moved:
                why += f"; {sight.remark()}"
        return {
            "task_id": task.task_id,
            "verb": motion.verb,
            "task_status": "running" if running else state,
            "asked": dict(motion.asked),
            **end,
            "holding": holding,
            **(sight.row() if sight is not None else {}),
            "duration": round(rollout.elapsed_s, 3),
            "why": why,
        }

    def _holding(self, name: str, arm: JointSpace, state: ArmState | None = None) -> bool | None:
        """Return what the jaw tells, None while it moves or was told otherwise since.

        Args:
            state: what was observed last; read anew without it.
        """
        of_body = (each for each in reversed(self._recent) if each.rollout.robot == name)
        task = next((each for each in of_body if each.motion.opening is not None), None)
        if task is None or task.motion.opening is None or arm.jaw is None or task.rollout.running:
            return None
        command = self.targets(name).get(arm.jaw.commanded)
        if command is None or not arm.jaw.says(command, task.motion.opening):
            return None
        return arm.holding(state or arm.state(_observed(self.body(name))[1]), task.motion.opening)


def _observed(body: Body) -> tuple[float, Mapping[str, float]]:
    """Return the age (s) and the joints of a body, read anew unless fresh."""
    latest: tuple[float, dict[str, float]] | None = getattr(body, "latest_joints", None)
    if latest is not None and latest[0] <= FRESH_S:
        return latest
    try:
        return 0.0, body.get_joints()
    except OSError as exc:
        raise ValidationError(f"the joints of {body.name} could not be read: {exc}") from exc


def _of_name(name: str, objects: Iterable[SeenObject]) -> SeenObject:
    known = {each.name: each for each in objects}
    if name not in known:
        known_names = ", ".join(known) or "those in getObjects, which sees none"
        raise ValidationError(f"object must be one of {known_names}, not {shown(name)}.")
    return known[name]


def _vector(x: float, y: float, z: float) -> Any:
    import numpy as np  # noqa: PLC0415 - loaded with the first motion

    return np.array([x, y, z], dtype=np.float64)


def _degrees(arm: Arm, joints: Any) -> dict[str, float]:
    import numpy as np  # noqa: PLC0415 - loaded with the first motion

    return {
        joint.name: float(np.degrees(at)) if joint.turns else float(at)
        for joint, at in zip(arm.chain.joints, joints, strict=True)
        if not joint.refusal
    }
