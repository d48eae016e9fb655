"""``robot_mesh``: one agent tool that finds robots, drives them and stops them.

::

    from strands import Agent
    from strands_robots.tools import robot_mesh

    Agent(tools=[robot_mesh])("Which robots are there? Let the arm wave.")
"""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import Any

from strands_robots import settings
from strands_robots.agent_tool import fitted_tool
from strands_robots.bounded_json import SMALL_BYTES, OutOfBoundsError, parsed
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.errors import NoSuchRobotError, RefusalError, StrandsRobotsError, UnknownVerbError
from strands_robots.fleet.adapter import STOP_S, TOOL, FoundRobot, NetworkAdapter, StopRequest
from strands_robots.fleet.joining import side_by_side
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.profiles import networks_for_stop, networks_of, profile_for
from strands_robots.fleet.reports import near_verbs, said
from strands_robots.fleet.stops import answer_of, estop_all, stop_all
from strands_robots.fleet.verdicts import by_bearer, combined_verdict
from strands_robots.serving import advertised
from strands_robots.serving.advertised import RobotDescription, fitting
from strands_robots.serving.robot_verbs import TASK_VERBS, WORLD_VERBS
from strands_robots.serving.stop_arguments import noted, stop_reason, stop_robot, stop_scope
from strands_robots.serving.verbs import unknown_arguments
from strands_robots.utils import (
    WAIT_S,
    ValidationError,
    choice,
    device_id,
    identifier,
    mapping,
    number,
    plain_text,
    shown,
)

CALLED = {"move": "moveTo", "picture": "getPicture", "wait": "wait"}
"""Verb of each action that calls one where none is named."""

STOPS = ("stop", "emergency_stop")
BODIES = ("send", "broadcast")
"""Actions whose arguments name the action of the robot."""

ACTIONS = ("peers", "tell", "status", *STOPS, "release_torque", "call", *CALLED, "ping", *BODIES)
NEEDS_TARGET = ("tell", "release_torque", "call", *CALLED, "ping", "send")

BROADCAST = ("status", "state", "features")
"""Reads that a broadcast asks every robot for."""

ANSWER_S = 10.0

CALL_S = ANSWER_S + WAIT_S
"""Longest wait for the answer to a verb, which may wait for the end of a motion."""

OWN_BYTES = 16_000
"""Size of what the list of robots says on one robot's own verbs."""


SUBSCRIPTIONS = ("subscribe", "unsubscribe", "watch", "inbox")
NO_SUBSCRIPTION = (
    "the tool keeps no subscription: status says what a robot does now, and connect() follows a robot's events"
)


INPUTS = ("action", "target", "instruction", "policy_provider", "duration", "verb", "arguments", "timeout")
IGNORED = {"tool_context": None, "limit": 50, "name": "", "function": "", "command": "", "policy_port": 0}
"""Inputs of strands-robots 0.5 with the values by which they say nothing."""


def _readable(given: dict[str, Any]) -> dict[str, Any]:
    """Return input as the tool's schema has it; the names of 0.5 are read, too.

    What it does not have is an argument of the verb, which a motion refuses by name, instead of left out.
    """
    action = given.get("action")
    if action in STOPS:
        return _readable_stop(given)
    stated = {name: value for name, value in given.items() if name not in IGNORED or value not in (None, IGNORED[name])}
    stated.pop("tool_context", None)
    if function := stated.pop("function", None):
        stated["verb"] = stated.get("verb") or function
    if command := stated.pop("command", None):
        stated["arguments"] = stated.get("arguments") or command
    if isinstance(stated.get("arguments"), str):
        stated["arguments"] = _object(stated["arguments"])
    body = stated.get("arguments")
    if action in BODIES and (stop := _stop_in(body, str(given.get("target") or "") if action == "send" else "")):
        return _readable_stop(stop)
    if action in ("call", "rpc") and str(stated.get("verb")) in advertised.STOPS:
        said = {name: value for name, value in stated.items() if name not in ("timeout", "arguments")}
        fields = body.items() if isinstance(body, dict) else ()
        kept = {name: value for name, value in fields if isinstance(value, str | int | float | None)}
        return {name: value for name, value in said.items() if name in INPUTS} | {"action": "call", "arguments": kept}
    known = {name: value for name, value in stated.items() if name in INPUTS}
    more = {name: value for name, value in stated.items() if name not in INPUTS and value is not None}
    if more and isinstance(body, dict | None):
        known["arguments"] = {**more, **(body or {})}
    return {**known, "action": "call"} if action == "rpc" else known


