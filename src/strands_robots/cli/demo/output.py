"""Output of the demo: its screen, recorded as SVG, and pictures of the path."""

from __future__ import annotations

import io
import re
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

POSES_A_SECOND = 32.0
POSES_A_FRAME = 4
FRAMES_MAX = 40
SIZE = (360, 270)
"""Pixels of the animation; it stays below a megabyte."""

_TIMESTEP_S = 0.002
_SETTLE_S = 1.0
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


def draw_path(robot: str, path: Sequence[tuple[float, dict[str, float]]], folder: Path) -> tuple[list[Path], str]:
    """Replay a path on a simulated arm and write ``arm-path.png``, ``demo.gif``.

    Args:
        robot: the model that the agent drove.
        path: arrival (s) and joints by name (rad) of the events.
        folder: created where it is missing.

    Raises:
        CliError: nothing to draw, or the folder cannot be written.
    """
    from strands_robots.simulation import Simulation  # noqa: PLC0415 - MuJoCo is loaded after the live part
    from strands_robots.simulation.scene import Recording  # noqa: PLC0415 - as above

    poses = sample_poses(path, POSES_A_SECOND, FRAMES_MAX * POSES_A_FRAME)
    if len(poses) < 2:
        raise CliError("The agent saw too little of the motion to draw it.")
    twin = Simulation("twin", timestep=_TIMESTEP_S, realtime=False)
    try:
        twin.add_robot(robot)
        actuators = set(twin.body().action_features)
        recording = Recording(twin, width=SIZE[0], height=SIZE[1])

        def follow(joints: dict[str, float], seconds: float) -> None:
            twin.send_action({name: value for name, value in joints.items() if name in actuators})
            twin.step(round(seconds / _TIMESTEP_S))

        follow(poses[0], _SETTLE_S)
        for number, joints in enumerate(poses):
            follow(joints, 1 / POSES_A_SECOND)
            if number % POSES_A_FRAME:
                recording.trace()
            else:
                recording.capture()
        folder.mkdir(parents=True, exist_ok=True)
        files = [
            recording.save_picture(folder / "arm-path.png"),
            recording.save_animation(folder / "demo.gif", POSES_A_SECOND / POSES_A_FRAME),
        ]
    except (OSError, ValidationError) as exc:
        raise CliError(f"The pictures could not be written to {folder}: {exc}") from exc
    finally:
        twin.cleanup()
    empty = [str(file) for file in files if not file.is_file() or not file.stat().st_size]
    if empty:
        raise CliError(f"Nothing was written to {', '.join(empty)}.")
    return files, recording.how


def sample_poses(path: Sequence[tuple[float, dict[str, float]]], hz: float, most: int) -> list[dict[str, float]]:
    """Return at most ``most`` poses, one for each 1/``hz`` s with an event."""
    chosen: list[dict[str, float]] = []
    slot = -1
    for at, joints in path:
        now = int((at - path[0][0]) * hz)
        if now != slot:
            chosen.append(joints)
            slot = now
    return chosen[:most]
