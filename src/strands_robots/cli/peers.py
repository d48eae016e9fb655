"""``peers``: list the robots on the network. ``call``: call one function of a robot."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from strands_robots.cli.command import OnMesh, Timeout, assignments, command
from strands_robots.cli.network import SOURCE, Network, call_device, describe
from strands_robots.cli.output import LATE_S, CliError, Exit, Screen, first_line, label, plain, readable, table
from strands_robots.cli.readiness import other_user
from strands_robots.envelope import is_error, text_of
from strands_robots.utils import WAIT_S, device_id, number

if TYPE_CHECKING:
    from strands_robots.device_connect.discovery import Peer


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
        said = f"{who} answered. {describe(fleet.link)} {other_user(fleet.link)}".rstrip()
        raise CliError(said, Exit.SILENT, peers=[], stale=fleet.stale)
    whose = other_user(fleet.link)
    screen.data({"status": "success", "peers": [_facts(peer) for peer in found], "stale": fleet.stale, "whose": whose})
    if whose:
        screen.say(whose, "yellow")
    if device is not None:
        _show_functions(screen, found[0])
        return
    rows = ((each.id, each.type, each.model, each.status.get("availability", ""), _age(each)) for each in found)
    screen.show(table("", ("device", "type", "model", "status", "last heard"), rows))
    screen.say("peers DEVICE, with the same flags, lists what it can do.")


def call(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    function: Annotated[str, typer.Argument(help="Such as getStatus.")],
    arguments: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...")] = None,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", help=f"Seconds to wait for an answer: {CALL_S:g}, or {MOTION_S:g} for a motion."),
    ] = None,
    source: Annotated[str, typer.Option("--as", help="Name of the caller that goes with the call.")] = SOURCE,
    on_mesh: OnMesh = False,
) -> None:
    """Call a function of a device. A value is read as JSON where that is possible, else as text."""
    params = assignments(arguments or [])
    whose = ""
    seconds = number("--timeout", _usual_wait(function) if timeout is None else timeout, above=0, high=3600)
    if on_mesh:
        from strands_robots.tools.networks import NativeMesh  # noqa: PLC0415 - loaded when a network is used

        network.use_mesh()
        answer = NativeMesh().call(device, function, params, seconds)
    else:
        with network.fleet(source) as fleet:
            whose = other_user(fleet.link)
            try:
                answer = call_device(fleet, device, function, params, seconds)
            except CliError as failure:
                raise CliError(f"{failure.reason} {whose}".rstrip(), failure.code, **failure.fields) from failure
    if is_error(answer):
        said = f"{text_of(answer) or f'{device} refused {function}.'} {whose}".rstrip()
        raise CliError(plain(said, 2000), Exit.REFUSED, answer=answer)
    screen.data(answer)
    screen.say(readable(text_of(answer)) or f"{device} answered {function}.", "green")
    for key, value in readable(answer).items():
        if key not in ("status", "content", "reason"):
            screen.say(f"  {key}: {value if isinstance(value, str) else json.dumps(value, default=str)}")


def _usual_wait(function: str) -> float:
    """Return the seconds to wait for a function's answer."""
    if function.startswith(("get", "list", "stop")):
        return CALL_S
    from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS  # noqa: PLC0415 - saves its import elsewhere

    verb = ARM_MOTION_VERBS.get(function)
    return MOTION_S if verb is not None and verb.lasts else CALL_S


def _facts(peer: Peer) -> dict[str, Any]:
    facts = {name: value for name, value in asdict(peer).items() if name not in ("location", "heard_at")}
    age = peer.age_s
    return {**facts, "age_s": None if age is None else round(age, 3)}


def _age(peer: Peer) -> Text:
    age = peer.age_s
    if age is None:
        return label("only listed", "yellow")
    return label(f"{age:.1f} s", "bold red" if age > LATE_S else "")


def _show_functions(screen: Screen, peer: Peer) -> None:
    rows = []
    for each in peer.functions:
        properties = (each.get("parameters") or {}).get("properties") or {}
        parameters = ", ".join(f"{name}: {_type_name(schema)}" for name, schema in properties.items())
        rows.append((each.get("name", ""), parameters, first_line(each.get("description"))))
    screen.show(table(f"{plain(peer.id)}, last heard {_age(peer)}", ("function", "parameters", "what it does"), rows))
    screen.say(f"Events: {', '.join(peer.events)}")


def _type_name(schema: object) -> str:
    return str(schema.get("type", "any")) if isinstance(schema, Mapping) else "any"
