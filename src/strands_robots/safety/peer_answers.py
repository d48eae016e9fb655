"""Signed answers of mesh peers, beside the fields that every peer knows."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from strands_robots.audit import audit_head, log_witness
from strands_robots.safety.identity import EnrolledKeys, KeyFileError, SigningIdentity
from strands_robots.safety.statements import Proof, Purpose, distrust, proof_of, signed

logger = logging.getLogger(__name__)

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


def with_lockout_statement(identity: SigningIdentity | None, peer_id: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``locked`` and ``epochs`` with their signed part, if there is a key."""
    if identity is None:
        return dict(facts)
    fields = {"device_id": peer_id, "locked": facts["locked"], "epochs": facts["epochs"]}
    return {**facts, "statement": signed(identity, Purpose.LOCKOUT_STATE, peer_id, fields)}


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
    return distrust(Purpose.STOP_VERDICT, name, answer.get("statement"), keys.get(name), answered)


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
        if isinstance(statement, Mapping) and (name in keys or name in expected):
            proof = proof_of(Purpose.STOP_VERDICT, name, statement, keys.get(name))
            if proof is not Proof.WRONG:
                log_witness(witness, name, statement.get("audit"), signed=proof is Proof.SIGNED)


def lockout_distrust(name: str, facts: Mapping[str, Any], epochs: list[str], keys: Mapping[str, bytes] | None) -> str:
    """Return the reason why a lockout state is not proven, or ""."""
    if keys is None:
        return UNUSABLE
    answered = {"locked": facts.get("locked"), "epochs": epochs}
    return distrust(Purpose.LOCKOUT_STATE, name, facts.get("statement"), keys.get(name), answered)


def _stated(result: Mapping[str, Any]) -> dict[str, Any]:
    return {name: result.get(name) for name in ("ok", "stopped", "not_stopped", "results")}
