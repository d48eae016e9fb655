"""Application of the command line, with every command."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated

import typer

from strands_robots import __version__
from strands_robots.cli._compat import convert_when_needed
from strands_robots.cli.owners import other_owners, owner_remedy
from strands_robots.utils import DISTRIBUTION

COMMANDS = {
    "serve": ("serve",),
    "peers": ("peers", "call"),
    "fleets": ("fleets",),
    "stop": ("stop", "estop"),
    "safety_controller": ("safety-controller",),
    "resume": ("resume", "lockout", "grant"),
    "control": ("take",),
    "watch": ("watch",),
    "dashboard": ("dashboard",),
    "teleop": ("teleop", "calibrate", "replay"),
    "record": ("record",),
    "policy": ("policy",),
    "eval": ("eval",),
    "audit": ("audit",),
    "keys": ("keys", "mesh"),
    "enroll": ("enroll",),
    "doctor": ("doctor",),
    "demo": ("demo",),
    "mcp": ("mcp",),
}
"""Words of the command line, by the module that has them."""

HELP = """Robots on Device Connect and the native mesh: serve one, find them, drive them, and stop them.

Without network flags everything stays on this machine. Exit codes: 0 done, 1 refused or failed,
2 wrong usage, 3 no answer, 130 Ctrl-C."""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{DISTRIBUTION} {__version__}")
        raise typer.Exit


def _start(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help="Print name and version, and exit."),
    ] = False,
) -> None:
    others = [] if version else other_owners()
    if others:
        owners = f"{', '.join(others)} also installs the import package strands_robots"
        typer.echo(f"Warning: {owners}, so its code may run instead. Remedy: {owner_remedy(others)}.", err=True)


def build(word: str = "") -> typer.Typer:
    """Build the application.

    Args:
        word: the command that is wanted; then only its module is loaded, which saves a third of a command's start.
    """
    convert_when_needed()
    app = typer.Typer(
        name="strands-robots",
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        # A traceback with local variables could print keys.
        pretty_exceptions_enable=False,
    )
    app.callback()(_start)
    wanted = [module for module, words in COMMANDS.items() if word in words] or COMMANDS
    for module in wanted:
        import_module(f"strands_robots.cli.{module}").register(app)
    return app
