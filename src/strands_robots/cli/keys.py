"""``keys``: keys of operators and tokens of clients; ``mesh keys``: certificates."""

from __future__ import annotations

import getpass
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.safety.ed25519 import keygen, load_signing_key
from strands_robots.safety.identity import (
    console_key,
)
from strands_robots.state_files import state_dir

T = TypeVar("T")

PassphraseFile = Annotated[
    Path | None, typer.Option("--passphrase-file", help="Its passphrase, on the first line; else it is asked for.")
]
DEFAULT_FOLDER = Path("mesh-keys")
KeyFile = Annotated[Path, typer.Argument(help="Where the key is written, encrypted; never over a file.")]
Folder = Annotated[Path, typer.Option("--folder", help="Folder of the authority and the certificates.")]


def resume(screen: Screen, *, file: KeyFile, passphrase_file: PassphraseFile = None) -> None:
    """Make an operator's resume key, and print the setting that robots need for it."""
    _make_key(screen, file, passphrase_file, "STRANDS_MESH_RESUME_PUBLIC_KEY")


def estop(screen: Screen, *, file: KeyFile, passphrase_file: PassphraseFile = None) -> None:
    """Make a safety controller's signing key, and print the setting that robots need for it."""
    _make_key(screen, file, passphrase_file, "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")


def console(screen: Screen) -> None:
    """Print the public key of this user's consoles, for robots on other machines."""
    public = _refusable(lambda: console_key().load_or_make()).public_text
    screen.data({"status": "success", "STRANDS_MESH_CONSOLE_PUBLIC_KEYS": public})
    screen.say(
        "Robots of this user on this machine know it. On each robot's machine `enroll --console` takes it, or set:",
        "green",
    )
    screen.copyable(f"export STRANDS_MESH_CONSOLE_PUBLIC_KEYS={public}")


def mcp(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="The caller that robots see.")],
    read_only: Annotated[bool, typer.Option("--read-only", help="It reads and stops, and moves nothing.")] = False,
    approves: Annotated[
        bool, typer.Option("--approves", help="Its user's yes approves a motion of real hardware.")
    ] = False,
    revoke: Annotated[bool, typer.Option("--revoke", help="Remove the token of this name.")] = False,
) -> None:
    """Make a bearer token for a client of `mcp --http`, or revoke it."""
    from strands_robots.http_access import Token, TokenFile  # noqa: PLC0415 - loaded when it is used

    tokens = TokenFile()
    if revoke:
        if not _refusable(lambda: tokens.revoke(name)):
            raise CliError(f"{name} has no token.", Exit.USAGE)
        screen.data({"status": "success", "name": name, "revoked": True})
        screen.say(f"{name} has no token any more.", "green")
        return
    text = _refusable(lambda: tokens.make(Token(name, read_only, approves)))
    screen.data({"status": "success", "name": name, "token": text})
    screen.say(f"The token of {name}; it is shown this once:", "green")
    screen.copyable(text)


def init(screen: Screen, folder: Folder = DEFAULT_FOLDER) -> None:
    """Make the fleet's own certificate authority."""
    from strands_robots.certificates import CA_KEY  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    path = _refusable(lambda: config.make_authority(folder))
    screen.data({"status": "success", "ca": str(path)})
    screen.say(f"The authority is {path}. Keep {folder / CA_KEY} to yourself; it makes the certificates.", "green")


def issue(
    screen: Screen,
    *,
    peer_id: Annotated[str, typer.Argument(help="The peer that the certificate is for.")],
    hosts: Annotated[list[str] | None, typer.Argument(help="Names or addresses by which others reach it.")] = None,
    folder: Folder = DEFAULT_FOLDER,
) -> None:
    """Make the certificate of one peer, and print its settings."""
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    issued = _refusable(lambda: config.issue_certificate(folder.resolve(), peer_id, hosts or [])).settings()
    screen.data({"status": "success", **issued})
    for name, value in issued.items():
        screen.copyable(f"export {name}={shlex.quote(str(value))}")


def acl(
    screen: Screen,
    *,
    robots: Annotated[list[str] | None, typer.Option("--robot", help="A peer that sends as itself only.")] = None,
    operators: Annotated[list[str] | None, typer.Option("--operator", help="A peer that also commands.")] = None,
    relays: Annotated[
        list[str] | None, typer.Option("--relay", help="A peer others are connected through; the operators.")
    ] = None,
    file: Annotated[Path, typer.Option("--file", help="Where the rules are written.")] = Path("mesh-acl.json5"),
) -> None:
    """Write access rules: deny by default, a robot sends as itself, an operator also commands."""
    from strands_robots.mesh.transport import config  # noqa: PLC0415 - loaded when it is used

    rules = _refusable(lambda: config.named_rules(robots or [], operators or [], relays))
    file.write_text(rules, encoding="utf-8")
    screen.data({"status": "success", "STRANDS_MESH_ACL_FILE": str(file.resolve())})
    screen.copyable(f"export STRANDS_MESH_ACL_FILE={shlex.quote(str(file.resolve()))}")


def operator_key() -> Path:
    """Return the usual place of the operator's key."""
    return state_dir() / "operator.pem"


def signing_key(path: Path, passphrase_file: Path | None = None) -> Any:
    """Return the private key in ``path``.

    Raises:
        CliError: it cannot be read, or the passphrase does not open it.
    """
    if not path.is_file():
        raise CliError(f"--key {path} is no file.", Exit.USAGE)
    try:
        return load_signing_key(path, _passphrase(f"Passphrase of {path}: ", passphrase_file))
    except (ValueError, OSError) as exc:
        raise CliError(str(exc)) from exc


def _passphrase(prompt: str, file: Path | None = None) -> str:
    """Read the passphrase from a file, or ask for it without showing it.

    Raises:
        CliError: the file cannot be read, or there is neither a file nor a terminal.
    """
    if file is not None:
        try:
            lines = file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as exc:
            raise CliError(f"--passphrase-file cannot be read: {exc}", Exit.USAGE) from exc
        return lines[0] if lines else ""
    if not sys.stdin.isatty():
        raise CliError("A passphrase is asked for on a terminal only; give --passphrase-file here.", Exit.USAGE)
    return getpass.getpass(prompt)


def _make_key(screen: Screen, file: Path, passphrase_file: Path | None, setting: str) -> None:
    passphrase = _passphrase("Passphrase: ", passphrase_file)
    if passphrase_file is None and _passphrase("Again: ") != passphrase:
        raise CliError("The two passphrases differ.", Exit.USAGE)
    try:
        if file == operator_key():
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        public = keygen(file, passphrase)
    except OSError as exc:
        raise CliError(f"{file} was not written: {exc}") from exc
    screen.data({"status": "success", "file": str(file), setting: public})
    screen.say(f"The key is {file}. Keep it and its passphrase to yourself; on each robot's machine set:", "green")
    screen.copyable(f"export {setting}={public}")


def _refusable(make: Callable[[], T]) -> T:
    try:
        return make()
    except (ValueError, OSError) as exc:
        raise CliError(str(exc)) from exc
