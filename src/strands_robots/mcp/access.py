"""Permissions of one client of the MCP server, and pictures for its user."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots.mcp.caller import Caller


@dataclass(frozen=True)
class ClientAccess:
    """One client as the tools see it.

    Attributes:
        approves: whether the yes of the client's user is the operator's approval of a motion.
        show_picture: makes a JPEG readable for that user and returns its address.
    """

    caller: Caller
    approves: bool
    show_picture: Callable[[bytes], str]


AccessOf = Callable[[Any], ClientAccess]
"""Returns the access of the client that sent a request."""


class PictureFiles:
    """Pictures for a user on this machine, as files; the newest ones are kept."""

    KEPT = 8

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="strands-robots-mcp-")
        self._files: list[Path] = []

    def show(self, jpeg: bytes) -> str:
        """Write a picture; return its address."""
        descriptor, name = tempfile.mkstemp(suffix=".jpg", dir=self._folder.name)
        with os.fdopen(descriptor, "wb") as file:
            file.write(jpeg)
        path = Path(name)
        self._files.append(path)
        while len(self._files) > self.KEPT:
            self._files.pop(0).unlink(missing_ok=True)
        return path.as_uri()

    def close(self) -> None:
        """Remove the files."""
        self._folder.cleanup()
