"""Keys of robots and consoles, and the public keys enrolled here.

A robot makes its Ed25519 key at its first start, in the state directory of its machine. Whoever asks robots keeps the
public keys that an operator enrolled, in the state directory of the asking machine. Both are private files: a key that
another user owns, may read or may write proves nothing, so it is refused by name.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.errors import StrandsRobotsError
from strands_robots.safety import ed25519
from strands_robots.safety.approval import state_dir
from strands_robots.safety.state_files import OPEN, StateFileError, make_private, read_private, require_private
from strands_robots.safety.stop_log import stop_logger
from strands_robots.utils import identifier

logger = stop_logger(__name__)

ROBOTS = "robots"
"""Folder of the keys of robots; a console's keys have a folder of their own."""

DEFAULT_TENANT = "default"

VERSION = 1
FILE_MAX_BYTES = 2**20
SEED_BYTES = 32


class KeyFileError(StateFileError):
    """A key file that cannot be trusted; the message names it and says why."""


class KeyChangedError(StrandsRobotsError, ValueError):
    """A robot shows another key than the one enrolled for it."""


def fingerprint(public: bytes) -> str:
    """Return 80 bits of a public key's SHA-256 in five groups, to compare by eye."""
    digest = hashlib.sha256(public).hexdigest()
    return "-".join(digest[start : start + 4] for start in range(0, 20, 4))


@dataclass(frozen=True, slots=True)
class SigningIdentity:
    """A name with the key that proves it.

    Attributes:
        name: of the robot or console.
        public: the raw 32 bytes that others check its signatures with.
    """

    name: str
    public: bytes
    _key: Any = field(repr=False)

    @property
    def fingerprint(self) -> str:
        """The short form of the public key."""
        return fingerprint(self.public)

    @property
    def public_text(self) -> str:
        """The public key as base64url."""
        return ed25519.encode(self.public)

    def sign(self, message: bytes) -> str:
        """Return the signature over ``message`` as base64url."""
        return ed25519.encode(self._key.sign(message))


class KeyFile:
    """The private key of ``name``, in a folder of the state directory.

    Args:
        folder: the purpose of the key, such as :data:`ROBOTS`; part of the path.
        name: an identifier.
        directory: in place of the state directory.
    """

    def __init__(self, folder: str, name: str, directory: Path | None = None) -> None:
        self.name = identifier("name", name)
        self._root = directory or state_dir()
        self.path = self._root / "keys" / identifier("folder", folder) / f"{name}.key"

    def load(self) -> SigningIdentity | None:
        """Return the identity, or None while there is no key.

        Raises:
            KeyFileError: the file or its folder belongs to another user or is open to others, or holds no key.
            OSError: it cannot be read.
        """
        try:
            content = _read_private(self.path, self._root)
        except FileNotFoundError:
            return None
        seed = ed25519.decode(content.decode("ascii", "replace").strip(), SEED_BYTES)
        if seed is None:
            raise KeyFileError(f"{self.path} holds no key; remove it, and a new one is made at the next start.")
        key = ed25519.signing_key(seed)
        return SigningIdentity(self.name, ed25519.public_half(key), key)

    def load_or_make(self) -> SigningIdentity:
        """Return the identity; make its key at the first call.

        Two processes that start at once end up with the same key.

        Raises:
            KeyFileError: as :meth:`load`.
            OSError: it cannot be read or written.
        """
        known = self.load()
        if known is None:
            _make_folder(self.path.parent, self._root)
            _write_once(self.path, ed25519.encode(secrets.token_bytes(SEED_BYTES)).encode() + b"\n")
            known = self.load()
        if known is None:
            raise KeyFileError(f"{self.path} was removed while it was made.")
        return known


def local_name(tenant: str, device_id: str) -> str:
    """Return the name of a device here; two tenants may each have this id.

    A robot has one key on Device Connect's default tenant and on the native mesh.
    """
    return device_id if tenant == DEFAULT_TENANT else f"{tenant}.{device_id}"


