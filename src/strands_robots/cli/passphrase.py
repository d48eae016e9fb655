"""The passphrase of an operator's key: asked on the terminal unseen, or read from a file."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path
from typing import Any

import typer

from strands_robots.cli.output import Exit, Failure
from strands_robots.safety.ed25519 import load_signing_key

PASSPHRASE_FILE = typer.Option("--passphrase-file", help="Its passphrase, on the first line; else it is asked for.")


def asked(prompt: str, file: Path | None = None) -> str:
    """The passphrase.

    Raises:
        Failure: the file cannot be read, or there is neither a file nor a terminal to ask on.
    """
    if file is not None:
        try:
            lines = file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as exc:
            raise Failure(f"--passphrase-file cannot be read: {exc}", Exit.USAGE) from exc
        return lines[0] if lines else ""
    if not sys.stdin.isatty():
        raise Failure("A passphrase is asked for on a terminal only; give --passphrase-file here.", Exit.USAGE)
    return getpass.getpass(prompt)


def signing_key(path: Path, file: Path | None = None) -> Any:
    """The private key in ``path``.

    Raises:
        Failure: it cannot be read, or the passphrase does not open it.
    """
    if not path.is_file():
        raise Failure(f"--key {path} is no file.", Exit.USAGE)
    try:
        return load_signing_key(path, asked(f"Passphrase of {path}: ", file))
    except (ValueError, OSError) as exc:
        raise Failure(str(exc)) from exc
