"""The operator's resume key: signing and checking, with the ``keygen`` command.

``python -m strands_robots.mesh.resume_authority keygen FILE`` asks for a passphrase twice, writes the encrypted key
and prints its public half for ``STRANDS_MESH_RESUME_PUBLIC_KEY``.
"""

from __future__ import annotations

import getpass
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from strands_robots.moved import of_module
from strands_robots.safety.ed25519 import keygen, load_signing_key
from strands_robots.safety.resume import ResumeVerifier, sign
from strands_robots.utils import MissingExtraError

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = ["ResumeVerifier", "keygen", "load_signing_key", "main", "sign"]

USAGE = "usage: python -m strands_robots.mesh.resume_authority keygen FILE"


def main(arguments: Sequence[str], ask: Callable[[str], str] = getpass.getpass) -> int:
    """Run the command; 0: key written, 1: refused, 2: another command line."""
    if len(arguments) != 2 or arguments[0] != "keygen":
        print(USAGE, file=sys.stderr)
        return 2
    passphrase = ask("Passphrase: ")
    if ask("Again: ") != passphrase:
        print("The two passphrases differ.", file=sys.stderr)
        return 1
    try:
        public = keygen(arguments[1], passphrase)
    except (ValueError, OSError, MissingExtraError) as exc:
        print(exc, file=sys.stderr)
        return 1
    print(public)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
