"""Application of the command line, with every command."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from strands_robots import __version__
from strands_robots.cli._compat import convert_when_needed
from strands_robots.cli.command import command
from strands_robots.utils import DISTRIBUTION

IMPORT_PACKAGE = "strands_robots"

_OWNED = f"{IMPORT_PACKAGE}/__init__.py".encode()
_OWNS = re.compile(rb"^(\.\./)*" + re.escape(_OWNED) + rb"\b", re.MULTILINE)

# Lists of installed files, by the folder that holds them.
_LISTS = {".dist-info": "RECORD", ".egg-info": "installed-files.txt"}


def other_owners(path: Sequence[str] | None = None) -> list[str]:
    """Return every other distribution that installs our import package."""
    found = set()
    for folder in dict.fromkeys(sys.path if path is None else path):
        for installed in _owning(folder or os.curdir):
            from importlib.metadata import Distribution  # noqa: PLC0415 - rarely needed, and slow to load

            distribution = Distribution.at(installed)
            name = distribution.metadata["Name"]
            if name and name.lower().replace("_", "-") != DISTRIBUTION:
                found.add(f"{name} {distribution.version}")
    return sorted(found)


def owner_remedy(others: Sequence[str]) -> str:
    """Return the commands that make this project the only owner of its import."""
    names = " ".join(other.split()[0] for other in others)
    return f"pip uninstall {names}, then reinstall {DISTRIBUTION} (pip install --force-reinstall --no-deps)"


def _owning(folder: str) -> Iterator[Path]:
    """Yield the metadata folders of the distributions that install our package."""
    # A folder that is gone, or a list that cannot be read, must not keep a command, least of all a stop, from running.
    with suppress(OSError):
        for name in os.listdir(folder):  # noqa: PTH208 - a name is checked in a tenth of a path's time
            listing = _LISTS.get(name[-10:])
            if listing is None:
                continue
            with suppress(OSError):
                files = Path(folder, name, listing).read_bytes()
                if _OWNED in files and _OWNS.search(files):
                    yield Path(folder, name)


COMMANDS = {
    "serve": ("serve",),
    "peers": ("peers", "call", "fleets"),
    "stop": ("stop", "estop"),
    "safety_controller": ("safety-controller",),
    "resume": ("resume", "lockout", "grant", "take"),
    "watch": ("watch",),
    "dashboard": ("dashboard",),
    "teleop": ("teleop", "calibrate", "replay"),
    "record": ("record",),
    "policy": ("policy", "eval"),
    "audit": ("audit",),
    "keys": ("keys", "mesh"),
    "enroll": ("enroll",),
    "doctor": ("doctor",),
    "demo": ("demo",),
    "mcp": ("mcp",),
}
"""Words of the command line, by the module that has them."""

GROUPS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "policy": ("Look at trained policies before a robot moves by them.", ("check", "bench")),
    "audit": ("The safety record of this machine.", ("tail", "show", "verify")),
    "keys": ("Keys that free robots and sign their stops.", ("resume", "estop", "console", "mcp")),
    "mesh": ("The native mesh: certificates and access rules.", ("keys",)),
    "mesh keys": ("Certificates for a mesh that leaves this machine.", ("init", "issue", "acl")),
}
"""Words that stand before other ones: what they are about, and those."""

FUNCTIONS = {"eval": "evaluate"}
"""Functions whose name is not that of their command."""

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
    for name in wanted:
        module = import_module(f"strands_robots.cli.{name}")
        for each in COMMANDS[name]:
            _add(app, module, each)
    return app


def _add(app: typer.Typer, module: ModuleType, words: str) -> None:
    """Add a command, or a group of them, of a module."""
    name = words.rpartition(" ")[2]
    if words not in GROUPS:
        command(app, name)(getattr(module, FUNCTIONS.get(words, name.replace("-", "_"))))
        return
    about, members = GROUPS[words]
    group = typer.Typer(no_args_is_help=True, help=about)
    for each in members:
        _add(group, module, f"{words} {each}")
    app.add_typer(group, name=name)
