"""``take``: a human takes a robot from the program that holds it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.network import Network, answering
from strands_robots.cli.output import CliError, Exit, Screen, plain
from strands_robots.envelope import is_error, text_of
from strands_robots.safety.lease_signatures import sign_take
from strands_robots.utils import identifier, number


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    command(app, "take", network=True)(take)


def take(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str, typer.Argument(help="The robot's id.")],
    key: Annotated[Path | None, typer.Option("--key", help="The operator's key; a simulation may need none.")] = None,
    passphrase_file: PassphraseFile = None,
    robot: Annotated[str, typer.Option("--robot", help="Which robot of a simulated world.")] = "",
    reason: Annotated[
        str, typer.Option("--reason", help="Told to the one who loses control.")
    ] = "an operator took over",
    timeout: Timeout = 5.0,
    on_mesh: OnMesh = False,
) -> None:
    """Take control of a robot: its motion is halted, and only you may move it then."""
    name, seconds = identifier("DEVICE", device), number("--timeout", timeout, above=0, high=60)
    signer = None if key is None else signing_key(key, passphrase_file)
    which: dict[str, object] = {"robot_name": robot} if robot else {}
    with network.joined(on_mesh=on_mesh) as there, answering(there, name, "takeControl"):
        place = there.of(name, "takeControl", moves=True)
        before = place.call(name, "getControl", which, seconds)
        if is_error(before):
            raise CliError(plain(text_of(before), 2000), Exit.REFUSED)
        asked = {"reason": reason, **which}
        if signer is not None:
            asked["assertion"] = sign_take(signer, f"{name}/{robot}" if robot else name, int(before["epoch"]))
        answer = place.call(name, "takeControl", asked, seconds)
    if is_error(answer):
        raise CliError(plain(text_of(answer), 2000), Exit.REFUSED)
    screen.data(answer)
    screen.say(f"{name}: {plain(text_of(answer), 400)}")
    screen.say(f"lease_id {plain(str(answer['lease_id']), 64)}")
