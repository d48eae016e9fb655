"""``peers``: list robots, and what they can do. ``call``: call a robot's verb."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from strands_robots.cli.command import OnMesh, Timeout, assignments, command
from strands_robots.cli.network import SOURCE, Network, answering, call_device
from strands_robots.cli.output import LATE_S, CliError, Exit, Screen, label, plain, readable, table, with_tags
from strands_robots.cli.readiness import other_user
from strands_robots.envelope import is_error, text_of
from strands_robots.fleet.link_flags import described
from strands_robots.serving.known_verbs import QUICK, TEXTS, VERBS, WAITING
from strands_robots.utils import WAIT_S, ValidationError, device_id, number

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.discovery import Peer
    from strands_robots.envelope import Envelope
    from strands_robots.serving.advertised import AdvertisedVerb

LEASE_ID = "lease_id"

CALL_S = 10.0
MOTION_S = CALL_S + WAIT_S
"""Seconds to wait for a verb that may wait for the end of a motion."""


def register(app: typer.Typer) -> None:
    """Add both commands to the application."""
    command(app, "peers", network=True)(peers)
    command(app, "call", network=True)(call)


def peers(
    screen: Screen,
    network: Network,
    device: Annotated[str | None, typer.Argument(help="List the functions of this one.")] = None,
    timeout: Timeout = 2.0,
    on_mesh: OnMesh = False,
) -> None:
    """List the robots on the network, or what one of them can do."""
    if on_mesh:
        from strands_robots.cli.peers_mesh import list_peers  # noqa: PLC0415 - loaded when a network is used

        network.use_mesh()
        list_peers(screen, number("--timeout", timeout, above=0, high=60))
        return
    wanted = None if device is None else device_id("DEVICE", device)
    with network.fleet() as fleet:
        found = fleet.peers(number("--timeout", timeout, above=0, high=60))
    if device is not None:
        found = [peer for peer in found if peer.id == wanted]
    if not found:
        who = "No robot" if device is None else f"No {device!r}"
        said = f"{who} answered. {described(fleet.link)} {other_user(fleet.link)}".rstrip()
        raise CliError(said, Exit.SILENT, peers=[], stale=fleet.stale)
    whose = other_user(fleet.link)
    screen.data({"status": "success", "peers": [_facts(peer) for peer in found], "stale": fleet.stale, "whose": whose})
    if whose:
        screen.say(whose, "yellow")
    if device is not None:
        _show_functions(screen, found[0])
        return
    rows = [(each.id, each.type, each.model, each.status.get("availability", ""), _age(each)) for each in found]
    heads = ("device", "type", "model", "status", "last heard")
    screen.show(table("", *with_tags(heads, rows, [each.tags for each in found])))
    screen.say("peers DEVICE, with the same flags, lists what it can do.")


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
    on_mesh: OnMesh = False,
) -> None:
    """Call a function of a device, or list its functions.

    A value is read as the function's description has it; without one as JSON where that is possible, else as text.
    """
    given = arguments or []
    params = assignments(given)
    stated = None if timeout is None else number("--timeout", timeout, above=0, high=3600)
    whose = ""
    if on_mesh:
        if function is None:
            raise CliError("call --mesh takes a function, such as status.", Exit.USAGE)
        answer = _call_on_mesh(network, device, function, given, stated)
    else:
        with network.fleet(source) as fleet:
            whose = other_user(fleet.link)
            try:
                if function is None:
                    _list_functions(screen, fleet, device)
                    return
                with answering(fleet, device):
                    verb = fleet.verb(device, function) if _needs_description(function, given, params) else None
                params = _typed(verb, given, params)
                seconds = stated or _wait(function, verb)
                with _interruptible(f"strands-robots stop {device}{network.flags}", lambda: _moves(function, verb)):
                    answer = call_device(fleet, device, function, params, seconds)
            except CliError as failure:
                if failure.code is Exit.INTERRUPTED:
                    raise
                raise CliError(f"{failure.reason} {whose}".rstrip(), failure.code, **failure.fields) from failure
    if is_error(answer):
        said = f"{text_of(answer) or f'{device} refused {function}.'} {whose}".rstrip()
        raise CliError(plain(said, 2000), Exit.REFUSED, answer=answer)
    screen.data(answer)
    screen.say(readable(text_of(answer)) or f"{device} answered {function}.", "green")
    for key, value in readable(answer).items():
        if key not in ("status", "content", "reason"):
            screen.say(f"  {key}: {value if isinstance(value, str) else json.dumps(value, default=str)}")


def _call_on_mesh(network: Network, device: str, function: str, given: Sequence[str], stated: float | None) -> Envelope:
    from strands_robots.cli.peers_mesh import call_peer  # noqa: PLC0415 - loaded when a network is used

    network.use_mesh()
    params, moving = assignments(given), False

    def wait(verb: AdvertisedVerb | None) -> float:
        nonlocal moving
        moving = _moves(function, verb)
        return stated or _wait(function, verb)

    with _interruptible(f"strands-robots stop {device} --mesh{network.flags}", lambda: moving):
        command = {**_typed(None, given, params), "action": function}
        return call_peer(device, command, wait, lambda verb: _typed(verb, given, params))


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


def _list_functions(screen: Screen, fleet: FleetClient, device: str) -> None:
    with answering(fleet, device):
        peer = fleet.describe(device, CALL_S)
    screen.data({"status": "success", "device": peer.id, "functions": peer.functions})
    _show_functions(screen, peer)


def _facts(peer: Peer) -> dict[str, Any]:
    facts = {name: value for name, value in asdict(peer).items() if name not in ("location", "heard_at")}
    age = peer.age_s
    return {**facts, "tags": list(peer.tags), "age_s": None if age is None else round(age, 3)}


def _age(peer: Peer) -> Text:
    age = peer.age_s
    if age is None:
        return label("only listed", "yellow")
    return label(f"{age:.1f} s", "bold red" if age > LATE_S else "")


def _show_functions(screen: Screen, peer: Peer) -> None:
    from strands_robots.serving.advertised import RobotDescription  # noqa: PLC0415 - loaded when a network is used

    description = RobotDescription.of(peer.functions)
    rows = [
        (f"{each.name} (its own)" if each.own else each.name, each.takes, each.summary)
        for each in description.verbs.values()
    ]
    screen.show(table(f"{plain(peer.id)}, last heard {_age(peer)}", ("function", "parameters", "what it does"), rows))
    if description.left_out:
        screen.say(f"Left out: {'; '.join(description.left_out)}.", "yellow")
    if description.absent:
        screen.say(description.absent, "yellow")
    screen.say(f"Events: {', '.join(peer.events)}")