def _stop_in(body: object, target: str) -> dict[str, Any] | None:
    """Return the stop that a ``send`` or ``broadcast`` is, or None."""
    fields = body if isinstance(body, dict) else {"action": body}
    name, rest = str(fields.get("action")), {key: value for key, value in fields.items() if key != "action"}
    if name in advertised.STOPS:
        return {"action": "stop", "target": target, "arguments": rest}
    if name == "emergency_stop":
        return {"action": name, "arguments": rest | ({"only": [target]} if target else {})}
    return None


def _object(command: object) -> object:
    """Return the JSON value of a text; the text where it has none."""
    try:
        return parsed(command, SMALL_BYTES) if isinstance(command, str) else command
    except (ValueError, OutOfBoundsError):
        return command


def _readable_stop(given: dict[str, Any]) -> dict[str, Any]:
    """Return the input of a stop as the tool's schema has it."""
    texts = {name: given[name] for name in ("target", "instruction") if given.get(name) is not None}
    arguments = given.get("arguments")
    fields = arguments if isinstance(arguments, dict) else {} if arguments is None else {shown(arguments): None}
    return {
        "action": given["action"],
        **{name: value if isinstance(value, str) else shown(value) for name, value in texts.items()},
        **({"arguments": fields} if fields else {}),
    }


@fitted_tool(_readable)
def robot_mesh(
    action: str,
    target: str = "",
    instruction: str = "",
    policy_provider: str = "mock",
    duration: float = 30.0,
    *,
    verb: str = "",
    arguments: dict[str, Any] | None = None,
    timeout: float | None = None,
) -> dict[str, Any]:
    """Find robots, give them instructions, ask for their status, and stop them.

    A robot that does not answer, or does not confirm that it stopped, is an error: never assume that it stands still.

    Args:
        action: peers lists the robots; tell gives one an instruction and returns once the motion has started; status
            returns what one is doing, or lists all without a target; stop stops one, or all without a target, or with
            arguments {"robot_name": ...} one robot of a world; emergency_stop stops and locks all, or with arguments
            {"only": ["arm-1"]} some and with {"cell": "cell-1"} those of a cell and every robot without one;
            release_torque stops one and switches its motors off, so that it falls, once its operator approved that;
            move moves an arm (moveTo, or another verb) and returns what it reached; picture returns a camera's picture
            (getPicture); wait waits for the end of a motion; call calls any verb that peers lists; ping says how fast a
            robot answers; broadcast asks all for their status, state or features, or stops all, and send asks one, by
            arguments such as {"action": "status"}.
        target: The robot's id, as peers lists it. Needed by all but peers, status, broadcast, stop and emergency_stop.
        instruction: What to do, in plain language, 1 to 2000 characters. For emergency_stop: the reason.
        policy_provider: Policy that decides the actions, such as remote or lerobot_local; mock moves by itself and
            follows no instruction.
        duration: Longest time the motion may take, in seconds, above 0 and at most 3600.
        verb: For call: the verb, such as getObjects, pick, drive or look. For move: moveTo (x, y, z in metres in the
            base frame, x forward), moveBy (dx, dy, dz, or direction and distance), moveJoints (joints in degrees),
            setGripper (opening 0 closed to 1 open), goTo (place), pick (object) or place (x, y, or on). Each
            takes picture, the camera whose picture its answer brings.
        arguments: The verb's arguments by name, such as {"x": 0.25, "y": 0.0, "z": 0.1} or {"camera": "table"}.
        timeout: Longest wait for an answer, in seconds, above 0 and at most 3600; by default as long as the action
            needs. A stop ignores it.
    """
    if action == "emergency_stop":
        return _emergency_stop(instruction, arguments)
    if action == "stop":
        return _stop(target, arguments)
    try:
        if isinstance(action, str) and action in SUBSCRIPTIONS:
            return error(f"action {action} is none here: {NO_SUBSCRIPTION}.")
        asked = choice("action", action, ACTIONS)
        robot = device_id("target", target) if target or asked in NEEDS_TARGET else ""
        longest = None if timeout is None else number("timeout", timeout, above=0, high=3600)
        moving = asked in (*CALLED, "call", "tell", *BODIES)
        given = mapping("arguments", arguments or {}) if moving else {}
        if asked in CALLED or asked == "call":
            name = identifier("verb", verb or CALLED.get(asked, ""))
            return _with_image(_asked(lambda there: _called(there, robot, name, given, longest)))
        if asked == "tell":
            task = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration} | given
            checked = TASK_VERBS["execute"].checked(task)
            wanted = {name: checked[name] for name in checked if name in task}
            return _asked(lambda there: _started(there, robot, wanted, longest))
        if asked in BODIES:
            body = dict(given)
            name = identifier("arguments action", body.pop("action", None))
            if asked == "broadcast":
                return _broadcast(name, longest)
            return _with_image(_asked(lambda there: _sent(there, robot, name, body, longest)))
    except ValidationError as refused:
        return error(str(refused))
    if asked == "release_torque":
        return _asked(lambda there: there.call(robot, "releaseTorque", {}, longest or ANSWER_S))
    if asked == "ping":
        return _asked(lambda there: _pinged(there, robot, longest))
    return _asked((lambda there: _status(there, robot, longest)) if asked == "status" and robot else _peers)


