"""Verbs of a mesh peer, for arms, worlds, mobile bases and Reachy Mini.

One table serves them all: a robot that lacks what a verb needs refuses it. :data:`KINDS` only says what callers may
expect of a kind.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

from strands_robots.adapted import lacks, task_status_of
from strands_robots.contract import (
    SETTLE,
    Robot,
    RolloutEvent,
    body_of,
    for_request,
    holds_robots,
    robots_in,
    task_runs,
)
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS, for_robot
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.lead_verbs import LEAD_VERBS
from strands_robots.serving.offered_verbs import offered
from strands_robots.serving.policy_arguments import known_provider, policy_host, repository, vector
from strands_robots.serving.reachy_verbs import REACHY_VERBS
from strands_robots.serving.robot_verbs import (
    DRIVE,
    GET_FEATURES,
    GET_STATE,
    NAVIGATE_TO,
    WORLD_VERBS,
    is_world,
    release_torque,
    releases_torque,
    reset_world,
    robot_of,
    step_world,
    takes_tasks,
)
from strands_robots.serving.verbs import (
    ASSERTION,
    DURATION,
    INSTRUCTION,
    MOTOR_IDS,
    NONCE,
    POLICY_PROVIDER,
    RESUME,
    Arguments,
    Kind,
    Verb,
    between,
    described,
    release_torque_verb,
    table,
)
from strands_robots.utils import identifier, number
from strands_robots.verb_parameters import REQUIRED, Parameter

POLL_S = 0.05
EXECUTE_GRACE_S = 10.0
"""Seconds besides its duration that a policy may take to end before ``execute`` of the mesh gives up on it."""

END_EVENT_S = 0.5


def _optional(name: str, type_: type, meaning: str, check: Any) -> Parameter:
    return Parameter(name, type_, meaning, check, default=None)


def _frequency(name: str, value: object) -> float:
    return number(name, value, low=0.1, high=2000)


_PEER_ROBOT = _optional("robot_name", str, "Which robot of the world; left out where there is only one", identifier)
_PEER_POLICY = (
    Parameter("policy_provider", str, POLICY_PROVIDER.meaning, known_provider, default=REQUIRED),
    _optional("instruction", str, INSTRUCTION.meaning, INSTRUCTION.check),
    DURATION,
    Parameter("policy_host", str, "Host of the policy's server, loopback or allowed", policy_host, "localhost"),
    _optional("policy_port", int, "TCP port of the policy's server, 1 to 65535", between(1, 65535)),
    _optional("pretrained_name_or_path", str, "Checkpoint on the Hub, org/name", repository),
    _optional("control_frequency", float, "Rate of the policy in Hz, 0.1 to 2000", _frequency),
    _optional("action_horizon", int, "Actions taken of each chunk, 1 to 10000", between(1, 10_000)),
    _optional("n_steps", int, "Actions after which the policy ends, 1 to 10000000", between(1, 10_000_000)),
    _optional("target_pose", list, "Goal of the tip: 7 numbers", vector(7, exactly=True)),
    _optional("target_joints", list, "Goal of the joints: 1 to 256 numbers", vector(256)),
    _optional("target_velocity", list, "Goal velocity: 1 to 16 numbers", vector(16)),
    _PEER_ROBOT,
)
_NONCE = replace(NONCE, default=None)
_SOURCE = Parameter("source_peer_id", str, "Peer that leads", identifier)
_PEER_ASSERTION = _optional("assertion", dict, ASSERTION.meaning, ASSERTION.check)
_DEVICE = _optional("device_name", str, "The leader's device; leader where left out", identifier)


def policy_start(robot: Robot, arguments: Arguments, request: MotionRequest | None = None) -> Callable[[], Envelope]:
    """Return the call that starts a policy with a mesh peer's options."""
    options = {name: value for name, value in arguments.items() if name != "robot_name"}
    if options.get("policy_host") == "localhost":
        del options["policy_host"]
    instruction = options.pop("instruction", "")
    if holds_robots(robot):
        name = robot_of(robot, arguments.get("robot_name"))
        return partial(for_request(request, robot.start_policy), name, instruction, **options)
    unknown = sorted(set(options) - _accepted(robot.start_task, options))
    if unknown:
        return partial(error, f"start: this robot takes no {', '.join(unknown)}.")
    return partial(for_request(request, robot.start_task), instruction, **options)


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
        started = policy_start(robot, arguments, request)()
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
        if holds_robots(robot) or "get_task_status" in lacks(robot):
            return {**started, "state": "unknown"}
        return robot.get_task_status()
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


