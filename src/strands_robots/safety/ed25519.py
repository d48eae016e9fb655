"""Ed25519: base64url, public keys from settings, key files.

The only place that imports ``cryptography``, and only when a signature or a key is at hand.
"""

from __future__ import annotations

import base64
import binascii
import functools
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from strands_robots.utils import ValidationError, missing_extra, shown

logger = logging.getLogger(__name__)

PASSPHRASE_MIN = 16
PASSPHRASE_CLASSES = 3
PASSPHRASE_DISTINCT = 10


def encode(data: bytes) -> str:
    """Base64url with padding."""
    return base64.urlsafe_b64encode(data).decode()


def decode(text: object, length: int) -> bytes | None:
    """``length`` bytes of base64url, padded or not; None for anything else."""
    data = decode_up_to(text, length)
    return data if data is not None and len(data) == length else None


def decode_up_to(text: object, longest: int) -> bytes | None:
    """At most ``longest`` bytes of base64url, padded or not; None for anything else."""
    if not isinstance(text, str) or not text.isascii() or len(text) > 4 * (longest // 3 + 1):
        return None
    bare = text.rstrip("=")
    try:
        data = base64.b64decode(bare + "=" * (-len(bare) % 4), altchars=b"-_", validate=True)
    except (binascii.Error, ValueError):
        return None
    return data if len(data) <= longest else None


def public_keys(items: Sequence[str], setting: str) -> tuple[bytes, ...]:
    """Return the 32-byte keys of a comma list; log an item that is none."""
    keys = []
    for item in items:
        key = decode(item, 32)
        if key is None:
            logger.error("%s holds %s, which is no base64url of 32 bytes; it is left out.", setting, shown(item))
        else:
            keys.append(key)
    return tuple(keys)


def signed_by_one_of(keys: Sequence[bytes], signature: bytes, message: bytes) -> bool:
    """True when one of the public keys made ``signature`` over ``message``."""
    return any(_verifier(key)(signature, message) for key in keys)


@functools.lru_cache(maxsize=64)
def _verifier(key: bytes) -> Callable[[bytes, bytes], bool]:
    try:
        from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - optional, loaded when used
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        raise missing_extra("Verifying a signature", "device-connect") from None
    public = Ed25519PublicKey.from_public_bytes(key)

    def verify(signature: bytes, message: bytes) -> bool:
        try:
            public.verify(signature, message)
        except InvalidSignature:
            return False
        return True

    return verify


def signing_key(seed: bytes) -> Any:
    """Return the private key of a 32-byte seed."""
    try:
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        raise missing_extra("Using a key", "device-connect") from None
    return Ed25519PrivateKey.from_private_bytes(seed)


def public_half(signing_key: Any) -> bytes:
    """The raw 32 bytes that others check this key's signatures with."""
    raw: bytes = signing_key.public_key().public_bytes_raw()
    return raw


def passphrase_error(passphrase: str) -> str | None:
    """Return the reason why a passphrase is too weak for an operator's key, or None."""
    classes = (str.islower, str.isupper, str.isdigit, lambda c: not c.isalnum())
    kinds = sum(any(kind(c) for c in passphrase) for kind in classes)
    if len(passphrase) < PASSPHRASE_MIN or kinds < PASSPHRASE_CLASSES or len(set(passphrase)) < PASSPHRASE_DISTINCT:
        return (
            f"passphrase must have at least {PASSPHRASE_MIN} characters, {PASSPHRASE_DISTINCT} of them distinct, "
            f"from {PASSPHRASE_CLASSES} of lower case, upper case, digits and others."
        )
    return None


def keygen(path: str | os.PathLike[str], passphrase: str) -> str:
    """Make a key, write it encrypted to a new file, and return its public half.

    Raises:
        ValidationError: a weak passphrase.
        FileExistsError: ``path`` exists already, be it a dangling link.
    """
    weak = passphrase_error(passphrase)
    if weak:
        raise ValidationError(weak)
    try:
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - optional, loaded when used
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        raise missing_extra("Making a key", "device-connect") from None
    key = Ed25519PrivateKey.generate()
    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(passphrase.encode()),
    )
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(pem)
        file.flush()
        os.fsync(file.fileno())
    return encode(public_half(key))


def load_signing_key(path: str | os.PathLike[str], passphrase: str) -> Any:
    """The Ed25519 private key of a file that :func:`keygen` wrote.

    Raises:
        ValueError: wrong passphrase, no private key, an unencrypted one, or a key of another kind.
        OSError: the file cannot be read.
    """
    try:
        from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - optional, loaded when used
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - optional, loaded when used
        from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        raise missing_extra("Loading a key", "device-connect") from None
    try:
        key = load_pem_private_key(Path(path).read_bytes(), passphrase.encode())
    except (TypeError, UnsupportedAlgorithm, ValueError) as exc:
        raise ValueError(f"{shown(str(path))} holds no private key that this passphrase opens.") from exc
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(f"{shown(str(path))} holds a key of another kind than Ed25519.")  # noqa: TRY004 - documented as ValueError
    return key
