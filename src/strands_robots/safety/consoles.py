"""Keys of consoles: this user's own, and the enrolled ones of other machines."""

from __future__ import annotations

from strands_robots import settings
from strands_robots.safety import ed25519
from strands_robots.safety.identity import EnrolledKeys, KeyFile
from strands_robots.state_files import state_dir

PUBLIC_KEYS = "STRANDS_MESH_CONSOLE_PUBLIC_KEYS"


def console_key() -> KeyFile:
    """Return the file with the key of this user's consoles on this machine."""
    return KeyFile("consoles", "console")


def enrolled_consoles() -> EnrolledKeys:
    """Return the file with the public keys of consoles on other machines."""
    return EnrolledKeys(state_dir() / "consoles")


def stated_consoles() -> frozenset[bytes]:
    """Return the public keys that the environment names."""
    return frozenset(ed25519.public_keys(settings.items(PUBLIC_KEYS), PUBLIC_KEYS))


def kept_consoles() -> frozenset[bytes]:
    """Return the own public key, if there is one, and the enrolled ones.

    Raises:
        KeyFileError, OSError: a key file cannot be used.
    """
    own = console_key().load()
    return frozenset({*enrolled_consoles().load().values(), *([own.public] if own is not None else [])})
