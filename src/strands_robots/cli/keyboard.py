"""Keys as they are pressed, without Enter, on a thread that does nothing else."""

from __future__ import annotations

import contextlib
import os
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def keys(pressed: Callable[[str], None], closed: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Tell ``pressed`` each key from standard input, which must be a terminal; ``closed`` when that hangs up.

    Ctrl-C stays a signal. The terminal is as it was when the block is left.
    """
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def read() -> None:
        # A terminal that hangs up answers with an error, or with nothing.
        with contextlib.suppress(OSError):
            while data := os.read(terminal, 64):
                for key in data.decode("utf-8", "replace"):
                    pressed(key)
        closed()

    tty.setcbreak(terminal, termios.TCSANOW)
    threading.Thread(target=read, name="keys", daemon=True).start()
    try:
        yield
    finally:
        # A terminal that is gone has no modes to put back.
        with contextlib.suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)
