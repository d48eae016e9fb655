"""Signed statements: a signature covers its purpose, its source and every field.

A message that was recorded and sent again under another name is no statement of that name: the purpose is part of the
signed bytes, and the reader takes it from what it asked for, never from the message.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from enum import Enum, StrEnum
from typing import Any

from strands_robots.audit import audit_head, log_witness
from strands_robots.safety import ed25519
from strands_robots.safety.identity import EnrolledKeys, KeyFileError, SigningIdentity
from strands_robots.safety.lockout import is_epoch
from strands_robots.stop_log import stop_logger
from strands_robots.utils import canonical_json

logger = stop_logger(__name__)

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


ANNOUNCED_S = 10.0
"""Seconds for which an announced lockout state is not signed anew while it stays the same."""

UNUSABLE = "its answer is only claimed: the enrolled keys cannot be used"


def with_stop_statement(
    identity: SigningIdentity | None, peer_id: str, turn_id: str, result: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a peer's answer to ``stop`` with its signed part, if it has a key.

    The turn is the asker's fresh id of this request, so that a recorded answer fits no other one.
    """
    if identity is None:
        return dict(result)
    fields = {"turn_id": turn_id, **_stated(result), "audit": audit_head()}
    statement = signed(identity, Purpose.STOP_VERDICT, peer_id, fields)
    return {**result, "statement": statement}


def with_lockout_statement(
    identity: SigningIdentity | None, peer_id: str, facts: Mapping[str, Any], nonce: str = ""
) -> dict[str, Any]:
    """Return a lockout state with its signed part, if there is a key.

    Args:
        nonce: of the question, so that a recorded answer fits no other one.
    """
    if identity is None:
        return dict(facts)
    fields = {"device_id": peer_id, **{name: facts[name] for name in ("locked", "epochs", "cell") if name in facts}}
    fields |= {"nonce": nonce} if nonce else {}
    return {**facts, "statement": signed(identity, Purpose.LOCKOUT_STATE, peer_id, fields)}


def with_resume_statement(
    identity: SigningIdentity | None,
    peer_id: str,
    assertion: object,
    result: Mapping[str, Any],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Return a peer's answer to a resume with its signed part, if it has a key.

    The assertion's nonce is in it, so that a recorded answer fits no other one.
    """
    if identity is None:
        return dict(result)
    fields = {"status": result["status"], "nonce": _nonce_of(assertion), **facts}
    return {**result, "statement": signed(identity, Purpose.RESUME_ANSWER, peer_id, fields)}


class LockoutAnnouncer:
    """The lockout state of a robot, as presence and ``state`` carry it.

    Args:
        identity: signs it; without one it is not signed.
    """

    def __init__(self, identity: SigningIdentity | None, clock: Callable[[], float] = time.monotonic) -> None:
        self._identity = identity
        self._clock = clock
        self._latest: dict[str, tuple[float, dict[str, Any]]] = {}

    def of(self, peer_id: str, facts: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``locked`` and ``epochs``, with a signed part if there is a key.

        Args:
            peer_id: the robot, or one of the robots of its world.
        """
        now = self._clock()
        since, announced = self._latest.get(peer_id, (now, {}))
        if now - since >= ANNOUNCED_S or any(announced.get(name) != value for name, value in facts.items()):
            announced = with_lockout_statement(self._identity, peer_id, facts)
            self._latest[peer_id] = now, announced
        return announced


def enrolled_peers() -> dict[str, bytes] | None:
    """Return the enrolled public keys by peer; None where they cannot be used."""
    try:
        return EnrolledKeys().load()
    except (KeyFileError, OSError) as exc:
        logger.critical("The enrolled keys cannot be used, so no answer counts as a robot's own: %s", exc)
        return None


def stop_distrust(reply: Mapping[str, Any], keys: Mapping[str, bytes] | None) -> str:
    """Return the reason why a reply to ``stop`` is not proven, or ""."""
    if keys is None:
        return UNUSABLE
    name, result = str(reply.get("responder_id")), reply.get("result")
    answer = result if isinstance(result, Mapping) else {}
    answered = {"turn_id": reply.get("turn_id"), **_stated(answer)}
    return distrust(Purpose.STOP_VERDICT, name, answer.get("statement"), enrolled_key(name, keys), answered)


def record_heads(witness: str, replies: Iterable[Mapping[str, Any]], expected: Collection[str]) -> None:
    """Write the audits' heads in answers to ``stop`` into our own audit.

    Args:
        witness: the peer that asked.
        expected: peers whose answer counts without an enrolled key.
    """
    keys = enrolled_peers() or {}
    for reply in replies:
        name, result = str(reply.get("responder_id")), reply.get("result")
        statement = result.get("statement") if isinstance(result, Mapping) else None
        key = enrolled_key(name, keys)
        if isinstance(statement, Mapping) and (key is not None or name in expected):
            proof = proof_of(Purpose.STOP_VERDICT, name, statement, key)
            if proof is not Proof.WRONG:
                log_witness(witness, name, statement.get("audit"), signed=proof is Proof.SIGNED)


def lockout_distrust(
    name: str, facts: Mapping[str, Any], epochs: list[str], keys: Mapping[str, bytes] | None, nonce: str = ""
) -> str:
    """Return the reason why a lockout state is not proven, or ""."""
    if keys is None:
        return UNUSABLE
    answered = {"locked": facts.get("locked"), "epochs": epochs} | ({"nonce": nonce} if nonce else {})
    return distrust(Purpose.LOCKOUT_STATE, name, facts.get("statement"), enrolled_key(name, keys), answered)


def resume_distrust(
    name: str, assertion: Mapping[str, Any], result: Mapping[str, Any], keys: Mapping[str, bytes] | None
) -> str:
    """Return the reason why an answer to a resume is not proven, or ""."""
    if keys is None:
        return UNUSABLE
    answered = {"nonce": _nonce_of(assertion), "status": result.get("status")}
    return distrust(Purpose.RESUME_ANSWER, name, result.get("statement"), enrolled_key(name, keys), answered)


def enrolled_key(name: str, keys: Mapping[str, bytes]) -> bytes | None:
    """Return the enrolled key of a peer; a robot of a world has the world's."""
    return keys.get(name) or keys.get(name.rpartition("__")[0])


def _nonce_of(assertion: object) -> str:
    nonce = assertion.get("nonce") if isinstance(assertion, Mapping) else None
    return str(nonce) if is_epoch(nonce) else ""


def _stated(result: Mapping[str, Any]) -> dict[str, Any]:
    return {name: result.get(name) for name in ("ok", "stopped", "not_stopped", "results")}
