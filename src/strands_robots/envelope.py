"""The one shape in which every verb answers.

A success is ``{"status": "success", "content": [{"text": ...}, {"json": {...}}], **fields}``; an error also
has ``reason``, the sentence that its text repeats. The flat fields and the json block hold the same data:
agents read the content, programs read the keys.
"""

from __future__ import annotations

from typing import Any

Envelope = dict[str, Any]


def success(text: str, **fields: Any) -> Envelope:
    """Answer that the verb did what it was asked; ``fields`` become flat keys and the json block."""
    return {"status": "success", "content": _content(text, fields), **fields}


def error(reason: str, **fields: Any) -> Envelope:
    """Answer that the verb refused or failed, and why, in one sentence."""
    return {"status": "error", "reason": reason, "content": _content(reason, fields), **fields}


def is_error(answer: object) -> bool:
    """True for an envelope that reports an error."""
    return isinstance(answer, dict) and answer.get("status") == "error"


def text_of(answer: Envelope) -> str:
    """The human sentence of an envelope, or an empty string when it has none."""
    for block in answer.get("content", []):
        if isinstance(block, dict) and isinstance(block.get("text"), str):
            return str(block["text"])
    return str(answer.get("reason", ""))


def _content(text: str, fields: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"text": text}, {"json": dict(fields)}] if fields else [{"text": text}]
