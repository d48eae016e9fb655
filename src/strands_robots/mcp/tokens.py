"""Bearer tokens of the MCP server over HTTP, each with a caller's name.

The file has the SHA-256 of each token, so that reading it gives nobody a token.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
from dataclasses import asdict, dataclass
from pathlib import Path

from strands_robots.state_files import StateFileError, make_private, read_private, state_dir
from strands_robots.utils import device_id

FILE = "mcp-tokens.json"


@dataclass(frozen=True, slots=True)
class Token:
    """Name and permissions of a client.

    Attributes:
        name: the caller that robots see.
        read_only: it reads and stops, and moves nothing.
        approves: the yes of its user is the operator's approval of a motion of real hardware.
    """

    name: str
    read_only: bool = False
    approves: bool = False


class TokenFile:
    """The tokens of this machine's user, ``mcp-tokens.json`` in the state directory."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or state_dir() / FILE

    def make(self, token: Token) -> str:
        """Add a token, or replace that of the name; return its text, which is not kept.

        Raises:
            ValidationError: the name is no caller's.
            StateFileError: the file is not this user's alone.
        """
        device_id("name", token.name)
        text = secrets.token_urlsafe(32)
        kept = {digest: each for digest, each in self._read().items() if each.name != token.name}
        self._write({**kept, _digest(text): token})
        return text

    def revoke(self, name: str) -> bool:
        """Remove the token of a name; False where there is none."""
        tokens = self._read()
        kept = {digest: each for digest, each in tokens.items() if each.name != name}
        self._write(kept)
        return len(kept) < len(tokens)

    def names(self) -> list[str]:
        """Return the names that have a token."""
        return sorted(each.name for each in self._read().values())

    def find(self, text: str) -> Token | None:
        """Return the token of this text, None where it is none or was revoked."""
        wanted = _digest(text)
        # Every digest is compared, so that the time tells nothing.
        found = [token for digest, token in self._read().items() if hmac.compare_digest(digest, wanted)]
        return found[0] if found else None

    def _read(self) -> dict[str, Token]:
        try:
            rows = json.loads(read_private(self.path, self.path.parent))
            return {digest: Token(**fields) for digest, fields in rows.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError) as exc:
            if isinstance(exc, StateFileError):
                raise
            raise StateFileError(f"{self.path} is no list of tokens: {exc}") from exc

    def _write(self, tokens: dict[str, Token]) -> None:
        make_private(self.path.parent)
        writing = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}")
        with os.fdopen(os.open(writing, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump({digest: asdict(token) for digest, token in tokens.items()}, file, indent=1)
        writing.rename(self.path)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
