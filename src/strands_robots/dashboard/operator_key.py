"""Operator's key: opened with a passphrase for one act, and not kept."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.ed25519 import load_signing_key

WRONG_MAX, PAUSE_S = 5, 30.0
"""Wrong passphrases after which none is tried for a while."""


class KeyRefusedError(StrandsRobotsError, RuntimeError):
    """The operator's key cannot be used; the text says why."""


class OperatorKey:
    """Key file that frees locked robots and takes control.

    Args:
        path: of the key; None where the server was given none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._wrong, self._until = 0, float("-inf")

    @property
    def present(self) -> bool:
        """True where the server was given a key."""
        return self._path is not None

    def open(self, passphrase: object) -> Any:
        """Return the private key. Slow on purpose: call it on a thread.

        Raises:
            KeyRefusedError: there is none, the passphrase does not open it, or too many were wrong.
        """
        if self._path is None:
            raise KeyRefusedError("This page was started without --operator-key.")
        if time.monotonic() < self._until:
            raise KeyRefusedError(f"After {WRONG_MAX} wrong passphrases none is tried for {PAUSE_S:g} s.")
        if not isinstance(passphrase, str) or not passphrase or len(passphrase) > 1000:
            raise KeyRefusedError("The passphrase of the operator's key is missing.")
        try:
            key = load_signing_key(self._path, passphrase)
        except OSError as exc:
            raise KeyRefusedError(f"The operator's key cannot be read: {exc.strerror}") from exc
        except ValueError as exc:
            self._wrong += 1
            if self._wrong >= WRONG_MAX:
                self._wrong, self._until = 0, time.monotonic() + PAUSE_S
            raise KeyRefusedError("The passphrase does not open the operator's key.") from exc
        self._wrong = 0
        return key
