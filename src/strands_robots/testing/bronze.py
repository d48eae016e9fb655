"""Bronze: a robot can be read, and refuses by name what it does not declare."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from strands_robots.adapted import behind_contract
from strands_robots.contract import AT_REST, RUNNING, holds_robots
from strands_robots.errors import NoAnswerError, RefusalError, RobotError
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.serving.advertised import AdvertisedVerb
from strands_robots.testing.bench import (
    ConformanceBench,
    DriftError,
    NetworkBench,
    NotKeptError,
    NotProvenError,
    within,
)
from strands_robots.testing.promise import promise

NUMBERS = ("integer", "number")


@promise(
    "bronze.verbs",
    "Both networks list its verbs, the same ones of its own, each with a description.",
    why="An agent calls what it finds; a verb that one network lacks is a robot that is another one there.",
    look="docs/own-robots.md: the methods with @verb and their docstrings",
)
def verbs(bench: NetworkBench) -> str:
    """Compare the lists of both networks."""
    own = {name: sorted(each.name for each in robot.verbs.values() if each.own) for name, robot in bench.on.items()}
    if len({tuple(names) for names in own.values()}) > 1:
        raise DriftError(f"its own verbs differ by network: {own}")
    for robot in bench.on.values():
        if not robot.has_stop:
            raise NotKeptError(f"it has no stop on {robot.network}")
        if robot.left_out:
            raise NotKeptError(f"left out of its description: {', '.join(robot.left_out)}")
        bare = [each.name for each in robot.verbs.values() if not each.purpose.strip()]
        if bare:
            raise NotKeptError(f"without a description: {', '.join(bare)}")
    return f"{len(bench.remote.verbs)} verbs"


@promise(
    "bronze.schemas",
    "Each parameter has a type that JSON can carry, and each default is in its domain.",
    why="Callers make their forms and checks of the schema; a wrong one lets a wrong value through.",
    look="the hints of the verb's method: Annotated[float, Domain(low, high, unit)]",
)
def schemas(bench: NetworkBench) -> str:
    """Look at the schema of each verb on each network."""
    count = 0
    for robot in bench.on.values():
        for verb in robot.verbs.values():
            json.dumps(verb.schema(), allow_nan=False)
            for each in verb.parameters:
                count += 1
                if verb.own and not each.type and not each.choices:
                    raise NotKeptError(f"{verb.name}: {each.name} has no type")
                if each.default is not None and (problem := each.problem(each.default)):
                    raise DriftError(f"{verb.name}: its default is outside its domain: {problem}")
    return f"{count} parameters"


@promise(
    "bronze.reads",
    "Each read without required arguments is answered in time, with an envelope that JSON can carry.",
    why="A status that raises or hangs is what an operator looks at in the worst minute.",
    look="get_task_status, get_state, get_features and the verbs with motion=False; one that is slow says so: lasts",
)
def reads(bench: NetworkBench) -> str:
    """Call each read on each network."""
    asked = 0
    for robot in bench.on.values():
        for verb in bench.plain_reads(robot.network):
            asked += 1
            try:
                answer = robot.call(verb.name, timeout=(within_s := bench.answer_s(verb)))
            except NoAnswerError as exc:
                raise NotKeptError(f"{verb.name} on {robot.network}: no answer within {within_s:g} s") from exc
            except RobotError as exc:
                raise NotKeptError(f"{verb.name} on {robot.network}: {exc.why}") from exc
            json.dumps(answer, allow_nan=False)
    return f"{asked} reads"


@promise(
    "bronze.status",
    "At rest its status is one of idle, stopped, completed and error, also as it says it here.",
    why="A robot that always says running cannot be known to have stopped.",
    look="get_task_status: the field task_status",
)
def status(bench: ConformanceBench) -> str:
    """Read the status of a robot that was asked for nothing."""
    robot = behind_contract(bench.body)
    if holds_robots(robot):
        return "a world"
    own = getattr(robot, "get_task_status", None)
    if not callable(own):
        return "it has no tasks"
    state = known_state(within(bench.subject.answer_s, own, "get_task_status"))
    if state in RUNNING:
        raise NotKeptError(f"task_status is {state} before it was asked for a motion")
    return state


def known_state(answer: object) -> str:
    """Return the ``task_status`` of a status, in lower case.

    Raises:
        NotKeptError: it is none of those that are known.
    """
    state = answer.get("task_status") if isinstance(answer, Mapping) else None
    if not isinstance(state, str) or state.lower() not in AT_REST | RUNNING:
        raise NotKeptError(f"task_status is {state!r:.100} in {answer!r:.200}")
    return state.lower()


@promise(
    "bronze.features",
    "Its features are data: the same each time, the same near and far, and its state has the joints that they name.",
    why="Policies and recordings are made for the declared keys; a joint of another name is moved by nobody.",
    look="get_features and get_state",
)
def features(bench: ConformanceBench) -> str:
    """Compare the declared observations with the state."""
    robot = behind_contract(bench.body)
    if holds_robots(robot):
        return "a world"
    return check_features(
        lambda: within(bench.subject.answer_s, robot.get_features, "get_features"),
        lambda: within(bench.subject.answer_s, robot.get_state, "get_state"),
    )


def check_features(features: Callable[[], Any], state: Callable[[], Any]) -> str:
    """Compare features with the joints of the state; return their number.

    Raises:
        NotKeptError: they are not what features and states have to be, or differ.
    """
    first, second = features(), features()
    stated: dict[str, Mapping[str, Any]] = {}
    for kind in ("observation_features", "action_features"):
        given = first.get(kind) if isinstance(first, Mapping) else None
        if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
            raise NotKeptError(f"get_features has no mapping {kind}, but {first!r:.200}")
        if given != second.get(kind):
            raise DriftError(f"{kind} differ from one call to the next")
        stated[kind] = given
    measured = state()
    joints = measured.get("joints") if isinstance(measured, Mapping) else None
    if joints is None:
        return "no joints"
    if not isinstance(joints, Mapping):
        raise NotKeptError(f"joints of get_state are {joints!r:.100}")
    wrong = [key for key, value in joints.items() if not _is_number(value)]
    if wrong:
        raise NotKeptError(f"joints that are no finite numbers: {', '.join(map(str, wrong))}")
    # A robot whose actions name no motors states them with their units.
    units = first.get("joint_units")
    known = stated["observation_features"].keys() | stated["action_features"].keys()
    known |= units.keys() if isinstance(units, Mapping) else set()
    undeclared = sorted(map(str, joints.keys() - known))
    if joints and undeclared and known:
        raise DriftError(f"get_state has {', '.join(undeclared)}, which its features do not declare")
    return f"{len(joints)} joints"


@promise(
    "bronze.domains",
    "A number outside its domain, NaN, an infinity, and a text for a number are refused by the argument's name.",
    why="What is not refused at the door is carried out: one NaN is a motion that nobody can predict.",
    look="Annotated[float, Domain(low, high)] of a verb; duration of start_task",
)
def domains(bench: ConformanceBench) -> str:
    """Call each motion with each number wrong, on each network."""
    tried = 0
    before = bench.writes
    for robot in bench.on.values():
        for verb in bench.motions(robot.network):
            for name, wrong in wrong_numbers(verb):
                tried += 1
                check_refused(bench, robot, verb, name, wrong)
    start = getattr(bench.body, "start_task", None)
    if callable(start):
        for wrong in (math.nan, math.inf, -1.0):
            tried += 1
            if not _refuses(bench, lambda wrong=wrong: start("conformance", "mock", wrong)):
                bench.rest()
                raise NotKeptError(f"start_task took duration={wrong}")
    if bench.writes > before:
        raise NotKeptError("a refused motion wrote to the bus")
    if not tried:
        raise NotProvenError("its motions take no numbers")
    return f"{tried} wrong numbers"


@promise(
    "bronze.unknown",
    "A motion with an argument that it does not have, and a verb that it does not have, are refused by name.",
    why="A misspelled duration is a motion of the default duration.",
    look="the signature of the verb; do not take **kwargs",
)
def unknown(bench: ConformanceBench) -> str:
    """Call each motion with an argument too many."""
    for robot in bench.on.values():
        for verb in bench.motions(robot.network):
            check_refused(bench, robot, verb, "no_such_argument", 1)
        check_unknown_verb(bench, robot)
    return ""


def check_unknown_verb(bench: NetworkBench, robot: RemoteRobot) -> None:
    """Call a verb that the robot does not have.

    Raises:
        NotKeptError: it was carried out.
    """
    try:
        robot.call("noSuchVerb", timeout=bench.subject.answer_s)
    except RefusalError:
        return
    raise NotKeptError(f"noSuchVerb was carried out on {robot.network}")


def wrong_numbers(verb: AdvertisedVerb) -> Iterator[tuple[str, object]]:
    """Yield the numbers of a verb, each with wrong values."""
    for each in verb.parameters:
        if each.type not in NUMBERS:
            continue
        yield from ((each.name, wrong) for wrong in ("much", True, [1]))
        # A network that carries no NaN refuses it itself, which counts.
        yield from ((each.name, wrong) for wrong in (math.nan, math.inf))
        if each.low is not None:
            yield each.name, each.low - 1
        if each.high is not None:
            yield each.name, each.high + 1


def check_refused(bench: NetworkBench, robot: RemoteRobot, verb: AdvertisedVerb, name: str, wrong: object) -> None:
    """Call a motion with one wrong argument.

    Raises:
        NotKeptError: it took it, gave no answer, or refused it without its name.
    """
    arguments = bench.arguments(verb) | {name: wrong}
    try:
        robot.call(verb.name, timeout=bench.subject.answer_s, **arguments)
    except NoAnswerError as exc:
        bench.rest()
        raise NotKeptError(f"{verb.name}({name}={wrong!r}) on {robot.network} was not answered") from exc
    except (RefusalError, ValueError, TypeError) as exc:
        if name not in str(exc) and _is_number(wrong):
            raise NotKeptError(f"{verb.name}({name}={wrong!r}) was refused without naming it: {exc}") from exc
        return
    bench.rest()
    raise NotKeptError(f"{verb.name} took {name}={wrong!r} on {robot.network}")


def _refuses(bench: ConformanceBench, call: Any) -> bool:
    try:
        answer = within(bench.subject.answer_s, call, "start_task")
    except (NotKeptError, Exception) as exc:  # noqa: BLE001 - an exception is a refusal here
        return not isinstance(exc, NotKeptError)
    return isinstance(answer, Mapping) and answer.get("status") == "error"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


PROMISES = (verbs, schemas, reads, status, features, domains, unknown)
