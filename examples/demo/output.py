"""Output of the demo: its screen, recorded as SVG, and pictures of the path."""

from __future__ import annotations

import io
import itertools
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from strands_robots.cli.output import CliError, Screen, label
from strands_robots.utils import ValidationError

RECORDING_WIDTH = 96
"""Columns of the recording."""

FRAMES_MIN, FRAMES_MAX = 12, 60
ANIMATION_S = 5.0
"""Length of the animation."""

DRAW_S = 12.0
"""Time to draw it in; where a frame takes long, as with OSMesa, there are fewer."""

SIZE = (400, 300)
"""Pixels of the animation; it stays below a megabyte."""

PAUSE_S = 0.4
"""Longest pause between two setpoints that is replayed."""

BUNCHED_S = 0.016
"""Shortest time between two setpoints; a busy machine delivers several at once."""

_CAMERA = "front"
_TIMESTEP_S = 0.002
_FONT_FACES = re.compile(r"@font-face\s*\{[^}]*\}\s*")


class DemoScreen:
    """Terminal with a live frame; a recording has each frame's last state.

    Args:
        screen: the terminal; silent with ``--json``.
        record: record what is shown.
    """

    def __init__(self, screen: Screen, record: bool = False) -> None:
        self._screen = screen
        self._tape = Console(
            file=io.StringIO(),
            record=True,
            width=RECORDING_WIDTH,
            force_terminal=True,
            color_system="truecolor",
            highlight=False,
        )
        self._recording = record
        self._number = 0

    def say(self, text: str, style: str = "") -> None:
        """Print one sentence."""
        self.panel(label(text, style))

    def head(self, text: str) -> None:
        """Print the number and title of the next step."""
        self._number += 1
        self.say("")
        self.say(f"{self._number}. {text}", "bold")

    def done(self, text: str) -> None:
        """Print the result of a step that happened."""
        line = Text()
        line.append("done  ", style="bold green")
        line.append_text(label(text))
        self.panel(line)

    def panel(self, thing: RenderableType) -> None:
        """Print anything that Rich can draw."""
        self._screen.show(thing)
        if self._recording:
            self._tape.print(thing)

    @contextmanager
    def live(self) -> Iterator[Callable[..., None]]:
        """Yield a function that redraws a frame; its last state stays."""
        last: list[RenderableType] = []

        def draw(*parts: RenderableType) -> None:
            last[:] = [Group(*parts)]
            if live is not None:
                live.update(last[0])

        terminal = self._screen.out
        live = Live(Text(""), console=terminal, refresh_per_second=15, transient=True) if self._screen.live else None
        with live or nullcontext():
            yield draw
        for frame in last:
            self.panel(frame)

    def save(self, path: Path) -> None:
        """Write the recording as SVG."""
        path.parent.mkdir(parents=True, exist_ok=True)
        drawing = self._tape.export_svg(title="strands-robots demo", clear=False)
        # The font that Rich names is on a server; the reader's own font needs no network.
        path.write_text(_FONT_FACES.sub("", drawing), encoding="utf-8")


def draw_motion(
    robot: str, scene: str, setpoints: Sequence[tuple[float, dict[str, float]]], folder: Path
) -> tuple[list[Path], str]:
    """Replay setpoints on a simulated arm and write ``arm-path.png``, ``demo.gif``.

    Args:
        robot: the model that the agent drove.
        scene: what it had before it.
        setpoints: arrival (s) and setpoints by joint (rad) of the events.
        folder: created where it is missing.

    Raises:
        CliError: nothing to draw, or the folder cannot be written.
    """
    from strands_robots.simulation import Simulation, furnish  # noqa: PLC0415 - MuJoCo is loaded after the live part
    from strands_robots.simulation.rendering import Recording  # noqa: PLC0415 - as above

    moves = replayed(setpoints)
    if len(moves) < 2:
        raise CliError("The agent saw too little of the motion to draw it.")
    twin = Simulation("twin", timestep=_TIMESTEP_S, realtime=False, stop_level="hold")
    try:
        twin.add_robot(robot)
        furnish(twin, scene)
        recording = Recording(twin, camera=_CAMERA, width=SIZE[0], height=SIZE[1])
        recording.capture()
        started = time.monotonic()
        recording.capture()  # the first one also made the OpenGL context
        most = frames_within(DRAW_S, time.monotonic() - started)
        frame_s, since = sum(seconds for _, seconds in moves) / most, 0.0
        for told, seconds in moves:
            twin.send_action(told)
            twin.step(round(seconds / _TIMESTEP_S))
            since += seconds
            if since < frame_s:
                recording.trace()
            else:
                recording.capture()
                since -= frame_s
        folder.mkdir(parents=True, exist_ok=True)
        files = [
            recording.save_picture(folder / "arm-path.png"),
            recording.save_animation(folder / "demo.gif", max(len(recording.frames) / ANIMATION_S, 1.0)),
        ]
    except (OSError, ValidationError) as exc:
        raise CliError(f"The pictures could not be written to {folder}: {exc}") from exc
    finally:
        twin.cleanup()
    empty = [str(file) for file in files if not file.is_file() or not file.stat().st_size]
    if empty:
        raise CliError(f"Nothing was written to {', '.join(empty)}.")
    return files, recording.how


def frames_within(seconds: float, each_s: float) -> int:
    """Return how many frames to draw where each takes ``each_s`` seconds."""
    return int(min(max(seconds / max(each_s, 1e-3), FRAMES_MIN), FRAMES_MAX))


def replayed(setpoints: Sequence[tuple[float, dict[str, float]]]) -> list[tuple[dict[str, float], float]]:
    """Return setpoints with seconds until the next: shorter pauses, no bunches."""
    arrivals = [at for at, _ in setpoints]
    until_next = [after - at for at, after in itertools.pairwise(arrivals)] + [PAUSE_S]
    return [
        (told, min(max(seconds, BUNCHED_S), PAUSE_S))
        for (_, told), seconds in zip(setpoints, until_next[: len(setpoints)], strict=True)
    ]
