"""``peers``: list robots, and what they can do. ``call``: call a robot's verb."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.text import Text

from strands_robots import settings
from strands_robots.cli.app import Timeout, assignments
from strands_robots.cli.network import Network, answering, say_missing
from strands_robots.cli.output import LATE_S, CliError, Exit, Screen, label, plain, readable, table
from strands_robots.envelope import RefusalReason, is_error, text_of
from strands_robots.fleet.adapter import FIND_S, SOURCE
from strands_robots.fleet.device_connect.config import as_flag, described
from strands_robots.fleet.networks import STILL
from strands_robots.fleet.profiles import profile_names, profiles_folder, read_profile
from strands_robots.serving.advertised import QUICK, STOPS, TEXTS, VERBS, WAITING
from strands_robots.utils import WAIT_S, MissingExtraError, ValidationError, duration, identifier, number

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from strands_robots.envelope import Envelope
    from strands_robots.fleet.adapter import FoundRobot, NetworkAdapter
    from strands_robots.fleet.networks import Networks
    from strands_robots.serving.advertised import AdvertisedVerb

    Send = Callable[[str, str, Mapping[str, Any], float], Envelope]


def fleets(screen: Screen) -> None:
    """List the connection profiles that --fleet takes, and their networks."""
    default, names = settings.raw("STRANDS_FLEET"), profile_names()
    found = [_profile_facts(name) for name in names]
    unfit = _problem(default) if default and default not in names else ""
    screen.data(
        {
            "status": "success",
            "folder": str(profiles_folder()),
            "default": default or None,
            "default_problem": unfit,
            "fleets": found,
        },
    )
    if unfit:
        screen.say(f"STRANDS_FLEET names none that can be used. {unfit}")
    if not found:
        screen.say(f"No connection profile is in {profiles_folder()}; docs/python.md says what one has.")
        return
    rows = (
        (
            f"{each['name']} (default)" if each["name"] == default else each["name"],
            label(each["problem"], "bold red") if each["problem"] else each["network"] or "none",
            each["tenant"] or "",
            each["caller"] or "",
            "" if each["mesh"] is None else each["mesh_network"] or "none",
        )
        for each in found
    )
    screen.show(table(str(profiles_folder()), ("fleet", "Device Connect", "tenant", "caller", "mesh"), rows))


def _profile_facts(name: str) -> dict[str, Any]:
    """Return a profile in words; ``problem`` says why it cannot be used."""
    absent = ("network", "tenant", "caller", "mesh", "mesh_network")
    facts: dict[str, Any] = {"name": name, **dict.fromkeys(absent)}
    try:
        profile = read_profile(name)
        facts["file"] = str(profile.file)
        if profile.reaches_devices({}):
            link = profile.flags({}).link(as_flag)
            facts |= {"network": described(link), "tenant": link.tenant}
        stated = profile.mesh
        facts |= {"caller": profile.name or SOURCE, "mesh": stated is not None}
        facts["mesh_network"] = None if stated is None else _mesh_in_words(stated)
    except (ValidationError, MissingExtraError) as exc:
        return {**facts, "problem": str(exc)}
    return {**facts, "problem": ""}


def _problem(wanted: str) -> str:
    try:
        read_profile(wanted).check()
    except ValidationError as exc:
        return str(exc)
    return ""


def _mesh_in_words(stated: Mapping[str, str]) -> str:
    """Describe in one sentence where the peers of a profile's mesh meet."""
    ends = {"connects to": stated["STRANDS_MESH_CONNECT"], "listens on": stated["STRANDS_MESH_LISTEN"]}
    ways = [f"{how} {', '.join(each.split(','))}" for how, each in ends.items() if each != settings.NO_ENDPOINT]
    hub = [] if ways else [f"meets at 127.0.0.1:{stated['STRANDS_MESH_PORT']}"]
    multicast = ["finds peers by multicast"] if stated["STRANDS_MESH_MULTICAST"] == "true" else []
    text = "; ".join((*hub, *ways, *multicast))
    return f"{text[0].upper()}{text[1:]}."


LEASE_ID = "lease_id"

GRAVE = ("estop_unheard", "distrusted", "locked")
"""Facts of a peer that are shown before others of the same robot on any network, the gravest first."""

CALL_S = 10.0
MOTION_S = CALL_S + WAIT_S
"""Seconds to wait for a verb that may wait for the end of a motion."""