def status(robot: Robot, arguments: Arguments) -> Envelope:
    """Return the task of a robot, or the policies that run in a world."""
    if not holds_robots(robot):
        return robot.get_task_status()
    running, task_status = robot.list_policies_running(), task_status_of(robot)
    if task_status == "unknown":
        return error(f"{robot.tool_name_str} exposes no list_policies_running.", task_status=task_status)
    return success(
        f"{len(running)} of {len(robot.list_robots())} robots run a policy.",
        task_status=task_status,
        robots=robot.list_robots(),
        policies=running,
        **{name: getattr(robot, name)() for name in ("failed_policies", "outcomes") if hasattr(robot, name)},
    )


def _peer_verb(name: str, kind: Kind, summary: str, parameters: tuple[Parameter, ...] = (), **carried_out: Any) -> Verb:
    return Verb(name, kind, summary, parameters, leaves_out=True, **carried_out)


def _follows(robot: Robot) -> bool:
    """Return True for a robot that takes the actions of a leader's stream."""
    return callable(getattr(body_of(robot), "send_action", None)) and not isinstance(body_of(robot), ReachyDriver)


def _of_reachy(verb: Verb) -> Verb:
    """Return a verb of Reachy Mini that every other robot refuses."""

    def begin(robot: Robot, arguments: Arguments, request: MotionRequest | None) -> object:
        body = body_of(robot)
        if not isinstance(body, ReachyDriver):
            return error(f"{verb.name}: this robot is no Reachy Mini.")
        return verb.call(body, arguments, request)()

    return replace(verb, leaves_out=True, begin=begin, suits=lambda robot: isinstance(body_of(robot), ReachyDriver))


_COMMON = {"getStatus", "resume", "releaseTorque", *CONTROL_VERBS}
"""Verbs of Reachy Mini that every peer has; its status is the peer's ``status``."""

_REACHY = tuple(
    _of_reachy(verb) for verb in REACHY_VERBS.values() if (verb.run or verb.begin) and verb.name not in _COMMON
)

