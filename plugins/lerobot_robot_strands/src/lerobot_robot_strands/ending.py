"""The end of a LeRobot command in one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType

at_end: list[Callable[[], None]] = []
"""Called before this process ends with a sentence: LeRobot does not disconnect every device of a failed command."""


class RobotEndedError(ConnectionError):
    """The robot cannot be driven any further; the message is one sentence that says why."""


def one_sentence() -> None:
    """Have an uncaught :class:`RobotEndedError` end this process with its sentence in place of a traceback."""
    before = sys.excepthook
    if before is not _hook:
        _before.append(before)
        sys.excepthook = _hook


_before = [sys.__excepthook__]


def _hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, RobotEndedError):
        # Python ends with 1 after this, as after a traceback.
        print(error, file=sys.stderr, flush=True)
        for each in tuple(at_end):
            each()
    else:
        _before[-1](kind, error, trace)
