"""``robot_mesh``: one agent tool that finds robots, drives them and stops them.

::

    from strands import Agent
    from strands_robots.tools import robot_mesh

    Agent(tools=[robot_mesh])("Which robots are there? Let the arm wave.")
"""

from __future__ import annotations

import base64
from functools import partial
from typing import Any

from strands_robots.agent_tool import fitted, tool
from strands_robots.envelope import error
from strands_robots.serving.robot_verbs import ARM_VERBS, WORLD_VERBS
from strands_robots.serving.stop_arguments import noted, stop_reason, stop_robot, stop_scope
from strands_robots.serving.verbs import unknown_arguments
from strands_robots.tools import networks
from strands_robots.utils import WAIT_S, ValidationError, choice, device_id, identifier, mapping, shown

CALLED = {"move": "moveTo", "picture": "getPicture", "wait": "wait"}
"""Verb of each action that calls one where none is named."""

STOPS = ("stop", "emergency_stop")
ACTIONS = ("peers", "tell", "status", *STOPS, "release_torque", "call", *CALLED)
NEEDS_TARGET = ("tell", "status", "release_torque", "call", *CALLED)

CALL_S = networks.ANSWER_S + WAIT_S
"""Longest wait for the answer to a verb, which may wait for the end of a motion."""


def _readable_stop(given: dict[str, Any]) -> dict[str, Any]:
    """Return the input of a stop as the tool's schema has it."""
    if given.get("action") not in STOPS:
        return given
    texts = {name: given[name] for name in ("target", "instruction") if given.get(name) is not None}
    arguments = given.get("arguments")
    return {
        "action": given["action"],
        **{name: value if isinstance(value, str) else shown(value) for name, value in texts.items()},
        **({"arguments": arguments if isinstance(arguments, dict) else {shown(arguments): None}} if arguments else {}),
    }


@partial(fitted, fit=_readable_stop)
@tool
def robot_mesh(
    action: str,
    target: str = "",
    instruction: str = "",
    policy_provider: str = "mock",
    duration: float = 30.0,
    *,
    verb: str = "",
    arguments: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Find robots, give them instructions, ask for their status, and stop them.

    A robot that does not answer, or does not confirm that it stopped, is an error: never assume that it stands still.

    Args:
        action: peers lists the robots; tell gives one an instruction and returns once the motion has started; status
            returns what one is doing; stop stops one, or all without a target, or with arguments {"robot_name": ...}
            one robot of a world; emergency_stop stops and locks all, or with arguments {"only": ["arm-1"]} some and
            with {"cell": "cell-1"} those of a cell and every robot without one;
            release_torque stops one and switches its motors off, so that it falls, once its operator approved that;
            move moves an arm (moveTo, or another verb) and returns what it reached; picture returns a camera's
            picture (getPicture); wait waits for the end of a motion; call calls any verb that peers lists.
        target: The robot's id, as peers lists it. Needed by all but peers, stop and emergency_stop.
        instruction: What to do, in plain language, 1 to 2000 characters. For emergency_stop: the reason.
        policy_provider: Policy that decides the actions, such as remote or lerobot_local; mock moves by itself and
            follows no instruction.
        duration: Longest time the motion may take, in seconds, above 0 and at most 3600.
        verb: For call: the verb, such as getObjects, pick, drive or look. For move: moveTo (x, y, z in metres in the
            base frame, x forward), moveBy (dx, dy, dz, or direction and distance), moveJoints (joints in degrees),
            setGripper (opening 0 closed to 1 open), goTo (place), pick (object) or place (x, y, or on). Each
            takes picture, the camera whose picture its answer brings.
        arguments: The verb's arguments by name, such as {"x": 0.25, "y": 0.0, "z": 0.1} or {"camera": "table"}.
    """
    if action == "emergency_stop":
        return _emergency_stop(instruction, arguments)
    if action == "stop":
        return _stop(target, arguments)
    try:
        asked = choice("action", action, ACTIONS)
        robot = device_id("target", target) if target or asked in NEEDS_TARGET else ""
        if asked in CALLED or asked == "call":
            name = identifier("verb", verb or CALLED.get(asked, ""))
            given = mapping("arguments", {} if arguments is None else arguments)
            return _with_image(networks.network().call(robot, name, given, CALL_S))
        if asked == "tell":
            given = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
            task = ARM_VERBS["execute"].checked(given)
            return networks.network().tell(robot, task["instruction"], task["policy_provider"], task["duration"])
    except ValidationError as refused:
        return error(str(refused))
    if asked == "release_torque":
        return networks.network().release_torque(robot)
    return networks.network().status(robot) if asked == "status" else networks.network().peers()


def _stop(target: object, arguments: object) -> dict[str, Any]:
    """Stop a robot, one of a world, or all; no argument refuses it."""
    robot, unknown = stop_robot("target", target)
    given = arguments if isinstance(arguments, dict) else {}
    of_world, unread = WORLD_VERBS["stop"].readable(given) if robot else ({}, "")
    if arguments and not given:
        unread = "arguments is no object"
    one = of_world.get("robot_name", "")
    return noted(networks.network().stop(robot, *([one] if one else [])), unknown, unread)


def _emergency_stop(instruction: object, arguments: object) -> dict[str, Any]:
    """Stop and lock all robots, or those that the arguments mean; none refuses it."""
    why, cut = stop_reason(instruction)
    given = arguments if isinstance(arguments, dict) else {}
    scope, unread = stop_scope(given.get("only"), given.get("cell"))
    unknown = unknown_arguments(len(given.keys() - {"only", "cell"}))
    if arguments and not given:
        unread = "arguments is no object"
    network = networks.network()
    answer = network.emergency_stop(why) if scope.everything else network.emergency_stop(why, scope=scope)
    return noted(answer, cut, unread, unknown)


def _with_image(answer: dict[str, Any]) -> dict[str, Any]:
    """Return an answer whose picture is an image block, as models take it."""
    taken = answer.get("picture")
    encoded = taken.get("jpeg") if isinstance(taken, dict) else answer.get("jpeg")
    if not isinstance(encoded, str):
        return answer
    try:
        image = base64.b64decode(encoded, validate=True)
    except ValueError:
        return error("The robot's picture could not be decoded.")
    content = [*answer.get("content", []), {"image": {"format": "jpeg", "source": {"bytes": image}}}]
    return {**{name: value for name, value in answer.items() if name not in ("jpeg", "picture")}, "content": content}