def peers(
    screen: Screen,
    network: Network,
    device: Annotated[str | None, typer.Argument(help="List the functions of this one.")] = None,
    timeout: Timeout = FIND_S,
) -> None:
    """List the robots in reach, or what one of them can do.

    With --mesh these are all peers of the mesh, also those without a robot.
    """
    seconds = number("--timeout", timeout, above=0, high=60)
    wanted = None if device is None else identifier("DEVICE", device)
    with network.joined() as there:
        listed = there.find(seconds, peers=network.mesh)
        rows = [_Row.of(*listed[name], there.bearers(name)) for name in sorted(listed) if wanted in (None, name)]
        functions = there.describe(wanted) if wanted is not None and rows else None
        reach, stale, whose = there.reach, there.stale, network.other_user(there)
    say_missing(screen, there)
    facts = {"stale": stale, "absent": there.missing}
    if not rows:
        who = "No robot" if device is None else f"No {device!r}"
        absent = "No peer is on the mesh of this machine." if network.mesh and device is None else f"{who} answered."
        raise CliError(
            f"{absent} {'' if network.mesh else f'{reach} {whose}'}".rstrip(), Exit.SILENT, peers=[], **facts
        )
    screen.data({"status": "success", "peers": [each.facts for each in rows], **facts, "whose": whose})
    if whose:
        screen.say(whose, "yellow")
    if device is not None:
        _show_functions(screen, rows[0].robot, functions)
        return
    heads, cells = _columns(rows)
    screen.show(table("", heads, cells))
    screen.say("peers DEVICE, with the same flags, lists what it can do.")


@dataclass(frozen=True, slots=True)
class _Row:
    """One robot.

    Attributes:
        robot: as the network has it on which it is called.
        gravest: as the network has it on which it is locked, or receives no stops.
        networks: names of those that have it, the one that it is called on first.
    """

    robot: FoundRobot
    gravest: FoundRobot
    networks: Sequence[str]

    @classmethod
    def of(cls, robot: FoundRobot, network: NetworkAdapter, bearers: Sequence[NetworkAdapter]) -> Self:
        others = [each for each in bearers if each is not network]
        known = [robot, *(each.known(robot.id) for each in others)]
        gravest = next((each for name in GRAVE for each in known if each.facts.get(name)), robot)
        return cls(robot, gravest, [network.name, *(each.name for each in others)])

    @property
    def facts(self) -> dict[str, Any]:
        """Facts for programs."""
        robot = self.robot
        return {
            **robot.facts,
            **{"id": robot.id, "type": robot.type, "model": robot.model},
            **({} if robot.locked is None else {"locked": robot.locked}),
            "age_s": None if robot.age_s is None else round(robot.age_s, 3),
            **{"network": self.networks[0], "also_on": self.networks[1:]},
        }


def _columns(rows: Sequence[_Row]) -> tuple[Sequence[str], Sequence[Sequence[object]]]:
    """Return heads and rows; a column that says nothing is left out."""
    networks = {name for row in rows for name in row.networks}
    shown: dict[str, list[Any]] = {
        "peer": [row.robot.id for row in rows],
        "type": [row.robot.type for row in rows],
        "model": [row.robot.model for row in rows],
        "host": [str(row.robot.facts.get("hostname", "")) for row in rows],
        "status": [_status(row.gravest) for row in rows],
        "last heard": [_age(row.robot) for row in rows],
        "network": [", ".join(row.networks) for row in rows],
        "tags": [", ".join(row.robot.tags) for row in rows],
    }
    told = {"host": any(shown["host"]), "network": len(networks) > 1, "tags": any(shown["tags"])}
    heads = [name for name in shown if told.get(name, True)]
    return heads, list(zip(*(shown[name] for name in heads), strict=True))


def call(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    function: Annotated[str | None, typer.Argument(help="Such as getStatus; without one, list them.")] = None,
    arguments: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...")] = None,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", help=f"Seconds to wait for an answer: {CALL_S:g}, or {MOTION_S:g} for a motion."),
    ] = None,
    source: Annotated[str, typer.Option("--as", help="Name of the caller that goes with the call.")] = SOURCE,
) -> None:
    """Call a function of a device, or list its functions.

    A value is read as the function's description has it; without one as JSON where that is possible, else as text. Of
    two robots of one id on both networks none is moved, unless one of them is enrolled: exit 1.
    """
    given = arguments or []
    params = assignments(given)
    stated = None if timeout is None else duration("--timeout", timeout)
    with network.joined(source=source, in_turn=function in STILL - STOPS) as there:
        try:
            with answering(there, device, function or ""):
                if function is None:
                    _list_functions(screen, there, device)
                    return
                send: Send = partial(there.call, moves=function not in STILL)
                verb: AdvertisedVerb | None = None
                # A stop of several networks waits for no description.
                several = function in STOPS and len(there.stated) > 1
                if not several and _needs_description(function, given, params):
                    place, verb = there.described(device, function)
                    send = place.call
                params = _typed(verb, given, params)
                seconds = stated or _wait(function, verb)
                with _interruptible(f"strands-robots stop {device}{network.flags}", lambda: _moves(function, verb)):
                    answer = send(device, function, params, seconds)
        except CliError as failure:
            if failure.code in (Exit.INTERRUPTED, Exit.USAGE):
                raise
            reason = f"{failure.reason} {network.other_user(there)}".rstrip()
            raise CliError(reason, failure.code, **failure.fields) from failure
    if is_error(answer):
        reason = text_of(answer) or f"{device} refused {function}."
        code = Exit.USAGE if answer.get("refused") == RefusalReason.ARGUMENTS.value else Exit.REFUSED
        code = Exit.SILENT if answer.get("stopped", ...) is None else code
        raise CliError(plain(f"{reason} {network.other_user(there)}".rstrip(), 2000), code, answer=answer)
    screen.data(answer)
    screen.say(readable(text_of(answer)) or f"{device} answered {function}.", "green")
    for key, value in readable(answer).items():
        if key not in ("status", "content", "reason"):
            screen.say(f"  {key}: {value if isinstance(value, str) else json.dumps(value, default=str)}")


