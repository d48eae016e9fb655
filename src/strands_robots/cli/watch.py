"""``watch DEVICE``: its joints and its task, live."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.fleet import asked, reached
from strands_robots.cli.network import Network
from strands_robots.cli.output import Exit, Failure, Screen, label
from strands_robots.utils import number

if TYPE_CHECKING:
    from rich.console import RenderableType

    from strands_robots.cli.bars import Range
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.client import DeviceEvent

SILENCE_S = 5.0
"""Without an event for this long a device counts as silent; it tells its state once a second."""


def register(app: typer.Typer) -> None:
    """Add ``watch`` to the application."""
    command(app, "watch", network=True)(watch)


def watch(
    screen: Screen,
    network: Network,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    seconds: Annotated[float | None, typer.Option("--for", help="End after that many seconds.")] = None,
) -> None:
    """Show a device's joints and task as they change, until Ctrl-C. With --json: one event a line."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=7 * 24 * 3600)
    with reached(network) as fleet:
        limits: dict[str, Range] = {}
        with contextlib.suppress(Failure):  # a device without getFeatures is drawn without its limits
            limits = _limits(asked(fleet, device, "getFeatures", {}, 3.0))
        with contextlib.closing(fleet.events(device, timeout=SILENCE_S)) as heard:
            events = until(heard, longest, device)
            if screen.machine:
                for event in events:
                    screen.data({"device": event.device, "event": event.name, "payload": dict(event.payload)})
            elif screen.out.is_terminal:
                _live(screen, _first_view(fleet, device, limits), events)
            else:
                in_lines(screen, events)


class View:
    """What is known of one device, from its events."""

    def __init__(self, device: str, limits: Mapping[str, Range]) -> None:
        self.device = device
        self._limits = limits
        self._joints: dict[str, Mapping[str, Any]] = {}
        self.task = "idle"

    def look(self, state: Mapping[str, Any]) -> None:
        """Learn from an answer to getState or getStatus."""
        robots = state.get("robots")
        if isinstance(state.get("joints"), Mapping):
            self._joints[""] = state["joints"]
        for name, joints in robots.items() if isinstance(robots, Mapping) else ():
            if isinstance(joints, Mapping):
                self._joints[str(name)] = joints

    def take(self, event: DeviceEvent) -> None:
        """Learn from one event."""
        robot = str(event.payload.get("robot_name", ""))
        joints = event.payload.get("joints" if event.name == "observationUpdate" else "observation")
        if event.name in ("observationUpdate", "streamStep") and isinstance(joints, Mapping):
            self._joints[robot] = joints
        self.task = task_of(event) or self.task

    def draw(self) -> RenderableType:
        """The device, its task and its joints."""
        from rich.console import Group  # noqa: PLC0415 - Rich is loaded when something is shown

        from strands_robots.cli.bars import joints_table  # noqa: PLC0415

        parts: list[Any] = [label(f"{self.device}: {self.task}", "bold")]
        for robot, joints in self._joints.items():
            if len(self._joints) > 1:
                parts.append(label(robot))
            parts.append(joints_table(joints, self._limits))
        return Group(*parts)


def task_of(event: DeviceEvent) -> str:
    """What an event says of the device's task in a few words; empty where it says nothing."""
    said = event.payload
    if event.name in ("taskStarted", "policyStarted"):
        return f"started {said.get('instruction', '')!r} with {said.get('policy_provider', '')}"
    if event.name in ("taskComplete", "policyComplete"):
        return f"{said.get('state', 'completed')}: {said.get('instruction', '')!r} after {said.get('steps', '?')} steps"
    if event.name == "emergencyStop":
        return f"EMERGENCY STOP: {said.get('reason', '')}"
    if event.name != "stateUpdate":
        return ""
    running = said.get("running_policies")
    if isinstance(running, Mapping):
        rows = [_running(str(name), row) for name, row in running.items() if isinstance(row, Mapping)]
        return "; ".join(rows) or "idle"
    status = str(said.get("task_status", ""))
    return f"{status}: {said.get('instruction', '')!r}, step {said.get('step_count', 0)}" if status else ""


def _running(name: str, row: Mapping[str, Any]) -> str:
    return f"{name} does {row.get('instruction', '')!r}, step {row.get('step', '?')}"


def _limits(features: Mapping[str, Any]) -> dict[str, Range]:
    from strands_robots.cli.bars import ranges  # noqa: PLC0415 - Rich is loaded when something is shown

    return ranges(features)


def until(events: Iterator[DeviceEvent], longest: float | None, device: str) -> Iterator[DeviceEvent]:
    """Events until ``longest`` seconds are over. Raises :class:`Failure` when the device falls silent."""
    ends = None if longest is None else time.monotonic() + longest
    for event in events:
        yield event
        if ends is not None and time.monotonic() >= ends:
            return
    if ends is None or time.monotonic() < ends:
        raise Failure(f"{device} told nothing for {SILENCE_S:g} s.", Exit.SILENT)


def _first_view(fleet: FleetClient, device: str, limits: Mapping[str, Range]) -> View:
    """The device as it is now: an idle robot may tell no joints by itself."""
    view = View(device, limits)
    for question in ("getState", "getStatus"):
        with contextlib.suppress(Failure):  # a device answers one of the two
            view.look(asked(fleet, device, question, {}, 3.0))
    return view


def _live(screen: Screen, view: View, events: Iterator[DeviceEvent]) -> None:
    from rich.live import Live  # noqa: PLC0415 - Rich is loaded when something is shown

    with Live(view.draw(), console=screen.out, refresh_per_second=15) as live:
        for event in events:
            view.take(event)
            live.update(view.draw())


def in_lines(screen: Screen, events: Iterator[DeviceEvent]) -> None:
    last = ""
    for event in events:
        told = task_of(event)
        if told and told != last:
            screen.say(f"{event.device}: {told}")
            last = told
