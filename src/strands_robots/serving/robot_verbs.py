"""Verbs of robots with tasks, worlds and mobile bases, and the methods that carry them out.

Device Connect serves these tables; those of the mesh are in :mod:`~strands_robots.serving.peer_verbs`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from strands_robots.adapted import behind_contract, lacks, task_status_of
from strands_robots.bus_access import read_joints
from strands_robots.contract import Robot, WorldRobot, body_of, for_request, holds_robots
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.gate import Approved
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS, WORLD_MOTION_VERBS, for_robot
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.lead_verbs import LEAD_VERBS
from strands_robots.serving.verbs import (
    DURATION,
    INSTRUCTION,
    MOTOR_IDS,
    N_STEPS,
    NONCE,
    POLICY_PORT,
    POLICY_PROVIDER,
    RESUME,
    ROBOT_NAME,
    Arguments,
    Begin,
    Kind,
    Verb,
    release_torque_verb,
    table,
)
from strands_robots.utils import DURATION_MAX_S, ValidationError, duration, number, shown, text
from strands_robots.verb_parameters import Parameter


def served(robot: Any) -> Robot:
    """Return ``robot`` behind its contract.

    Raises:
        ValidationError: it is a plain value, such as a name.
    """
    return behind_contract(robot, read_joints)


def robot_of(world: WorldRobot, name: str | None, *, first: bool = False) -> str:
    """Return the named robot of a world, its only one, or its ``first``.

    Raises:
        ValidationError: no robot of this name, or several and none is named.
    """
    robots = world.list_robots()
    if not robots:
        raise ValidationError("The simulation has no robot; add one before execute.")
    if name:
        if name not in robots:
            raise ValidationError(f"robot_name must be one of {', '.join(robots)}, not {shown(name)}.")
        return name
    if len(robots) > 1 and not first:
        raise ValidationError(f"robot_name must name one of {', '.join(robots)}: this world has {len(robots)} robots.")
    return robots[0]


def world_stop_answer(verdict: StopVerdict) -> Envelope:
    """Return the verdict on a world as the answer to ``stop``."""
    refused = {**verdict.unknown, **verdict.not_stopped}
    stopped = list(verdict.halted)
    fields: dict[str, Any] = {"stopped": stopped, "not_stopped": sorted(refused), "reasons": refused}
    if refused:
        return error(f"Not everything stopped: {'; '.join(f'{n}: {why}' for n, why in refused.items())}", **fields)
    if verdict.settling:
        fields["settling"] = True
    return success(f"Stopped {', '.join(stopped)}." if stopped else "Nothing was moving.", **fields)


def _execute(world: WorldRobot, arguments: Arguments, request: MotionRequest | None) -> Envelope:
    policy = dict(arguments)
    name = robot_of(world, policy.pop("robot_name"), first=True)
    answer = for_request(request, world.start_policy)(name, policy.pop("instruction"), **policy)
    return {**answer, "robot_name": name}


def step_world(robot: Robot, arguments: Arguments, request: MotionRequest | None = None) -> Envelope:
    """Advance the physics of a world; refused by any other robot."""
    if not holds_robots(robot):
        return error("step: this robot is no simulation.")
    return for_request(request, robot.step)(arguments.get("n_steps", arguments.get("steps", 1)))


def reset_world(robot: Robot, arguments: Arguments, request: MotionRequest | None = None) -> Envelope:
    """Restore the initial state of a world; refused by any other robot."""
    if not holds_robots(robot):
        return error("reset: this robot is no simulation.")
    return for_request(request, robot.reset)()


def _world_status(world: WorldRobot, arguments: Arguments) -> Envelope:
    return {**world.get_state(), "task_status": task_status_of(world)}


def release_torque(robot: Robot, arguments: Arguments) -> Envelope:
    """Switch the motors off, where the robot can."""
    own = getattr(body_of(robot), "release_torque", None)
    if not callable(own):
        return error("releaseTorque: this robot cannot switch its torque off.")
    answer: Envelope = own(arguments.get("motor_ids", ""))
    return answer


def releases_torque(robot: Any) -> bool:
    """Return True where a robot can switch its torque off."""
    body = body_of(robot)
    return callable(getattr(body, "release_torque", None)) and getattr(body, "releases_torque", True) is not False


def takes_tasks(robot: Any) -> bool:
    """Return True for a robot that follows policies, and a world with one in it."""
    if holds_robots(robot):
        return bool(robot.list_robots()) and "start_policy" not in lacks(robot)
    body = body_of(robot)
    return callable(getattr(body, "start_task", None)) and getattr(body, "takes_tasks", True) is not False


def is_world(robot: Any) -> bool:
    """Return True for a world, whose physics can be stepped and reset."""
    return holds_robots(robot) and getattr(robot, "whole", True) is not False


GET_FEATURES = Verb(
    "getFeatures",
    Kind.READ,
    "Read what the robot senses and what it can be told: its observation and action features.",
    returns="observation_features, action_features",
    method="get_features",
)
GET_STATE = Verb(
    "getState",
    Kind.READ,
    "Read joint positions by name, in the robot's own units, and the task.",
    returns="joints, joints_age_s, task",
    method="get_state",
)
TASK_VERBS = table(
    [
        Verb(
            "execute",
            Kind.MOTION,
            "Start a task on the robot and return at once; follow it with getStatus or the taskComplete event.",
            (INSTRUCTION, POLICY_PROVIDER, DURATION, POLICY_PORT),
            returns="task_status",
            method="start_task",
            suits=takes_tasks,
        ),
        Verb(
            "stop",
            Kind.STOP,
            "Stop everything that moves the robot now; the answer says whether it stopped.",
            returns="stopped, halted, not_stopped, unknown, elapsed_ms",
        ),
        release_torque_verb(MOTOR_IDS, method="release_torque", run=release_torque, suits=releases_torque),
        RESUME,
        Verb(
            "getStatus",
            Kind.READ,
            "Read what the robot is doing, or how its last task or motion ended: state, instruction, steps, outcome.",
            (NONCE,),
            returns="task_status, instruction, step_count, duration, outcome, locked, lockout, check_in",
            run=lambda robot, _: robot.get_task_status(),
        ),
        GET_FEATURES,
        GET_STATE,
        *ARM_MOTION_VERBS.values(),
        *PICTURE_VERBS.values(),
        *LEAD_VERBS.values(),
        *CONTROL_VERBS.values(),
    ]
)
WORLD_VERBS = table(
    [
        Verb(
            "execute",
            Kind.MOTION,
            "Start a policy on a simulated robot and return at once; follow it with getStatus or policyComplete.",
            (INSTRUCTION, POLICY_PROVIDER, DURATION, ROBOT_NAME),
            returns="robot_name",
            begin=_execute,
            suits=takes_tasks,
        ),
        Verb(
            "stop",
            Kind.STOP,
            "Stop the named robot, or all that moves in the world; the answer names what stopped and what did not.",
            (replace(ROBOT_NAME, meaning="Which robot of the world; empty for all of them"),),
            returns="stopped, not_stopped, reasons",
        ),
        RESUME,
        Verb(
            "getStatus",
            Kind.READ,
            "Read simulated time, physics steps, joints, the policies that run and how the last ones ended.",
            (NONCE,),
            returns="task_status, sim_time, step_count, robots, running_policies, outcomes, locked, lockout, check_in",
            run=_world_status,
        ),
        Verb("getFeatures", Kind.READ, "Read joints, actuators and cameras by robot.", method="get_features"),
        Verb(
            "step",
            Kind.MOTION,
            "Step physics by hand, as fast as it computes.",
            (N_STEPS,),
            returns="sim_time, step_count",
            method="step",
            begin=step_world,
            suits=is_world,
            critical=False,
            of_world=True,
        ),
        Verb(
            "reset",
            Kind.MOTION,
            "Halt everything and put the world back to its initial state.",
            method="reset",
            begin=reset_world,
            suits=is_world,
            critical=False,
            of_world=True,
        ),
        *WORLD_MOTION_VERBS.values(),
        *PICTURE_VERBS.values(),
        *(for_robot(verb, ROBOT_NAME) for verb in (*LEAD_VERBS.values(), *CONTROL_VERBS.values())),
    ]
)


def _of_base(method: str, cannot: str) -> Begin:
    """Carry a verb out by a method of a mobile base; any other robot refuses it."""

    def begin(robot: Robot, arguments: Arguments, request: MotionRequest | None) -> Envelope:
        start = getattr(body_of(robot), method, None)
        if not callable(start):
            return error(cannot)
        # The operator's approval of this verb is the approval of what it sends.
        answer: Envelope = for_request(request, start)(**arguments, tool_context=Approved())
        return answer

    return begin


def _navigates(robot: Robot) -> bool:
    """Return True for a base with a navigation stack."""
    body = body_of(robot)
    return callable(getattr(body, "start_navigation", None)) and getattr(body, "nav_action", None) is not None


DRIVE = Verb(
    "drive",
    Kind.MOTION,
    "Drive for some seconds and return at once; follow it with getStatus or the taskComplete event.",
    (
        Parameter("linear", float, "Speed forwards in m/s; negative reverses", number),
        Parameter("angular", float, "Turning rate in rad/s; positive turns left", number),
        Parameter(
            "duration",
            float,
            f"Seconds until the base is stopped again, above 0 and at most {DURATION_MAX_S:g}",
            duration,
        ),
    ),
    returns="task_status",
    method="start_drive",
    begin=_of_base("start_drive", "drive: this robot is no mobile base."),
)
NAVIGATE_TO = Verb(
    "navigateTo",
    Kind.MOTION,
    "Send the base to a place around obstacles and return at once; follow it with getStatus or taskComplete.",
    (
        Parameter("x", float, "Position of the goal in metres, along the frame's x axis", number),
        Parameter("y", float, "Position of the goal in metres, along the frame's y axis", number),
        Parameter("yaw", float, "Heading at the goal in radians; positive is to the left", number, default=0.0),
        Parameter(
            "frame_id",
            str,
            "Frame in which the goal is given, such as map or odom",
            lambda name, value: text(name, value, longest=255),
            default="map",
        ),
        Parameter(
            "timeout",
            float,
            f"Seconds after which the goal is cancelled, above 0 and at most {DURATION_MAX_S:g}",
            duration,
            default=120.0,
        ),
    ),
    returns="task_status",
    method="start_navigation",
    suits=_navigates,
    begin=_of_base("start_navigation", "navigateTo: this robot has no navigation stack."),
)

BASE_VERBS = {**TASK_VERBS, **table([DRIVE])}
NAVIGATING_BASE_VERBS = {**BASE_VERBS, **table([NAVIGATE_TO])}