PEER_VERBS = table(
    [
        _peer_verb("status", Kind.READ, "Read the task, or the policies that run in a world.", (_NONCE,), run=status),
        _peer_verb("stop", Kind.STOP, "Stop the robot, or the named robot of a world.", (_PEER_ROBOT,)),
        _peer_verb("features", Kind.READ, GET_FEATURES.summary, method="get_features"),
        _peer_verb("state", Kind.READ, GET_STATE.summary, method="get_state"),
        _peer_verb(
            "execute", Kind.MOTION, "Run a policy and wait for its end.", _PEER_POLICY, lasts=True, suits=takes_tasks
        ),
        _peer_verb(
            "start",
            Kind.MOTION,
            "Start a policy and return at once.",
            _PEER_POLICY,
            begin=lambda robot, arguments, request: policy_start(robot, arguments, request)(),
            suits=takes_tasks,
        ),
        _peer_verb(
            "step",
            Kind.MOTION,
            WORLD_VERBS["step"].summary,
            (_optional("steps", int, "Physics steps to take, 1 to 10000", between(1, 10_000)),),
            method="step",
            begin=step_world,
            suits=is_world,
            of_world=True,
        ),
        _peer_verb(
            "reset",
            Kind.MOTION,
            WORLD_VERBS["reset"].summary,
            method="reset",
            begin=reset_world,
            suits=is_world,
            of_world=True,
        ),
        _peer_verb("teleop_status", Kind.READ, "Read the counters of every input stream.", suits=_follows),
        _peer_verb(
            "teleop_receive", Kind.MOTION, "Follow a leader's input stream.", (_SOURCE, _DEVICE), suits=_follows
        ),
        _peer_verb(
            "teleop_stop",
            Kind.READ,
            "Close the named input stream, or all of them.",
            (_optional("source_peer_id", str, _SOURCE.meaning, identifier), _DEVICE),
            urgent=True,
            suits=_follows,
        ),
        release_torque_verb(
            _optional("motor_ids", str, MOTOR_IDS.meaning, MOTOR_IDS.check),
            leaves_out=True,
            method="release_torque",
            run=release_torque,
            suits=releases_torque,
        ),
        _peer_verb("resume", Kind.RESUME, RESUME.summary, (_PEER_ASSERTION,), urgent=True),
        _peer_verb("ping", Kind.READ, "Answer that the peer is there."),
        _peer_verb("describe", Kind.READ, "Describe the verbs of the robot, with parameters.", returns="functions"),
        *(
            for_robot(verb, _PEER_ROBOT, leaves_out=True)
            for verb in (*ARM_MOTION_VERBS.values(), *LEAD_VERBS.values(), *CONTROL_VERBS.values())
        ),
        *(replace(verb, leaves_out=True) for verb in (*PICTURE_VERBS.values(), DRIVE, NAVIGATE_TO)),
        *_REACHY,
    ]
)
"""The actions of the mesh; ``execute``, ``stop``, ``resume``, ``ping``, ``describe``, teleoperation are the peer's."""

TELEOP_VERBS = tuple(name for name in PEER_VERBS if name.startswith("teleop_"))

_OF_ALL = ("status", "stop", "features", "state", "resume", "ping", "describe", *CONTROL_VERBS)
_OF_NO_ROBOT = ("ping", "describe")
_OF_TASKS = ("execute", "start", *(name for name in PEER_VERBS if name.startswith("teleop_")))
_OF_ARMS = (*_OF_TASKS, "releaseTorque", *ARM_MOTION_VERBS, *LEAD_VERBS, *PICTURE_VERBS)

KINDS: Mapping[str, tuple[str, ...]] = {
    "world": (*_OF_ALL, "execute", "start", "step", "reset", *ARM_MOTION_VERBS, *LEAD_VERBS, *PICTURE_VERBS),
    "robot": (*_OF_ALL, *_OF_ARMS),
    "mobile_base": (*_OF_ALL, "drive"),
    "navigating_base": (*_OF_ALL, "drive", "navigateTo"),
    "reachy_mini": (*_OF_ALL, "releaseTorque", *(verb.name for verb in _REACHY)),
}
"""Actions that the robots of a kind carry out, as presence names the kind; every other one they refuse."""


def description_of(robot: Robot | None, own: Mapping[str, Verb] = MappingProxyType({})) -> Envelope:
    """Return the answer to ``describe``: verbs in Device Connect's shape.

    Args:
        robot: None for a peer without one.
        own: the verbs that the robot declares.
    """
    carried_out = {name: PEER_VERBS[name] for name in _OF_NO_ROBOT} if robot is None else offered(robot, PEER_VERBS)
    verbs = [*carried_out.values(), *own.values()]
    return success(f"{len(verbs)} verbs.", functions=[described(each) for each in verbs])


def kind_of(robot: Robot) -> str:
    """Return the kind of a robot, one of :data:`KINDS`."""
    body = body_of(robot)
    if holds_robots(robot):
        return "world"
    if isinstance(body, ReachyDriver):
        return "reachy_mini"
    if not callable(getattr(body, "start_drive", None)):
        return "robot"
    return "mobile_base" if getattr(body, "nav_action", None) is None else "navigating_base"


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
