"""Frames of the rail: one line each, with a number and a checksum.

A question is ``1F GO 350.0 100.0*58`` and its answer ``1F OK MOVING*67`` or ``1F NO HELD*73``. The first word is the
number of the question, 00 to FF, which its answer repeats; ``--`` is a notice that answers none. The checksum is the
exclusive or of all bytes before the star.
"""

from __future__ import annotations

NOTICE = "--"
LONGEST = 120


class BadFrameError(ValueError):
    """A line that is no frame, or whose checksum is wrong."""


def checksum(text: str) -> int:
    """Return the exclusive or of the bytes of a text."""
    total = 0
    for byte in text.encode("ascii"):
        total ^= byte
    return total


def packed(number: str, *words: str) -> bytes:
    """Return a frame as it goes over the wire."""
    text = " ".join((number, *words))
    return f"{text}*{checksum(text):02X}\r\n".encode("ascii")


def unpacked(line: bytes) -> tuple[str, list[str]]:
    """Return number and words of a line.

    Raises:
        BadFrameError: it is no frame.
    """
    try:
        text, star, total = line.decode("ascii").strip().rpartition("*")
    except UnicodeDecodeError as exc:
        raise BadFrameError("not ASCII") from exc
    if not star or total != f"{checksum(text):02X}":
        raise BadFrameError(f"checksum of {text[:LONGEST]!r}")
    number, *words = text.split(" ")
    if not words:
        raise BadFrameError("no words")
    return number, words
