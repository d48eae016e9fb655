"""What reaches the terminal: exit codes, failures, and a screen that speaks to people or to programs.

Text that came over a network is shown as it is, never as markup and never as a control sequence: it passes
through :func:`plain` and goes to Rich as :class:`rich.text.Text`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table
    from rich.text import Text

LONGEST = 400
"""Characters of one network text that are shown."""


class Exit(IntEnum):
    """Exit codes of every command."""

    OK = 0
    REFUSED = 1
    USAGE = 2
    SILENT = 3
    INTERRUPTED = 130


class Failure(Exception):  # noqa: N818 - an outcome of a command, told to its user
    """A command that ends here: one sentence for the user, a code for scripts, fields for ``--json``."""

    def __init__(self, reason: str, code: Exit = Exit.REFUSED, **fields: Any) -> None:
        super().__init__(reason)
        self.reason = reason
        self.code = code
        self.fields = fields


def plain(value: object, longest: int = LONGEST) -> str:
    """``value`` as one line of printable text: control, format and bidi characters become visible escapes."""
    text = value if isinstance(value, str) else _compact(value)
    shown = "".join(_visible(char) for char in text[:longest])
    return shown if len(text) <= longest else f"{shown}... ({len(text)} characters)"


def label(value: object, style: str = "") -> Text:
    """``value`` for Rich, without markup."""
    from rich.text import Text  # noqa: PLC0415 - Rich is loaded when something is shown

    return Text(plain(value), style=style)


class Screen:
    """Where a command speaks: tables and sentences for people, or one JSON value a line for programs.

    Args:
        machine: true with ``--json``; then stdout carries JSON alone.
        console: in place of stdout, for recordings and tests.
    """

    def __init__(self, machine: bool = False, console: Console | None = None) -> None:
        from rich.console import Console  # noqa: PLC0415 - Rich is loaded when something is shown

        self.machine = machine
        self.out = console or Console(file=sys.stdout, highlight=False)
        self.err = Console(file=sys.stderr, highlight=False)

    def say(self, text: str, style: str = "") -> None:
        """One sentence for people."""
        if not self.machine:
            self.out.print(label(text, style))

    def copyable(self, text: str) -> None:
        """One line for people to paste elsewhere: never broken at the width of the terminal."""
        if not self.machine:
            self.out.print(label(text), soft_wrap=True)

    def show(self, thing: RenderableType) -> None:
        """A table or panel for people."""
        if not self.machine:
            self.out.print(thing)

    def data(self, value: Any) -> None:
        """One JSON value on its own line, for programs."""
        if self.machine:
            sys.stdout.write(json.dumps(value, ensure_ascii=True, default=str) + "\n")
            sys.stdout.flush()

    def fail(self, failure: Failure) -> None:
        """Say why a command ends without success."""
        if self.machine:
            self.data({"status": "error", "reason": failure.reason, "exit": int(failure.code), **failure.fields})
        else:
            self.err.print(label(failure.reason, "red"), soft_wrap=True)


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """A table of network text; a cell that is already a Text keeps its style."""
    from rich import box  # noqa: PLC0415 - Rich is loaded when something is shown
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    result = Table(title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        result.add_column(column, overflow="fold")
    for row in rows:
        result.add_row(*(cell if isinstance(cell, Text) else label(cell) for cell in row))
    return result


def _visible(char: str) -> str:
    return char if char.isprintable() else char.encode("unicode_escape").decode("ascii")


def _compact(value: object) -> str:
    try:
        return json.dumps(value, ensure_ascii=False, default=str)
    except (TypeError, ValueError, RecursionError):
        return f"a {type(value).__name__}"
