"""Signatures of consoles on what moves real hardware: commands and input frames.

A source is chosen by its publisher, so it proves nothing. Without certificates a console signs with a key in the state
directory of its user, made at its first motion. Robots of the same user find that key there; robots of other machines
trust the keys in ``STRANDS_MESH_CONSOLE_PUBLIC_KEYS`` and the enrolled ones.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from strands_robots.mesh import wire
from strands_robots.safety import ed25519
from strands_robots.safety.identity import SigningIdentity, console_key, kept_consoles, stated_consoles
from strands_robots.utils import MissingExtraError, canonical_json

logger = logging.getLogger(__name__)

FIELD = "console"
FIELDS = frozenset({"v", "key", "t", "nonce", "sig"})
VERSION = 1
MOTION = "mesh-motion"
INPUT = "mesh-input"

READ_AGAIN_S = 1.0
"""Age in seconds from which the trusted keys are read anew."""


class ConsoleSigner:
    """Signs with the key of this user's consoles, which is made when it is needed.

    Args:
        clock: wall-clock seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._identity: SigningIdentity | None = None
        self._path: Path | None = None

    def sign(self, body: Mapping[str, Any], purpose: str) -> dict[str, Any]:
        """Return ``body`` with its signature; as it is, and logged, without a key."""
        identity = self._load()
        if identity is None:
            return dict(body)
        head = {"v": VERSION, "key": identity.public_text, "t": self._clock(), "nonce": secrets.token_hex(16)}
        return {**body, FIELD: {**head, "sig": identity.sign(_covered(body, head, purpose))}}

    def _load(self) -> SigningIdentity | None:
        file = console_key()
        if file.path != self._path:
            self._identity, self._path = None, file.path
            try:
                self._identity = file.load_or_make()
            except (ValueError, OSError, MissingExtraError) as exc:
                logger.error("Motions of real hardware leave here without a signature: %s", exc)  # noqa: TRY400 - one sentence
        return self._identity


class ConsoleTrust:
    """Checks the signatures of consoles; thread-safe.

    Args:
        clock: wall-clock seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._keys: frozenset[bytes] = frozenset()
        self._path: Path | None = None
        self._read_at = float("-inf")
        self._complaint = ""

    def refusal(self, body: Mapping[str, Any], purpose: str) -> str | None:
        """Return the reason why ``body`` is not signed by a trusted console, or None."""
        stated = body.get(FIELD)
        if not isinstance(stated, dict) or set(stated) != FIELDS or stated["v"] != VERSION:
            return "it is not signed by a console"
        key, signature = ed25519.decode(stated["key"], 32), ed25519.decode(stated["sig"], 64)
        if key is None or signature is None or key not in self._trusted():
            return "the key of its console is not enrolled here"
        stamp = wire.finite(stated["t"])
        if stamp is None or not wire.fresh(stamp, self._clock()):
            return "its signature is not fresh"
        try:
            covered = _covered(body, {name: stated[name] for name in ("v", "key", "t", "nonce")}, purpose)
        except (ValueError, TypeError, RecursionError):
            return "it has no canonical form"
        return None if ed25519.signed_by_one_of([key], signature, covered) else "its signature does not fit"

    def _trusted(self) -> frozenset[bytes]:
        with self._lock:
            now, path = time.monotonic(), console_key().path
            if now - self._read_at >= READ_AGAIN_S or path != self._path:
                self._keys, self._read_at, self._path = self._read(), now, path
            return self._keys

    def _read(self) -> frozenset[bytes]:
        keys, complaint = stated_consoles(), ""
        try:
            keys |= kept_consoles()
        except (ValueError, OSError, MissingExtraError) as exc:
            complaint = str(exc)
        if complaint and complaint != self._complaint:
            logger.error("Keys of consoles are left out: %s", complaint)
        self._complaint = complaint
        return keys


def _covered(body: Mapping[str, Any], head: Mapping[str, Any], purpose: str) -> bytes:
    bare = {key: value for key, value in body.items() if key not in (FIELD, "sig")}
    return canonical_json({"body": bare, "head": dict(head), "purpose": purpose})
