"""``keys resume|estop FILE``: make the key that frees robots, or the one that signs their stops."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from strands_robots.cli.command import command
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.cli.passphrase import PASSPHRASE_FILE, asked
from strands_robots.safety.ed25519 import keygen

_FILE = typer.Argument(help="Where the key is written, encrypted; never over a file.")


def register(app: typer.Typer) -> None:
    """Add ``keys`` to the application."""
    keys = typer.Typer(no_args_is_help=True, help="Keys that free robots and sign their stops.")
    command(keys, "resume")(resume)
    command(keys, "estop")(estop)
    app.add_typer(keys, name="keys")


def resume(
    screen: Screen,
    *,
    file: Annotated[Path, _FILE],
    passphrase_file: Annotated[Path | None, PASSPHRASE_FILE] = None,
) -> None:
    """Make an operator's resume key, and say what robots need to know of it."""
    _make(screen, file, passphrase_file, "STRANDS_MESH_RESUME_PUBLIC_KEY")


def estop(
    screen: Screen,
    *,
    file: Annotated[Path, _FILE],
    passphrase_file: Annotated[Path | None, PASSPHRASE_FILE] = None,
) -> None:
    """Make a safety controller's signing key, and say what robots need to know of it."""
    _make(screen, file, passphrase_file, "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")


def _make(screen: Screen, file: Path, passphrase_file: Path | None, setting: str) -> None:
    passphrase = asked("Passphrase: ", passphrase_file)
    if passphrase_file is None and asked("Again: ") != passphrase:
        raise Failure("The two passphrases differ.", Exit.USAGE)
    try:
        public = keygen(file, passphrase)
    except OSError as exc:
        raise Failure(f"{file} was not written: {exc}") from exc
    screen.data({"status": "success", "file": str(file), setting: public})
    screen.say(f"The key is {file}. Keep it and its passphrase to yourself; on each robot's machine set:", "green")
    screen.copyable(f"export {setting}={public}")
