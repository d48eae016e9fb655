"""Signed statements: a signature covers its purpose, its source and every field.

A message that was recorded and sent again under another name is no statement of that name: the purpose is part of the
signed bytes, and the reader takes it from what it asked for, never from the message.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from enum import Enum, StrEnum
from typing import Any

from strands_robots.safety import ed25519
from strands_robots.safety.identity import SigningIdentity
from strands_robots.utils import canonical_json

UNCOVERED = frozenset({"sig", "purpose", "source", "event_id", "ts"})
"""Fields that are not signed as they stand: the signature, what the reader knows, and the envelope's own."""


class Purpose(StrEnum):
    """The use of a signature, part of the signed bytes."""

    EMERGENCY_STOP = "emergency-stop"
    STOP_SCOPE = "emergency-stop-scope"
    CHECK_IN = "check-in"
    CHECK_IN_ANSWER = "check-in-answer"
    STOP_VERDICT = "stop-verdict"
    LOCKOUT_STATE = "lockout-state"
    RESUME_ANSWER = "resume-answer"
    STOP_ROSTER = "stop-roster"
    MISSED_STOPS = "missed-stops"


def covered(purpose: Purpose, source: str, fields: Mapping[str, Any]) -> bytes:
    """Return the bytes that are signed.

    Raises:
        ValueError, TypeError, RecursionError: a field that JSON cannot carry.
    """
    stated = {name: value for name, value in fields.items() if name not in UNCOVERED}
    return canonical_json({**stated, "purpose": purpose.value, "source": source})


STATED_WITHIN_S = 60.0
"""Largest age of a statement that no question's id dates; the two clocks have to agree as well as that."""

ALARM = "ALARM"
"""First word of the reason for an answer that cannot be the robot's."""


class Proof(Enum):
    """Grades of a statement's signature."""

    SIGNED = "signed by the enrolled key"
    CLAIMED = "not signed, or by a key that is not enrolled"
    WRONG = "signed by another key than the enrolled one, or not by the key it names"


def signed(
    identity: SigningIdentity | None, purpose: Purpose, source: str, fields: Mapping[str, Any]
) -> dict[str, Any]:
    """Return ``fields`` as a statement: with purpose, time, public key and signature.

    Without an identity it has a time and no signature.
    """
    stated = {**fields, "purpose": purpose.value, "t": time.time()}
    if identity is None:
        return stated
    stated["key"] = identity.public_text
    return {**stated, "sig": identity.sign(covered(purpose, source, stated))}


def own_key(purpose: Purpose, source: str, fields: Mapping[str, Any]) -> bytes | None:
    """Return the public key that a statement names and is signed with, or None."""
    signature, key = ed25519.decode(fields.get("sig"), 64), ed25519.decode(fields.get("key"), 32)
    if signature is None or key is None:
        return None
    try:
        message = covered(purpose, source, fields)
    except (ValueError, TypeError, RecursionError):
        return None
    return key if ed25519.signed_by_one_of([key], signature, message) else None


def proof_of(purpose: Purpose, source: str, fields: Mapping[str, Any], enrolled: bytes | None) -> Proof:
    """Grade a statement of ``source``, whose enrolled key is given; None for none."""
    if enrolled is None or "sig" not in fields:
        return Proof.CLAIMED
    if ed25519.decode(fields.get("key"), 32) != enrolled:
        return Proof.WRONG
    return Proof.SIGNED if own_key(purpose, source, fields) == enrolled else Proof.WRONG


def distrust(
    purpose: Purpose, source: str, statement: object, enrolled: bytes | None, answered: Mapping[str, Any]
) -> str:
    """Return the reason why an answer is not proven the robot's own, or "".

    Args:
        purpose: of the statement that was asked for.
        source: the robot that was asked.
        statement: the signed part of its answer.
        enrolled: its key; None where it is not enrolled, and its answer needs no proof.
        answered: fields that the statement must hold as the answer has them.
    """
    if enrolled is None:
        return ""
    fields = statement if isinstance(statement, Mapping) else {}
    proof = proof_of(purpose, source, fields, enrolled)
    if proof is Proof.WRONG:
        return f"{ALARM}: its answer has a signature that is not of its enrolled key"
    if proof is Proof.CLAIMED:
        return "its answer is only claimed: it is not signed, and this robot is enrolled"
    at = fields.get("t")
    if not isinstance(at, int | float) or abs(time.time() - at) > STATED_WITHIN_S:
        return "its signed answer is not of this minute: it is an old one, or the clocks disagree"
    if any(fields.get(name) != value for name, value in answered.items()):
        return f"{ALARM}: its answer says something else than its signed part"
    return ""
