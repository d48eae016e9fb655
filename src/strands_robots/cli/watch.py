"""``watch DEVICE``: its joints as bars between their limits, and its task, live."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, TypeGuard

import typer
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from strands_robots.cli.command import Seconds, command
from strands_robots.cli.network import Network, call_device
from strands_robots.cli.output import CliError, Exit, Screen, label, plain
from strands_robots.utils import number

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.client import DeviceEvent

SILENCE_S = 5.0
"""Seconds without an event after which a device counts as silent; it reports its state every second."""

BAR_WIDTH = 32
NAME_WIDTH = 18
"""Characters of one bar, and of a joint's name."""

JOINTS_MAX = 24
"""Joints that are drawn; the rest is counted."""

Range = tuple[float, float]
FULL_TURN: Range = (-math.pi, math.pi)
"""Range of the bar of a joint without limits, in radians."""


def register(app: typer.Typer) -> None:
    """Add ``watch`` to the application."""
    command(app, "watch", network=True)(watch)


def watch(
    screen: Screen,
    network: Network,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    seconds: Seconds = None,
) -> None:
    """Show a device's joints and task as they change, until Ctrl-C. With --json: one event a line."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=7 * 24 * 3600)
    with network.fleet() as fleet:
        limits: dict[str, Range] = {}
        with contextlib.suppress(CliError):  # a device without getFeatures is drawn without its limits
            limits = joint_limits(call_device(fleet, device, "getFeatures", {}, 3.0))
        with contextlib.closing(fleet.events(device, timeout=SILENCE_S)) as arriving:
            events = until(arriving, longest, device)
            if screen.machine:
                for event in events:
                    screen.data({"device": event.device, "event": event.name, "payload": dict(event.payload)})
            elif screen.live:
                _draw_live(screen, _present_state(fleet, device, limits), events)
            else:
                print_changes(screen, events)


class DeviceView:
    """Last known joints and task of one device."""

    def __init__(self, device: str, limits: Mapping[str, Range]) -> None:
        self.device = device
        self._limits = limits
        self._joints: dict[str, Mapping[str, Any]] = {}
        self.task = "idle"

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Update from an answer to getState or getStatus."""
        robots = state.get("robots")
        if isinstance(state.get("joints"), Mapping):
            self._joints[""] = state["joints"]
        for name, joints in robots.items() if isinstance(robots, Mapping) else ():
            if isinstance(joints, Mapping):
                self._joints[str(name)] = joints

    def take(self, event: DeviceEvent) -> None:
        """Update from one event."""
        robot = str(event.payload.get("robot_name", ""))
        joints = event.payload.get("joints" if event.name == "observationUpdate" else "observation")
        if event.name in ("observationUpdate", "streamStep") and isinstance(joints, Mapping):
            self._joints[robot] = joints
        self.task = describe_task(event) or self.task

    def draw(self) -> RenderableType:
        """Return the device, its task and its joints."""
        parts: list[Any] = [label(f"{self.device}: {self.task}", "bold")]
        for robot, joints in self._joints.items():
            if len(self._joints) > 1:
                parts.append(label(robot))
            parts.append(joints_table(joints, self._limits))
        return Group(*parts)


def describe_task(event: DeviceEvent) -> str:
    """Return the task that an event reports, or an empty text."""
    facts = event.payload
    if event.name in ("taskStarted", "policyStarted"):
        return f"started {facts.get('instruction', '')!r} with {facts.get('policy_provider', '')}"
    if event.name in ("taskComplete", "policyComplete"):
        state, steps = facts.get("state", "completed"), facts.get("steps", "?")
        return f"{state}: {facts.get('instruction', '')!r} after {steps} steps"
    if event.name == "emergencyStop":
        return f"EMERGENCY STOP: {facts.get('reason', '')}"
    if event.name != "stateUpdate":
        return ""
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        tasks = [
            f"{name} does {row.get('instruction', '')!r}, step {row.get('step', '?')}"
            for name, row in running.items()
            if isinstance(row, Mapping)
        ]
        return "; ".join(tasks) or "idle"
    status = str(facts.get("task_status", ""))
    return f"{status}: {facts.get('instruction', '')!r}, step {facts.get('step_count', 0)}" if status else ""


