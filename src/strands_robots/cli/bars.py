"""Joints as bars: each where it stands between its limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeGuard

from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from strands_robots.cli.output import label, plain

WIDTH = 32
"""Characters of one bar."""

NAME_WIDTH = 18
"""Characters of a joint's name."""

MOST = 24
"""Joints that are drawn; the rest is counted."""

Range = tuple[float, float]
TURN: Range = (-math.pi, math.pi)
"""What a joint without limits is drawn in, in radians."""


def ranges(features: Mapping[str, Any], robot: str = "") -> dict[str, Range]:
    """The joint limits that a device's getFeatures answered, by joint; empty where it names none.

    Args:
        features: the answer, or what it holds.
        robot: which robot of a simulated world; empty for its first one.
    """
    robots = features.get("robots")
    chosen: Any = features
    if isinstance(robots, Mapping) and robots:
        chosen = robots.get(robot) or next(iter(robots.values()))
    found: dict[str, Range] = {}
    for key in ("joints", "ranges"):
        joints = chosen.get(key) if isinstance(chosen, Mapping) else None
        for name, limits in joints.items() if isinstance(joints, Mapping) else ():
            pair = [number for number in limits if _finite(number)] if isinstance(limits, list | tuple) else []
            if len(pair) == 2 and pair[0] < pair[1]:
                # A real robot names the range of an action, such as pan.pos, and the position of the joint, pan.
                found[str(name)] = found[str(name).removesuffix(".pos")] = (float(pair[0]), float(pair[1]))
    return found


def bar(value: float, limits: Range = TURN, width: int = WIDTH) -> Text:
    """One joint: a mark on a line from its lower to its upper limit."""
    low, high = limits
    share = min(1.0, max(0.0, (value - low) / (high - low)))
    at = round(share * (width - 1))
    line = Text("─" * at, style="bright_black")
    line.append("●", style="bold cyan")
    line.append("─" * (width - 1 - at), style="bright_black")
    return line


def joints_table(joints: Mapping[str, object], limits: Mapping[str, Range]) -> Table:
    """Every joint with its bar and its value; values that are no finite number are left out."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(width=NAME_WIDTH, no_wrap=True, overflow="ellipsis")
    grid.add_column(no_wrap=True)
    grid.add_column(justify="right", no_wrap=True)
    drawn = {str(name): float(value) for name, value in joints.items() if _finite(value)}
    for name, value in list(drawn.items())[:MOST]:
        around = limits.get(name) or (min(TURN[0], value), max(TURN[1], value))
        grid.add_row(label(name), bar(value, around), Text(f"{value:+.3f}"))
    if len(drawn) > MOST:
        grid.add_row(Text(f"and {len(drawn) - MOST} more", style="bright_black"), "", "")
    return grid


def progress(title: str, done: float, total: float) -> Table:
    """A titled progress bar in seconds."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(width=NAME_WIDTH, no_wrap=True, overflow="ellipsis")
    grid.add_row(
        Text(plain(title, 60), style="bold"),
        ProgressBar(total=max(total, 1e-9), completed=min(max(done, 0.0), total), width=WIDTH),
        Text(f"{min(max(done, 0.0), total):.1f} / {total:.1f} s"),
    )
    return grid


def _finite(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