def _peers(there: Networks) -> Envelope:
    """List all that are in reach, with type, state, lockout, functions and network.

    Verbs of its own come with their parameters, in the robot's words.
    """
    found = there.find(None, peers=True)
    functions: dict[str, object] = {}
    for network in there.joined:
        # A robot of a network that is lost in between is listed without its verbs.
        with suppress(RefusalError):
            functions |= network.describe_each([name for name, (_, its) in found.items() if its is network])
    rows = [_row(each, network.name, functions.get(name)) for name, (each, network) in sorted(found.items())]
    missing = there.missing
    fields: dict[str, Any] = {"peers": rows, **({"absent": missing} if missing else {})}
    who = f"{len(rows)} robots: {', '.join(sorted(found))}." if rows else f"No robot answered. {there.reach}".rstrip()
    told = " ".join(filter(None, [who, there.stale, _not_reached(missing)]))
    return success(told, **fields) if rows else error(told, **fields)


def _not_reached(missing: Mapping[str, str]) -> str:
    """Return a sentence on the stated networks that are not there, or ""."""
    named = "; ".join(f"{name}, {why.rstrip('.')}" for name, why in missing.items())
    return f"Not reached: {named}." if named else ""


def _status(there: Networks, robot: str, timeout: float | None) -> Envelope:
    network = there.of(robot)
    return network.call(robot, network.reads["status"], {}, timeout or ANSWER_S)


def _pinged(there: Networks, robot: str, timeout: float | None) -> Envelope:
    """Say how long the robot takes to answer with its status."""
    network, began = there.of(robot), time.monotonic()
    answer = network.call(robot, network.reads["status"], {}, timeout or ANSWER_S)
    took = round(1000 * (time.monotonic() - began), 1)
    return answer if is_error(answer) else success(f"{robot} answered in {took:g} ms.", latency_ms=took)


def _sent(there: Networks, robot: str, action: str, arguments: Mapping[str, Any], timeout: float | None) -> Envelope:
    """Send a command by its name on the mesh, whatever the network calls it."""
    network = there.of(robot)
    verb = network.starts if action == "start" else network.reads.get(action, action)
    return _called(there, robot, verb, arguments, timeout)


def _broadcast(action: str, timeout: float | None) -> Envelope:
    """Ask every robot; none is moved, because its operator approves each motion."""

    def asked(there: Networks) -> Envelope:
        found = sorted((name, each) for name, each in there.find(None).items() if not each[0].world)
        answers = side_by_side(lambda each: _answered(each[0], each[1][1], action, timeout), found)
        silent = [name for (name, _), answer in zip(found, answers, strict=True) if is_error(answer)]
        rows = [{"robot_id": name, **answer} for (name, _), answer in zip(found, answers, strict=True)]
        told = f"{len(rows) - len(silent)} of {len(rows)} robots answered {action}."
        if silent or not rows:
            return error(f"{told} No answer: {', '.join(silent) or 'there is no robot'}.", responses=rows)
        return success(told, responses=rows)

    if action not in BROADCAST:
        only = f"arguments action must be {', '.join(BROADCAST)} or stop for a broadcast, not {shown(action)}"
        return error(f"{only}: give a motion to each robot by tell or call, so that each asks its own operator.")
    return _asked(asked)


def _answered(robot: str, network: NetworkAdapter, read: str, timeout: float | None) -> Envelope:
    try:
        return network.call(robot, network.reads[read], {}, timeout or ANSWER_S)
    except RefusalError as refusal:
        return error(said(refusal))


def _started(there: Networks, robot: str, task: Mapping[str, Any], timeout: float | None) -> Envelope:
    """Have the robot start a task."""
    network = there.of(robot, "tell", moves=True)
    return network.call(robot, network.starts, task, timeout or ANSWER_S)


