"""Verbs of arms, vehicles and worlds, and the methods that carry them out.

Device Connect serves :data:`ARM_VERBS` and :data:`WORLD_VERBS`, the mesh :data:`PEER_VERBS`.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from strands_robots.bus_access import read_joints
from strands_robots.contract import (
    SETTLE,
    Robot,
    RolloutEvent,
    WorldRobot,
    behind_contract,
    body_of,
    for_request,
    holds_robots,
    robots_in,
    task_runs,
)
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS, WORLD_MOTION_VERBS, for_robot
from strands_robots.serving.control_verbs import CONTROL_VERBS
from strands_robots.serving.picture_verbs import PICTURE_VERBS
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
    Kind,
    Verb,
    release_torque_verb,
    table,
)
from strands_robots.utils import ValidationError, shown

POLL_S = 0.05
EXECUTE_GRACE_S = 10.0
"""Seconds besides its duration that a policy may take to end before ``execute`` of the mesh gives up on it."""

END_EVENT_S = 0.5

WORLD_MEMBERS = (
    *("tool_name_str", "gate", "halt", "subscribe", "list_robots", "start_policy", "stop_policy"),
    *("list_policies_running", "get_state", "get_features", "step", "reset"),
)
"""The members that make an object a world."""


def served(robot: Any) -> Robot:
    """Return ``robot`` behind its contract.

    Raises:
        ValidationError: it is neither a world nor a robot that :func:`~strands_robots.contract.adapt` makes fit.
    """
    return behind_contract(robot, read_joints)


def served_world(robot: Any) -> WorldRobot:
    """Return ``robot``, which has to be a world.

    Raises:
        ValidationError: naming the members that it lacks.
    """
    if holds_robots(robot):
        return robot
    lacking = [name for name in WORLD_MEMBERS if not hasattr(robot, name)]
    needs = ", ".join(WORLD_MEMBERS)
    raise ValidationError(f"a simulation must have {needs}; {shown(robot)} lacks {', '.join(lacking)}.")


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


def peer_stop_answer(verdict: StopVerdict) -> dict[str, Any]:
    """Return a verdict as a mesh peer answers ``stop``."""
    doubts = {**verdict.not_stopped, **verdict.unknown}
    result: dict[str, Any] = {
        "ok": verdict.stopped is True,
        "stopped": list(verdict.halted),
        "not_stopped": list(doubts),
        "results": {**dict.fromkeys(verdict.halted, "stopped"), **doubts},
        **({"settling": True} if verdict.settling else {}),
    }
    if doubts:
        result["error"] = "; ".join(f"{name}: {why}" for name, why in doubts.items())
    return result


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


def status(robot: Robot, arguments: Arguments) -> Envelope:
    """Return the task of a robot, or the policies that run in a world."""
    if not holds_robots(robot):
        return robot.get_task_status()
    running = robot.list_policies_running()
    return success(
        f"{len(running)} of {len(robot.list_robots())} robots run a policy.",
        task_status="running" if running else "idle",
        robots=robot.list_robots(),
        policies=running,
        **{name: getattr(robot, name)() for name in ("failed_policies", "outcomes") if hasattr(robot, name)},
    )


def _world_status(world: WorldRobot, arguments: Arguments) -> Envelope:
    running = world.list_policies_running()
    return {**world.get_state(), "task_status": "running" if running else "idle"}


def start(robot: Robot, arguments: Arguments, request: MotionRequest | None = None) -> Envelope:
    """Start a policy with a mesh peer's options, on ``robot_name`` of a world."""
    options = {name: value for name, value in arguments.items() if name != "robot_name"}
    if options.get("policy_host") == "localhost":
        del options["policy_host"]
    instruction = options.pop("instruction", "")
    if holds_robots(robot):
        name = robot_of(robot, arguments.get("robot_name"))
        return for_request(request, robot.start_policy)(name, instruction, **options)
    unknown = sorted(set(options) - _accepted(robot.start_task, options))
    if unknown:
        return error(f"start: this robot takes no {', '.join(unknown)}.")
    return for_request(request, robot.start_task)(instruction, **options)


def run_to_end(
    robot: Robot, arguments: Arguments, closing: Callable[[], bool], request: MotionRequest | None = None
) -> Envelope:
    """Start a policy and wait for its end or for ``closing``."""
    name = (arguments.get("robot_name") or next(iter(robots_in(robot)), "")) if holds_robots(robot) else None
    ends: list[RolloutEvent] = []

    def observe(event: RolloutEvent) -> None:
        if event.kind == "finished" and event.policy != SETTLE and name in (None, event.robot):
            ends.append(event)

    unsubscribe = robot.subscribe(observe)
    try:
        started = start(robot, arguments, request)
        if is_error(started):
            return started
        deadline = time.monotonic() + arguments["duration"] + EXECUTE_GRACE_S
        return _awaited_end(robot, name, started, ends, deadline, closing)
    finally:
        unsubscribe()


def _awaited_end(  # noqa: PLR0917 - one call, for the length of run_to_end
    robot: Robot,
    name: str | None,
    started: Envelope,
    ends: list[RolloutEvent],
    deadline: float,
    closing: Callable[[], bool],
) -> Envelope:
    while not ends and task_runs(robot, name or ""):
        if closing():
            return error("execute: this peer left the mesh while the policy ran.", started=started)
        if time.monotonic() >= deadline:
            return error("execute: the policy outlived its duration.", started=started)
        time.sleep(POLL_S)
    # A rollout that runs no more has told its end, or is about to.
    last = time.monotonic() + END_EVENT_S
    while not ends and holds_robots(robot) and time.monotonic() < last:
        time.sleep(POLL_S)
    if not ends:
        return {**started, "state": "unknown"} if holds_robots(robot) else robot.get_task_status()
    end = ends[-1]
    facts = {"state": end.state, "task_status": end.state, "step_count": end.step, "elapsed_s": end.elapsed_s}
    if end.state == "error":
        return error(f"execute: {end.error or 'the policy failed'}", robot=end.robot, **facts)
    return success(f"{end.robot} {end.state} after {end.step} steps.", robot=end.robot, **facts)


def _accepted(method: Callable[..., Any], options: dict[str, Any]) -> set[str]:
    parameters = inspect.signature(method).parameters
    if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
        return set(options)
    return set(parameters)


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
        return bool(robot.list_robots())
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
ARM_VERBS = table(
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
            begin=step_world,
            suits=is_world,
            critical=False,
            of_world=True,
        ),
        Verb(
            "reset",
            Kind.MOTION,
            "Halt everything and put the world back to its initial state.",
            begin=reset_world,
            suits=is_world,
            critical=False,
            of_world=True,
        ),
        *WORLD_MOTION_VERBS.values(),
        *PICTURE_VERBS.values(),
        *(for_robot(verb, ROBOT_NAME) for verb in CONTROL_VERBS.values()),
    ]
)
