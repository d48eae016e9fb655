"""``peers``: list the robots on the network. ``call``: call one function of a robot."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from strands_robots.arm_mixin import WAIT_S
from strands_robots.cli.command import OnMesh, Timeout, assignments, command
from strands_robots.cli.network import SOURCE, Network, call_device, describe, mesh_peer, temporary_mesh_id
from strands_robots.cli.output import CliError, Exit, Screen, first_line, label, plain, table
from strands_robots.envelope import is_error, text_of
from strands_robots.safety.peer_answers import enrolled_peers, lockout_distrust
from strands_robots.safety.statements import ALARM
from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS
from strands_robots.tools.networks import NativeMesh
from strands_robots.utils import number

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
        network.use_mesh()
        _mesh_peers(screen, number("--timeout", timeout, above=0, high=60))
        return
    with network.fleet() as fleet:
        found = fleet.peers(number("--timeout", timeout, above=0, high=60))
    if device is not None:
        found = [peer for peer in found if peer.id == device]
    if not found:
        who = "No robot" if device is None else f"No {device!r}"
        raise CliError(f"{who} answered. {describe(fleet.link)}", Exit.SILENT, peers=[], stale=fleet.stale)
    screen.data({"status": "success", "peers": [_facts(peer) for peer in found], "stale": fleet.stale})
    if device is not None:
        _show_functions(screen, found[0])
        return
    rows = (
        (peer.id, peer.type, peer.model, peer.status.get("availability", ""), ", ".join(_function_names(peer)))
        for peer in found
    )
    screen.show(table("", ("device", "type", "model", "status", "functions"), rows))


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
    usual = MOTION_S if function in ARM_MOTION_VERBS and ARM_MOTION_VERBS[function].lasts else CALL_S
    seconds = number("--timeout", usual if timeout is None else timeout, above=0, high=3600)
    if on_mesh:
        network.use_mesh()
        answer = NativeMesh().call(device, function, params, seconds)
    else:
        with network.fleet(source) as fleet:
            answer = call_device(fleet, device, function, params, seconds)
    if is_error(answer):
        raise CliError(plain(text_of(answer) or f"{device} refused {function}.", 2000), Exit.REFUSED, answer=answer)
    screen.data(answer)
    screen.say(text_of(answer) or f"{device} answered {function}.", "green")
    for key, value in answer.items():
        if key not in ("status", "content", "reason"):
            screen.say(f"  {key}: {value if isinstance(value, str) else json.dumps(value, default=str)}")


def _mesh_peers(screen: Screen, timeout: float) -> None:
    """List the mesh peers that announce themselves within ``timeout`` seconds."""
    with mesh_peer(None, temporary_mesh_id("console"), "tool") as mesh:
        time.sleep(timeout)
        rows, keys = [row for row in mesh.peers if row["reachable"]], enrolled_peers()
    for row in rows:
        if "locked" in row and (why := lockout_distrust(row["peer_id"], row, row.get("epochs") or [], keys)):
            row["distrusted"] = why
    if not rows:
        raise CliError("No peer is on the mesh of this machine.", Exit.SILENT, peers=[])
    screen.data({"status": "success", "peers": rows})
    cells = ((r["peer_id"], r["type"], r["hostname"], _mesh_status(r), f"{r['age']:.1f} s") for r in rows)
    screen.show(table("", ("peer", "type", "host", "status", "last heard"), cells))


def _mesh_status(row: Mapping[str, Any]) -> str | Text:
    """Return the task's state, or the lockout, or that emergency stops do not arrive."""
    if row.get("estop_unheard"):
        return label("CANNOT RECEIVE STOPS", "bold red")
    if why := str(row.get("distrusted", "")):
        return label(why, "bold red" if why.startswith(ALARM) else "yellow")
    return label("LOCKED", "bold red") if row.get("locked") is True else str(row.get("task_status", ""))


def _facts(peer: Peer) -> dict[str, Any]:
    return {name: value for name, value in asdict(peer).items() if name != "location"}


def _function_names(peer: Peer) -> list[str]:
    return [str(each.get("name", "")) for each in peer.functions]


def _show_functions(screen: Screen, peer: Peer) -> None:
    rows = []
    for each in peer.functions:
        properties = (each.get("parameters") or {}).get("properties") or {}
        parameters = ", ".join(f"{name}: {_type_name(schema)}" for name, schema in properties.items())
        rows.append((each.get("name", ""), parameters, first_line(each.get("description"))))
    screen.show(table(plain(peer.id), ("function", "parameters", "what it does"), rows))
    screen.say(f"Events: {', '.join(peer.events)}")


def _type_name(schema: object) -> str:
    return str(schema.get("type", "any")) if isinstance(schema, Mapping) else "any"
