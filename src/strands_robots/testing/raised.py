"""Exceptions that a robot raises while it is checked, for whoever mends it."""

from __future__ import annotations

import logging
import traceback
from collections import deque
from pathlib import Path

from strands_robots.stop_log import flush_stop_log

CABLE_OUT = "the emulated cable is out"
"""Text of the ``OSError`` that the checks have a bus raise; it is none of the robot's own."""

_KEPT, _FLUSH_S = 20, 0.5


class RaisedExceptions(logging.Handler):
    """Handler that keeps the newest exceptions of a log, each with its place."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self._texts: deque[str] = deque(maxlen=_KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        problem = record.exc_info[1] if record.exc_info else None
        if problem is None or CABLE_OUT in str(problem):
            return
        frames = traceback.extract_tb(problem.__traceback__)
        place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno} in {frames[-1].name})" if frames else ""
        self._texts.append(f"{type(problem).__name__}: {problem}{place}")

    def take(self) -> list[str]:
        """Return the exceptions since the last call, each text once."""
        # What is logged in the way of a stop is written by another thread.
        flush_stop_log(_FLUSH_S)
        taken = list(dict.fromkeys(self._texts))
        self._texts.clear()
        return taken
