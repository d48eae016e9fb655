"""Operator's assertion that takes a robot from its holder, and its fresh epochs.

It names the robot and the epoch of its control lease. The epoch rises with each holder, so an assertion is good once,
and a restarted process begins above all epochs of the one before, so that a recorded assertion never fits again.
Neither a clock that is set back nor a second process with the same state directory changes that. The file
``control-epochs`` there has one byte for each robot that ever reserved its first epoch; the byte's place is the high
part of the epoch. The low part is random, so that a state directory that was lost or put back does not bring an epoch
back either.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from strands_robots.safety import ed25519
from strands_robots.safety.resume import NEWEST_S, OLDEST_S
from strands_robots.state_files import adopt, make_private, read_private, require_private, state_dir
from strands_robots.utils import canonical_json, shown

PURPOSE = "take-control"
TAKE_FIELDS = frozenset({"v", "purpose", "robot", "epoch", "t", "nonce", "sig"})
"""Fields of the operator's assertion; ``sig`` is the Ed25519 signature over the canonical JSON of the others."""

TEXT_MAX = 1024
"""Longest text of a field, in characters."""

VERSION = 1

EPOCHS_EACH = 2**28
"""Epochs from one reservation to the next; the first half is where a lease may begin."""


def sign_take(signing_key: Any, robot: str, epoch: int, *, clock: Callable[[], float] = time.time) -> dict[str, Any]:
    """Return the operator's assertion that takes ``robot`` from its holder."""
    body = {
        "v": VERSION,
        "purpose": PURPOSE,
        "robot": robot,
        "epoch": epoch,
        "t": clock(),
        "nonce": secrets.token_hex(16),
    }
    return {**body, "sig": ed25519.encode(signing_key.sign(canonical_json(body)))}


def unproven(assertion: object, robot: str, keys: Sequence[bytes]) -> str | None:
    """Return why none of ``keys`` has signed that ``robot`` be taken, or None."""
    if not assertion:
        return "it needs the operator's signature (assertion; strands-robots take --key FILE)"
    if not isinstance(assertion, Mapping) or set(assertion) != TAKE_FIELDS:
        return f"assertion must have exactly the fields {', '.join(sorted(TAKE_FIELDS))}"
    misshapen = sorted(name for name, value in assertion.items() if not _is_scalar(value))
    if misshapen or not isinstance(assertion["nonce"], str):
        return f"{', '.join(misshapen) or 'nonce'} of the assertion is none that an operator's machine makes"
    body = {name: value for name, value in assertion.items() if name != "sig"}
    signature = ed25519.decode(assertion["sig"], 64)
    try:
        signed = signature is not None and ed25519.signed_by_one_of(keys, signature, canonical_json(body))
    except ValueError:  # a number that JSON cannot carry
        signed = False
    if not signed:
        return "no configured key made the signature"
    if (body["v"], body["purpose"], body["robot"]) != (VERSION, PURPOSE, robot):
        return f"the assertion is for something else than taking control of {robot}"
    return None


def outdated(assertion: Mapping[str, Any], epoch: int, now: float) -> str | None:
    """Return why it is not for the lease of ``epoch`` at ``now``, or None.

    Args:
        assertion: one that is not :func:`unproven`.
        now: wall-clock seconds.
    """
    named, at = assertion["epoch"], assertion["t"]
    if named != epoch or isinstance(named, bool):
        return f"the assertion names epoch {shown(named)}, and the lease has epoch {epoch}"
    if isinstance(at, bool) or not isinstance(at, int | float) or not -NEWEST_S < now - at < OLDEST_S:
        return "the assertion is not fresh"
    return None


def _is_scalar(value: object) -> bool:
    return isinstance(value, int | float) or (isinstance(value, str) and len(value) <= TEXT_MAX)


def reserve_epochs() -> int:
    """Return an epoch above all that were ever reached here, kept on the disk.

    Raises:
        OSError: the state directory cannot be written.
        StateFileError: it, or the file, is not this user's alone.
    """
    root = state_dir()
    path = root / "control-epochs"
    adopt(root)
    make_private(root)
    require_private(root, root)
    with suppress(FileNotFoundError):
        read_private(path, root, longest=0)
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        os.write(descriptor, b".")
        os.fsync(descriptor)
        # Appending is atomic: no other process ends its byte at this place.
        place = os.lseek(descriptor, 0, os.SEEK_CUR)
    finally:
        os.close(descriptor)
    return place * EPOCHS_EACH + secrets.randbelow(EPOCHS_EACH // 2)
