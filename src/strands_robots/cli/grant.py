"""``grant VERB@PEER``: the operator approves one motion on real hardware, once."""

from __future__ import annotations

from typing import Annotated

import typer

from strands_robots.cli.command import command
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.safety.approval import GRANT_S, Grants, state_dir


def register(app: typer.Typer) -> None:
    """Add ``grant`` to the application."""
    command(app, "grant")(grant)


def grant(
    screen: Screen,
    what: Annotated[str, typer.Argument(metavar="VERB@PEER", help="Such as execute@arm-1.")],
    seconds: Annotated[float, typer.Option("--for", help="Seconds for which the grant is good.")] = GRANT_S,
) -> None:
    """Approve one motion of real hardware, once; run it on the robot's own machine."""
    verb, at, peer = what.partition("@")
    if not (verb and at and peer):
        raise Failure(f"grant takes VERB@PEER, such as execute@arm-1, not {what!r}.", Exit.USAGE)
    Grants(state_dir() / "grants").grant(verb, peer, seconds)
    screen.data({"status": "success", "verb": verb, "peer": peer, "seconds": seconds})
    screen.say(f"Granted: {verb} on {peer}, once, within {seconds:g} s.", "green")
