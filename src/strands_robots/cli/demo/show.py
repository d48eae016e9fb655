"""Where the demo is told: the terminal, and a recording of it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from strands_robots.cli.output import Screen, label

WIDTH = 96
"""Columns of the recording."""

_FONT_FACES = re.compile(r"@font-face\s*\{[^}]*\}\s*")


class Show:
    """Sentences, tables and a live frame; the recording keeps the last state of each frame.

    Args:
        screen: the terminal; silent with ``--json``.
        record: keep a recording.
    """

    def __init__(self, screen: Screen, record: bool = False) -> None:
        self._screen = screen
        self._tape = Console(
            file=io.StringIO(), record=True, width=WIDTH, force_terminal=True, color_system="truecolor", highlight=False
        )
        self._recording = record
        self._number = 0

    def say(self, text: str, style: str = "") -> None:
        """One sentence."""
        self.panel(label(text, style))

    def head(self, text: str) -> None:
        """What comes next."""
        self._number += 1
        self.say("")
        self.say(f"{self._number}. {text}", "bold")

    def done(self, text: str) -> None:
        """A step that happened."""
        line = Text()
        line.append("done  ", style="bold green")
        line.append_text(label(text))
        self.panel(line)

    def panel(self, thing: RenderableType) -> None:
        """Anything that Rich can draw."""
        self._screen.show(thing)
        if self._recording:
            self._tape.print(thing)

    @contextmanager
    def live(self) -> Iterator[Callable[..., None]]:
        """A frame that is drawn over and over; its last state stays."""
        last: list[RenderableType] = []

        def draw(*parts: RenderableType) -> None:
            last[:] = [Group(*parts)]
            if live is not None:
                live.update(last[0])

        live = self._live()
        if live is None:
            yield draw
        else:
            with live:
                yield draw
        for frame in last:
            self.panel(frame)

    def _live(self) -> Live | None:
        console = self._screen.out
        if self._screen.machine or not console.is_terminal:
            return None
        return Live(Text(""), console=console, refresh_per_second=15, transient=True)

    def save(self, path: Path) -> None:
        """Write the recording as SVG."""
        path.parent.mkdir(parents=True, exist_ok=True)
        drawing = self._tape.export_svg(title="strands-robots demo", clear=False)
        # The font that Rich names lies on a server; a reader's own does as well and needs no network.
        path.write_text(_FONT_FACES.sub("", drawing), encoding="utf-8")
