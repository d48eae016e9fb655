"""Keeping the log off a screen that is being drawn: its lines would tear it, and writing them could block."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

LINES = 5


class _Lines(logging.Handler):
    """The last lines of the log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: deque[str] = deque(maxlen=LINES)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname} {record.getMessage()}")


@contextmanager
def kept_log() -> Iterator[deque[str]]:
    """For the length of the block the log goes into the deque, newest last, and nowhere else."""
    root, mine = logging.getLogger(), _Lines()
    before, root.handlers = root.handlers, [mine]
    try:
        yield mine.lines
    finally:
        root.handlers = before