def _called(there: Networks, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float | None) -> Envelope:
    """Call any verb of the robot, and wait as long as it lasts by its description."""
    if verb in advertised.STOPS:
        return there.call(robot, verb, arguments, STOP_S)
    network, described = there.described(robot, verb)
    within = timeout or CALL_S + (described.lasts_s if described is not None else 0.0)
    try:
        return network.call(robot, verb, arguments, within)
    except UnknownVerbError as refusal:
        text = said(refusal)
        return error(text if "Near it: " in text else f"{text.rstrip('.')}.{near_verbs(network, robot, verb)}")


def _stop(target: object, arguments: object) -> dict[str, Any]:
    """Stop a robot, one of a world, or all; no argument refuses it."""
    robot, unknown = stop_robot("target", target)
    given = arguments if isinstance(arguments, dict) else {}
    of_world, unread = WORLD_VERBS["stop"].readable(given) if robot else ({}, "")
    if arguments and not given:
        unread = "arguments is no object"

    def stopped(there: Networks) -> Envelope:
        if not robot:
            return answer_of(stop_all(there), there)
        return combined_verdict(by_bearer(robot, there.stop(robot, STOP_S, of_world.get("robot_name", ""))))

    return noted(_answer(stopped, stops=True), unknown, unread)


def _emergency_stop(instruction: object, arguments: object) -> dict[str, Any]:
    """Stop and lock all robots, or those that the arguments mean; none refuses it."""
    why, cut = stop_reason(instruction)
    given = arguments if isinstance(arguments, dict) else {}
    scope, unread = stop_scope(given.get("only"), given.get("cell"))
    unknown = unknown_arguments(len(given.keys() - {"only", "cell"}))
    if arguments and not given:
        unread = "arguments is no object"
    answer = _answer(lambda there: answer_of(estop_all(there, StopRequest(why, scope)), there), stops=True)
    return noted(answer, cut, unread, unknown)


def _asked(work: Callable[[Networks], Envelope]) -> Envelope:
    """Return what ``work`` answers on networks that are joined; as :func:`_answer`."""

    settings.warn_of_unread()

    def joined(there: Networks) -> Envelope:
        there.open()
        try:
            return work(there)
        except NoSuchRobotError as refusal:
            return error(f"{said(refusal)} {_not_reached(there.missing)}".rstrip())

    return _answer(joined, stops=False)


def _answer(work: Callable[[Networks], Envelope], *, stops: bool) -> Envelope:
    """Return what ``work`` answers on networks of its own, or an error envelope.

    They are those of the default connection profile, ``STRANDS_FLEET``, if there is one; the mesh alone where
    ``STRANDS_ROBOT_MESH_DC`` says so. They are left at the end.

    Args:
        work: asks robots.
        stops: they are asked to stop.
    """
    on_mesh = settings.raw("STRANDS_ROBOT_MESH_DC").lower() in settings.FALSE_SPELLINGS
    make, fields = (networks_for_stop, {"stopped": None}) if stops else (networks_of, {})
    try:
        with closing(make(profile_for(None, {}), {}, TOOL, devices=not on_mesh)) as there:
            return _read_by_a_model(work(there))
    except RefusalError as refusal:
        return error(said(refusal), **fields)
    except (StrandsRobotsError, LookupError, TimeoutError, RuntimeError, ValueError) as exc:
        return error(str(exc.args[0]) if exc.args else type(exc).__name__, **fields)


def _read_by_a_model(answer: Envelope) -> Envelope:
    """Return an answer whose error has a text, as a model reads it."""
    if not is_error(answer) or "content" in answer:
        return answer
    fields = {name: value for name, value in answer.items() if name not in ("status", "reason")}
    return error(plain_text(text_of(answer)) or "It gave no reason.", **fields)


def _row(found: FoundRobot, network: str, functions: object) -> dict[str, Any]:
    """Return what a list of robots says on one."""
    description = RobotDescription.of(functions)
    verbs = description.verbs.values()
    # Of a verb that was only named there is no more to say.
    described = (each for each in verbs if each.own and (each.stated or each.summary))
    own = dict(fitting(((each.name, f"({each.takes}) {each.summary}") for each in described), OWN_BYTES))
    return {
        "id": found.id,
        "type": found.type,
        "status": found.status,
        **({} if found.locked is None else {"locked": found.locked}),
        "network": network,
        "functions": [each.name for each in verbs],
        **({"own_verbs": own} if own else {}),
        **({"note": description.absent} if description.absent and functions is not None else {}),
    }


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
