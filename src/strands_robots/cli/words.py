"""``key=value`` words of a command line as typed values."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from typing import Any

from strands_robots.utils import ValidationError, shown

_SERIAL = re.compile(r"/.|COM\d+\Z", re.IGNORECASE)
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def assignments(words: Iterable[str]) -> dict[str, Any]:
    """The values by key: what is JSON is read as JSON, all else is text.

    ``speed=1.5`` is a number, ``name='"1.5"'`` the text 1.5, ``instruction=wave`` the text wave.

    Raises:
        ValidationError: no ``=``, a key that is no name, a key given twice, or a number that is not finite.
    """
    values: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or not _KEY.match(key):
            raise ValidationError(f"arguments must be key=value with a name as key, not {shown(word)}.")
        if key in values:
            raise ValidationError(f"{key} is given twice.")
        values[key] = _value(key, text)
    return values


def told_apart(ports: Iterable[str]) -> tuple[int | None, str | None]:
    """The TCP port and the serial port among the words of a ``--port`` that may mean either.

    Raises:
        ValidationError: one that is neither, or two of a kind.
    """
    meeting: int | None = None
    serial: str | None = None
    for word in ports:
        if _SERIAL.match(word):
            if serial is not None:
                raise ValidationError(f"--port names two serial ports: {serial} and {word}.")
            serial = word
        elif word.isdecimal() and 1 <= int(word) <= 65535:
            if meeting is not None:
                raise ValidationError(f"--port names two numbers: {meeting} and {word}.")
            meeting = int(word)
        else:
            raise ValidationError(
                f"--port must be a serial port such as /dev/ttyACM0 or a number from 1 to 65535, not {shown(word)}."
            )
    return meeting, serial


def _value(key: str, text: str) -> Any:
    def refuse(word: str) -> float:
        raise ValidationError(f"{key} must be finite; JSON has no {word}.")

    try:
        value = json.loads(text, parse_constant=refuse)
    except ValidationError:
        raise
    except (ValueError, RecursionError):
        return text
    if isinstance(value, float) and not math.isfinite(value):
        raise ValidationError(f"{key} must be finite, not {shown(text)}.")
    return value
