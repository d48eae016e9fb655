"""Operator's assertion that takes a robot from its holder, and its check.

It names the robot and the epoch of its control lease. Taking control raises the epoch, so an assertion is good once.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from strands_robots.safety import ed25519
from strands_robots.safety.resume import NEWEST_S, OLDEST_S
from strands_robots.utils import canonical_json, shown

PURPOSE = "take-control"
TAKE_FIELDS = frozenset({"v", "purpose", "robot", "epoch", "t", "nonce", "sig"})
"""Fields of the operator's assertion; ``sig`` is the Ed25519 signature over the canonical JSON of the others."""

TEXT_MAX = 1024
"""Longest text of a field, in characters."""

VERSION = 1


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
