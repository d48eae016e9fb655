"""Output of the commands: exit codes, errors, a screen or JSON.

Text that came over a network is shown as it is, never as markup and never as a control sequence: it passes
through :func:`plain` and goes to Rich as :class:`rich.text.Text`.
"""

from __future__ import annotations

import errno
import json
import logging
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import IntEnum
from typing import Any

from rich import box
from rich.console import Console, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from strands_robots.errors import StrandsRobotsError

LENGTH_MAX = 400
"""Characters of one network text that are shown."""

COPYABLE_MAX = 10_000
"""Characters of a line to paste elsewhere: one that is cut would do something else."""

WIDE = 4096
"""Columns of what is not a terminal."""

PANEL_WIDTH = 100
"""Columns of a panel there."""

LATE_S = 2.0
"""Age in seconds of a robot's last sign of life that is shown in red: our robots give one a second."""

SIGNED = frozenset({"statement", "assertion", "sig", "signature"})
"""Fields of an answer that prove it, and say nothing to a person."""

_ENCODED = re.compile(r"(?<![A-Za-z0-9+/_-])[A-Za-z0-9+/_-]{40,}={0,2}")
"""Text that may be base64 of a key, a signature or a picture."""

_SYSTEM_ERROR = re.compile(r"\[Errno (\d+)\] ([^:'\"\n]+)(?:: ['\"]([^'\"\n]*)['\"](?: -> ['\"][^'\"\n]*['\"])?)?")
"""A system's error as Python writes it: number, text and file."""

_ERRORS = {
    errno.ENOENT: "there is no such file or directory; check the path",
    errno.EEXIST: "something of that name is there already; name another one, or remove it",
    errno.ENOTDIR: "a part of that path is a file, where a directory has to be; name another one",
    errno.EISDIR: "it is a directory, where a file has to be; name a file",
    errno.EACCES: "this user may not use it; change its permissions, or name another one",
    errno.EPERM: "this user may not use it; change its permissions, or name another one",
    errno.EROFS: "its file system cannot be written; name another one",
    errno.ENOSPC: "the disk is full; free some of it",
    errno.EADDRINUSE: "another program holds the port; end it, or choose another port",
    errno.ECONNREFUSED: "nothing listens there; start what should",
}

LOG_LINES = 5
POLL_S = 0.05


class Exit(IntEnum):
    """Exit codes of every command."""

    OK = 0
    REFUSED = 1
    USAGE = 2
    SILENT = 3
    INTERRUPTED = 130


class CliError(StrandsRobotsError):
    """Failure of a command: a sentence, an exit code, fields for ``--json``."""

    def __init__(self, reason: str, code: Exit = Exit.REFUSED, **fields: Any) -> None:
        super().__init__(reason)
        self.reason = reason
        self.code = code
        self.fields = fields


def plain(value: object, longest: int = LENGTH_MAX) -> str:
    """Return ``value`` as one printable line, control characters escaped."""
    text = value if isinstance(value, str) else _compact(value)
    visible = "".join(_visible(char) for char in text[:longest])
    return visible if len(text) <= longest else f"{visible}... ({len(text)} characters)"


def in_words(reason: str) -> str:
    """Return a reason with the system's errors in words, and what to do about them."""
    return _SYSTEM_ERROR.sub(lambda found: _words(int(found[1]), found[2], found[3] or ""), reason)


def _words(number: int, text: str, file: str) -> str:
    about = f"{file}: " if file else ""
    return f"{about}{_ERRORS.get(number, text.strip())}"


def label(value: object, style: str = "") -> Text:
    """Return ``value`` for Rich, without markup."""
    return Text(plain(value), style=style)


def readable(value: Any) -> Any:
    """Return an answer's value for people.

    It comes without signatures, and with encoded bytes as their number; ``--json`` has all of it.
    """
    if isinstance(value, Mapping):
        return {name: readable(each) for name, each in value.items() if name not in SIGNED}
    if isinstance(value, list | tuple):
        return [readable(each) for each in value]
    return _ENCODED.sub(_length, value) if isinstance(value, str) else value


def _length(encoded: re.Match[str]) -> str:
    text = encoded[0]
    # A long name or path has no capitals, small letters and digits at once.
    if not all(any(kind(char) for char in text) for kind in (str.isupper, str.islower, str.isdigit)):
        return text
    return f"<{len(text)} characters, shown by --json>"


