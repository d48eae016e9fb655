"""Signed statements: a signature covers its purpose, its source and every field.

A message that was recorded and sent again under another name is no statement of that name: the purpose is part of the
signed bytes, and the reader takes it from what it asked for, never from the message.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from strands_robots.safety import ed25519

UNCOVERED = frozenset({"sig", "purpose", "source", "event_id", "ts"})
"""Fields that are not signed as they stand: the signature, what the reader knows, and the envelope's own."""


class Purpose(StrEnum):
    """The use of a signature, part of the signed bytes."""

    EMERGENCY_STOP = "emergency-stop"
    CHECK_IN = "check-in"
    STOP_VERDICT = "stop-verdict"
    LOCKOUT_STATE = "lockout-state"
    RESUME_ANSWER = "resume-answer"


def covered(purpose: Purpose, source: str, fields: Mapping[str, Any]) -> bytes:
    """Return the bytes that are signed.

    Raises:
        ValueError, TypeError, RecursionError: a field that JSON cannot carry.
    """
    stated = {name: value for name, value in fields.items() if name not in UNCOVERED}
    return ed25519.canonical({**stated, "purpose": purpose.value, "source": source})