def until(events: Iterator[DeviceEvent], longest: float | None, device: str) -> Iterator[DeviceEvent]:
    """Yield events for ``longest`` s; raise :class:`CliError` at silence."""
    ends = None if longest is None else time.monotonic() + longest
    for event in events:
        yield event
        if ends is not None and time.monotonic() >= ends:
            return
    if ends is None or time.monotonic() < ends:
        raise CliError(f"{device} was silent for {SILENCE_S:g} s.", Exit.SILENT)


def print_changes(screen: Screen, events: Iterator[DeviceEvent]) -> None:
    """Print one line for each change of the task."""
    last = ""
    for event in events:
        task = describe_task(event)
        if task and task != last:
            screen.say(f"{event.device}: {task}")
            last = task


def joint_limits(features: Mapping[str, Any]) -> dict[str, Range]:
    """Return the joint limits in an answer to getFeatures; a world's first robot."""
    robots = features.get("robots")
    chosen: Any = features
    if isinstance(robots, Mapping) and robots:
        chosen = next(iter(robots.values()))
    found: dict[str, Range] = {}
    for key in ("joints", "ranges"):
        joints = chosen.get(key) if isinstance(chosen, Mapping) else None
        for name, limits in joints.items() if isinstance(joints, Mapping) else ():
            pair = [value for value in limits if _finite(value)] if isinstance(limits, list | tuple) else []
            if len(pair) == 2 and pair[0] < pair[1]:
                # A real robot names the range of an action, such as pan.pos, and the position of the joint, pan.
                found[str(name)] = found[str(name).removesuffix(".pos")] = (float(pair[0]), float(pair[1]))
    return found


def joint_bar(value: float, limits: Range = FULL_TURN) -> Text:
    """Return a line from a joint's lower to its upper limit with a mark at its value."""
    low, high = limits
    share = min(1.0, max(0.0, (value - low) / (high - low)))
    at = round(share * (BAR_WIDTH - 1))
    line = Text("─" * at, style="bright_black")
    line.append("●", style="bold cyan")
    line.append("─" * (BAR_WIDTH - 1 - at), style="bright_black")
    return line


def joints_table(joints: Mapping[str, object], limits: Mapping[str, Range]) -> Table:
    """Return every joint of a finite value with its bar and its value."""
    grid = _grid()
    grid.add_column(no_wrap=True)
    grid.add_column(justify="right", no_wrap=True)
    drawn = {str(name): float(value) for name, value in joints.items() if _finite(value)}
    for name, value in list(drawn.items())[:JOINTS_MAX]:
        around = limits.get(name) or (min(FULL_TURN[0], value), max(FULL_TURN[1], value))
        grid.add_row(label(name), joint_bar(value, around), Text(f"{value:+.3f}"))
    if len(drawn) > JOINTS_MAX:
        grid.add_row(Text(f"and {len(drawn) - JOINTS_MAX} more", style="bright_black"), "", "")
    return grid


def motion_progress(title: str, done: float, total: float) -> Table:
    """Return a titled progress bar in seconds."""
    passed = min(max(done, 0.0), total)
    grid = _grid()
    grid.add_row(
        Text(plain(title, 60), style="bold"),
        ProgressBar(total=max(total, 1e-9), completed=passed, width=BAR_WIDTH),
        Text(f"{passed:.1f} / {total:.1f} s"),
    )
    return grid


def _grid() -> Table:
    grid = Table.grid(padding=(0, 2))
    grid.add_column(width=NAME_WIDTH, no_wrap=True, overflow="ellipsis")
    return grid


def _finite(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _present_state(fleet: FleetClient, device: str, limits: Mapping[str, Range]) -> DeviceView:
    """Return a view of the device now; an idle robot may send no joints."""
    view = DeviceView(device, limits)
    for function in ("getState", "getStatus"):
        with contextlib.suppress(CliError):  # a device answers one of the two
            view.take_state(call_device(fleet, device, function, {}, 3.0))
    return view


def _draw_live(screen: Screen, view: DeviceView, events: Iterator[DeviceEvent]) -> None:
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    with Live(view.draw(), console=screen.out, refresh_per_second=15) as live:
        for event in events:
            view.take(event)
            live.update(view.draw())