@contextmanager
def _interruptible(stop: str, moving: Callable[[], bool]) -> Iterator[None]:
    """Have Ctrl-C say that a motion goes on, and the command that stops it."""
    try:
        yield
    except KeyboardInterrupt:
        if not moving():
            raise
        raise CliError(f"The robot may still move. Stop it: {stop}", Exit.INTERRUPTED, stop=stop) from None


def _moves(function: str, verb: AdvertisedVerb | None) -> bool:
    return function not in QUICK and (verb is None or not verb.reads)


def _wait(function: str, verb: AdvertisedVerb | None) -> float:
    """Return the seconds to wait for an answer, those that a verb lasts included."""
    return (MOTION_S if function in WAITING else CALL_S) + (verb.lasts_s if verb is not None else 0.0)


def _needs_description(function: str, given: Sequence[str], params: Mapping[str, Any]) -> bool:
    """Return False where name and arguments already say all that is needed.

    Of a verb of ours the robot itself checks the arguments, and only what may be of another type is asked about.
    """
    if function not in VERBS:
        return True
    texts = dict(each.split("=", 1) for each in given)
    # A text that is no JSON stays a text, and JSON that is no text stays what it is.
    return any(
        texts[name][:1] != '"' and name != LEASE_ID and (isinstance(value, str) is not (name in TEXTS))
        for name, value in params.items()
    )


def _typed(verb: AdvertisedVerb | None, given: Sequence[str], params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments with the types that a function's description states.

    Raises:
        ValidationError: naming an argument that it does not have, or a value that does not fit.
    """
    texts = dict(each.split("=", 1) for each in given)
    # A lease may consist of digits alone, and is a text all the same.
    leased = {LEASE_ID: texts[LEASE_ID]} if not isinstance(params.get(LEASE_ID, ""), str) else {}
    if verb is None:
        return {**params, **leased}
    from strands_robots.serving.advertised import typed  # noqa: PLC0415 - loaded when a network is used

    known = verb.by_name
    unknown = verb.unknown(name for name in params if name not in verb.leases)
    if unknown:
        raise ValidationError(unknown)
    given_types = {name: typed(known[name], value, texts[name]) for name, value in params.items() if name in known}
    return {**params, **given_types, **leased}


def _list_functions(screen: Screen, there: Networks, device: str) -> None:
    functions = there.describe(device, anew=True)
    screen.data({"status": "success", "device": device, "functions": functions})
    _show_functions(screen, there.of(device).known(device), functions)


def _status(robot: FoundRobot) -> str | Text:
    """Return what it does, or the lockout, or that emergency stops do not arrive."""
    facts = robot.facts
    if facts.get("estop_unheard"):
        return label("CANNOT RECEIVE STOPS", "bold red")
    if why := str(facts.get("distrusted", "")):
        from strands_robots.safety.statements import ALARM  # noqa: PLC0415 - only a peer with a wrong key needs it

        return label(why, "bold red" if why.startswith(ALARM) else "yellow")
    return label("LOCKED", "bold red") if facts.get("locked") is True else robot.status


def _age(robot: FoundRobot) -> Text:
    age = robot.age_s
    if age is None:
        return label("only listed", "yellow")
    return label(f"{age:.1f} s", "bold red" if age > LATE_S else "")


def _show_functions(screen: Screen, robot: FoundRobot, functions: object) -> None:
    from strands_robots.serving.advertised import RobotDescription  # noqa: PLC0415 - loaded when a network is used

    description = RobotDescription.of(functions)
    rows = [
        (f"{each.name} (its own)" if each.own else each.name, each.takes, each.summary)
        for each in description.verbs.values()
    ]
    screen.show(table(f"{plain(robot.id)}, last heard {_age(robot)}", ("function", "parameters", "what it does"), rows))
    if description.left_out:
        screen.say(f"Left out: {'; '.join(description.left_out)}.", "yellow")
    if description.absent:
        screen.say(description.absent, "yellow")
    events = robot.facts.get("events")
    if events is not None:
        screen.say(f"Events: {', '.join(events)}")