def robot_identity(name: str) -> SigningIdentity | None:
    """Return the identity of a robot of this machine, made at its first start.

    A robot whose key cannot be used is none the less stopped; it answers without a signature, and the log says why.
    """
    try:
        return KeyFile(ROBOTS, name).load_or_make()
    except (StrandsRobotsError, OSError) as exc:
        logger.critical("%s answers without a signature: %s", name, exc)
        return None


def robots_here(directory: Path | None = None) -> dict[str, SigningIdentity | str]:
    """Return the identities of this machine's robots by name, or why one is unusable."""
    found: dict[str, SigningIdentity | str] = {}
    for path in sorted(((directory or state_dir()) / "keys" / ROBOTS).glob("*.key")):
        try:
            identity = KeyFile(ROBOTS, path.stem, directory).load()
        except (StrandsRobotsError, OSError) as exc:
            found[path.stem] = str(exc)
        else:
            found |= {path.stem: identity} if identity is not None else {}
    return found


class EnrolledKeys:
    """File ``enrolled.json``: public keys of robots, learnt once and compared since.

    Args:
        directory: in place of the state directory.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._root = directory or state_dir()
        self.path = self._root / "enrolled.json"

    def load(self) -> dict[str, bytes]:
        """Return the public keys by robot.

        Raises:
            KeyFileError: the file belongs to another user or is open to others, or holds no keys.
            OSError: it cannot be read.
        """
        try:
            content = _read_private(self.path, self._root)
        except FileNotFoundError:
            return {}
        try:
            data = json.loads(content)
            keys = {str(name): ed25519.decode(each["key"], SEED_BYTES) for name, each in data["robots"].items()}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as exc:
            raise KeyFileError(f"{self.path} holds no enrolled keys: {exc!r}") from exc
        known = {name: key for name, key in keys.items() if key is not None}
        if data.get("v") != VERSION or len(known) != len(keys):
            raise KeyFileError(f"{self.path} holds no enrolled keys of version {VERSION}.")
        return known

    def enroll(self, found: Mapping[str, bytes], *, replace: bool = False) -> None:
        """Keep these public keys beside those already there.

        Raises:
            KeyChangedError: a robot has another key here, and ``replace`` is false; nothing was kept.
            KeyFileError, OSError: as :meth:`load`, or the file cannot be written.
        """
        known = self.load()
        for name, public in found.items():
            identifier("name", name)
            if not replace and known.get(name, public) != public:
                raise KeyChangedError(
                    f"{name} shows the key {fingerprint(public)} and is enrolled with {fingerprint(known[name])}: "
                    f"it was set up anew, or this is another machine. If you know why, enroll it with --replace."
                )
        self._save({**known, **found})

    def forget(self, name: str) -> bool:
        """Remove a robot; False when it was not enrolled."""
        known = self.load()
        if known.pop(name, None) is None:
            return False
        self._save(known)
        return True

    def _save(self, keys: Mapping[str, bytes]) -> None:
        robots = {name: {"key": ed25519.encode(public)} for name, public in sorted(keys.items())}
        content = json.dumps({"v": VERSION, "saved": time.time(), "robots": robots}, indent=1).encode()
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _draft(self.path, content).replace(self.path)


def _read_private(path: Path, root: Path) -> bytes:
    """Return the content of a file that is this user's alone."""
    return read_private(path, root, forbidden=OPEN, longest=FILE_MAX_BYTES, error=KeyFileError)


def _make_folder(folder: Path, root: Path) -> None:
    make_private(folder)
    require_private(folder, root, error=KeyFileError)


def _draft(path: Path, content: bytes) -> Path:
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return draft


def _write_once(path: Path, content: bytes) -> None:
    """Write a file whole, unless another process wrote it first."""
    draft = _draft(path, content)
    try:
        with contextlib.suppress(FileExistsError):
            os.link(draft, path)
    finally:
        draft.unlink()