class Screen:
    """Output of one command: for people, or one JSON value a line for programs.

    Args:
        machine: true with ``--json``; then stdout carries only JSON.
        console: in place of stdout, for recordings and tests.
    """

    def __init__(self, machine: bool = False, console: Console | None = None) -> None:
        self.machine = machine
        # What is piped goes to a program or a file, which no terminal's width should break.
        self.out = console or Console(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else WIDE)
        self.err = Console(file=sys.stderr, highlight=False)

    @property
    def live(self) -> bool:
        """True when a person looks at a terminal that can be redrawn."""
        return self.out.is_terminal and not self.machine

    def say(self, text: str, style: str = "") -> None:
        """Print one sentence for people."""
        self.show(label(text, style))

    def copyable(self, text: str, style: str = "") -> None:
        """Print a line to paste elsewhere, never broken at the terminal's width."""
        if not self.machine:
            self.out.print(Text(plain(text, COPYABLE_MAX)), style=style, soft_wrap=True)

    def show(self, thing: RenderableType) -> None:
        """Print a table or panel for people."""
        if not self.machine:
            self.out.print(thing, width=PANEL_WIDTH if isinstance(thing, Panel) and not self.out.is_terminal else None)

    def redraw(self, text: str) -> None:
        """Draw one line over the one before it; an empty text takes it away."""
        if self.live:
            width = max(1, self.out.width - 1)
            self.out.print(label(text[:width].ljust(width)), end="\r", soft_wrap=True)

    def data(self, value: Any) -> None:
        """Print one JSON value on its own line, for programs."""
        if self.machine:
            sys.stdout.write(json.dumps(value, ensure_ascii=True, default=str) + "\n")
            sys.stdout.flush()

    def fail(self, failure: CliError) -> None:
        """Report why a command ends without success."""
        reason = in_words(failure.reason)
        if self.machine:
            self.data({"status": "error", "reason": reason, "exit": int(failure.code), **failure.fields})
        else:
            self.err.print(label(reason, "red"), soft_wrap=True)


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """Return a table of network text; a cell that is already a Text keeps its style."""
    result = Table(title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        result.add_column(column, overflow="fold")
    for row in rows:
        result.add_row(*(cell if isinstance(cell, Text) else label(cell) for cell in row))
    return result


@contextmanager
def progress_bar(screen: Screen, seconds: float | None, title: str = "playing") -> Iterator[Callable[[float], None]]:
    """Yield a function that moves a progress bar; without a terminal it does nothing."""
    if seconds is None or not screen.live:
        yield lambda _: None
        return
    from rich.progress import Progress  # noqa: PLC0415 - loaded when a bar is drawn

    with Progress(console=screen.out, transient=True) as progress:
        task = progress.add_task(title, total=seconds)
        yield lambda passed: progress.update(task, completed=passed)


def wait_until(
    screen: Screen, over: Callable[[], str], duration: float = 0.0, *, at_end: Callable[[], object] = lambda: None
) -> str:
    """Wait until ``over`` returns a reason, or for Ctrl-C; return the reason.

    Args:
        screen: where a bar is drawn when the duration is known.
        over: empty until the wait ends, then why.
        duration: expected seconds; 0 when unknown.
        at_end: called first, before the bar is taken from a terminal, which may take no more output.
    """
    began = time.monotonic()
    with progress_bar(screen, duration or None) as moved:
        try:
            while not (reason := over()):
                moved(time.monotonic() - began)
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            reason = "Ctrl-C."
        finally:
            at_end()
    return reason


class _LastLines(logging.Handler):
    """Handler that keeps the last lines of the log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: deque[str] = deque(maxlen=LOG_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname} {record.getMessage()}")


@contextmanager
def captured_log() -> Iterator[deque[str]]:
    """Send the log into the yielded deque, newest last, and nowhere else.

    Log lines would tear a screen that is being redrawn, and writing them could block it.
    """
    root, handler = logging.getLogger(), _LastLines()
    before, root.handlers = root.handlers, [handler]
    try:
        yield handler.lines
    finally:
        root.handlers = before


def _visible(char: str) -> str:
    return char if char.isprintable() else char.encode("unicode_escape").decode("ascii")


def _compact(value: object) -> str:
    try:
        return json.dumps(value, ensure_ascii=False, default=str)
    except (TypeError, ValueError, RecursionError):
        return f"a {type(value).__name__}"
