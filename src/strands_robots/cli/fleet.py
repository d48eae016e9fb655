"""``peers``, ``call`` and ``stop``: who is there, one call, and stopping."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.mesh import peers_on_mesh, stopped_on_mesh
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import Exit, Failure, Screen, label, plain, table
from strands_robots.cli.words import assignments
from strands_robots.envelope import Envelope, is_error, text_of
from strands_robots.safety.stopping import explain, grade
from strands_robots.tools.networks import NativeMesh
from strands_robots.utils import number

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.client import Peer

SOURCE = "strands-robots"
"""The name that calls of the command line carry."""

_WAIT = typer.Option("--timeout", help="Seconds to wait for an answer.")


def register(app: typer.Typer) -> None:
    """Add the three commands to the application."""
    command(app, "peers", network=True)(peers)
    command(app, "call", network=True)(call)
    command(app, "stop", network=True)(stop)


def peers(
    screen: Screen,
    network: Network,
    device: Annotated[str | None, typer.Argument(help="Show what this one can do.")] = None,
    timeout: Annotated[float, _WAIT] = 2.0,
    on_mesh: Annotated[bool, typer.Option("--mesh", help="On the native mesh instead of Device Connect.")] = False,
) -> None:
    """List the robots on the network, or what one of them can do."""
    if on_mesh:
        network.on_mesh()
        peers_on_mesh(screen, number("--timeout", timeout, above=0, high=60))
        return
    with reached(network) as fleet:
        found = fleet.peers(number("--timeout", timeout, above=0, high=60))
    if device is not None:
        found = [peer for peer in found if peer.id == device]
    if not found:
        who = "Nobody" if device is None else f"No {device!r}"
        raise Failure(f"{who} answered. {describe(fleet.link)}", Exit.SILENT, peers=[])
    screen.data({"status": "success", "peers": [_row(peer) for peer in found]})
    if device is not None:
        _functions(screen, found[0])
        return
    rows = ((p.id, p.type, p.model, _doing(p.status), _names(p)) for p in found)
    screen.show(table("", ("device", "type", "model", "status", "functions"), rows))


def call(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    function: Annotated[str, typer.Argument(help="Such as getStatus.")],
    arguments: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE...")] = None,
    timeout: Annotated[float, _WAIT] = 10.0,
    source: Annotated[str, typer.Option("--as", help="The caller's name that goes with the call.")] = SOURCE,
) -> None:
    """Call a function of a device. Values are JSON where they can be read as JSON, else text."""
    params = assignments(arguments or [])
    seconds = number("--timeout", timeout, above=0, high=3600)
    with reached(network, source) as fleet:
        answer = asked(fleet, device, function, params, seconds)
    if is_error(answer):
        raise Failure(plain(text_of(answer) or f"{device} refused {function}.", 2000), Exit.REFUSED, answer=answer)
    screen.data(answer)
    screen.say(text_of(answer) or f"{device} answered {function}.", "green")
    for key, value in answer.items():
        if key not in ("status", "content", "reason"):
            screen.say(f"  {key}: {value if isinstance(value, str) else json.dumps(value, default=str)}")


def stop(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str | None, typer.Argument(help="The device's id.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Stop every device that answers.")] = False,
    timeout: Annotated[float, _WAIT] = 5.0,
    on_mesh: Annotated[bool, typer.Option("--mesh", help="On the native mesh instead of Device Connect.")] = False,
) -> None:
    """Stop one robot, or all. Exits with 1 when one did not stop, with 3 when one is silent."""
    if (device is None) != everything:
        raise Failure("stop takes a DEVICE or --all.", Exit.USAGE)
    if on_mesh:
        network.on_mesh()
        stopped_on_mesh(screen, NativeMesh().stop(device or ""))
        return
    seconds = number("--timeout", timeout, above=0, high=60)
    with reached(network) as fleet:
        answers = fleet.stop_all(seconds) if device is None else {device: fleet.stop(device, seconds)}
    if not answers:
        raise Failure(f"Nobody that can be stopped answered. {describe(fleet.link)}", Exit.SILENT, devices={})
    verdicts = {name: verdict(answer) for name, answer in answers.items()}
    screen.show(table("", ("device", "stopped", "what it said"), (_told(*each) for each in verdicts.items())))
    devices = {name: {"stopped": stopped, "said": said} for name, (stopped, said) in verdicts.items()}
    moving = [name for name, (stopped, _) in verdicts.items() if stopped is False]
    silent = [name for name, (stopped, _) in verdicts.items() if stopped is None]
    if moving:
        raise Failure(f"DID NOT STOP: {', '.join(moving)}.", Exit.REFUSED, devices=devices)
    if silent:
        raise Failure(f"Nobody knows whether it stopped: {', '.join(silent)}.", Exit.SILENT, devices=devices)
    screen.data({"status": "success", "devices": devices})


@contextmanager
def reached(network: Network, source: str = SOURCE) -> Iterator[FleetClient]:
    """The fleet on that network.

    Raises:
        Failure: the network cannot be reached, or fails in use.
    """
    link = network.link()
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - the network is loaded when it is used

    from strands_robots.device_connect import FleetClient  # noqa: PLC0415

    try:
        with FleetClient(link, source) as fleet:
            yield fleet
    except MessagingError as exc:
        raise Failure(f"The network does not carry this: {exc}", Exit.SILENT) from exc


def asked(fleet: FleetClient, device: str, function: str, params: Mapping[str, Any], seconds: float) -> Envelope:
    """One call, with its failures told as what they mean for a script."""
    from strands_robots.device_connect.client import (  # noqa: PLC0415 - as above
        CallRefusedError,
        DeviceTimeoutError,
        NoSuchDeviceError,
    )

    try:
        return fleet.call(device, function, params, seconds)
    except (NoSuchDeviceError, DeviceTimeoutError) as exc:
        raise Failure(plain(exc.args[0], 2000), Exit.SILENT) from exc
    except CallRefusedError as exc:
        raise Failure(plain(str(exc), 2000), Exit.REFUSED, jsonrpc_code=exc.code) from exc


def verdict(answer: Envelope) -> tuple[bool | None, str]:
    """Whether a device stopped, None where nobody knows, and what it said."""
    # The client answers so for a device that did not answer itself.
    unanswered = answer.get("stopped", False) is None
    stopped = None if unanswered else grade(answer).stopped
    return stopped, text_of(answer) or ("" if stopped else explain(answer))


def _told(name: str, judged: tuple[bool | None, str]) -> tuple[object, ...]:
    stopped, said = judged
    word = {True: label("stopped", "green"), False: label("DID NOT STOP", "bold red"), None: label("silent", "yellow")}
    return name, word[stopped], said


def _row(peer: Peer) -> dict[str, Any]:
    return {
        "id": peer.id,
        "type": peer.type,
        "model": peer.model,
        "status": dict(peer.status),
        "functions": [dict(each) for each in peer.functions],
        "events": list(peer.events),
    }


def _doing(status: Mapping[str, Any]) -> str:
    return str(status.get("availability", ""))


def _names(peer: Peer) -> str:
    return ", ".join(str(each.get("name", "")) for each in peer.functions)


def _functions(screen: Screen, peer: Peer) -> None:
    rows = []
    for each in peer.functions:
        properties = (each.get("parameters") or {}).get("properties") or {}
        takes = ", ".join(f"{name}: {_kind(schema)}" for name, schema in properties.items())
        rows.append((each.get("name", ""), takes, str(each.get("description", "")).strip().partition("\n")[0]))
    screen.show(table(plain(peer.id), ("function", "parameters", "what it does"), rows))
    screen.say(f"Events: {', '.join(peer.events)}")


def _kind(schema: object) -> str:
    return str(schema.get("type", "any")) if isinstance(schema, Mapping) else "any"
