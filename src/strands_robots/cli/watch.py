"""``watch DEVICE``: its joints as bars between their limits, and its task, live."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from strands_robots.cli.app import Seconds
from strands_robots.cli.network import Network, answering
from strands_robots.cli.output import LATE_S, CliError, Exit, Screen, label, plain
from strands_robots.envelope import is_error
from strands_robots.errors import NoSuchRobotError, RefusalError
from strands_robots.fleet.adapter import MISSED_BEATS, Detail
from strands_robots.fleet.reports import Range, is_finite, joint_limits
from strands_robots.utils import number

if TYPE_CHECKING:
    from strands_robots.fleet.adapter import NetworkAdapter, RobotEvent

READ_S = 3.0
"""Seconds in which the device answers a read."""

REDRAW_S = 0.07
"""Seconds between two redraws."""

FIRST_SIGN_S = 6.0
"""Seconds in which any live device has sent a first heartbeat."""

EVENTS_MAX = 10_000
"""Events that wait for the screen; a further one displaces the oldest."""

BAR_WIDTH = 32
NAME_WIDTH = 18
"""Characters of one bar, and of a joint's name."""

JOINTS_MAX = 24
"""Joints that are drawn; the rest is counted."""

NO_JOINTS = "It reports no joints: it has none, or sends them only while it moves."

Frame = tuple[list["RobotEvent"], float]
FULL_TURN: Range = (-math.pi, math.pi)
"""Range of the bar of a joint without limits, in radians."""


def watch(
    screen: Screen,
    network: Network,
    device: Annotated[str, typer.Argument(help="The device's id.")],
    seconds: Seconds = None,
) -> None:
    """Show a device's joints and task as they change, until Ctrl-C. With --json: one event a line."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=7 * 24 * 3600)
    with network.joined() as networks:
        with answering(networks, device, ""):
            there = networks.of(device)
            limits = _limits(there, device)
        signs = SignsOfLife(lambda: there.beats([device])[device], lambda: there.beats_every(device))
        with contextlib.ExitStack() as stack:
            stack.callback(there.subscribe(device, signs.take, Detail.STATES))
            frames = follow(signs, longest, device)
            if screen.machine:
                for function, answer in _present_answers(there, device):
                    screen.data({"device": device, "event": function, "payload": answer})
                for events, _ in frames:
                    for event in events:
                        screen.data({"device": event.robot, "event": event.name, "payload": dict(event.payload)})
            elif screen.live:
                _draw_live(screen, _present_state(there, device, limits), frames)
            else:
                now = _present_state(there, device, limits)
                print_changes(screen, device, now.summary, (event for events, _ in frames for event in events))


class SignsOfLife:
    """Events of one device as they arrive, and the age of its last sign of life.

    Args:
        last_heartbeat: returns the time of its last heartbeat, or beat that named it, in monotonic seconds, or None.
        beats_every: returns the seconds between two of those.
    """

    def __init__(
        self,
        last_heartbeat: Callable[[], float | None] = lambda: None,
        beats_every: Callable[[], float] = lambda: 5.0,
    ) -> None:
        self._last_heartbeat = last_heartbeat
        self._beats_every = beats_every
        self._events: deque[RobotEvent] = deque(maxlen=EVENTS_MAX)
        self._began = time.monotonic()
        self._event_at: float | None = None

    def take(self, event: RobotEvent) -> None:
        """Keep an event; on the client's thread."""
        self._event_at = time.monotonic()
        self._events.append(event)

    def drain(self) -> list[RobotEvent]:
        """Return the events that have arrived since the last time."""
        return [self._events.popleft() for _ in range(len(self._events))]

    @property
    def age_s(self) -> float:
        """Seconds since the last event or heartbeat, or since the start."""
        signs = (self._began, self._event_at, self._last_heartbeat())
        return time.monotonic() - max(each for each in signs if each is not None)

    @property
    def silent(self) -> bool:
        """True when three beats in a row are missing."""
        if self._event_at is None and self._last_heartbeat() is None:
            return self.age_s > FIRST_SIGN_S
        return self.age_s > MISSED_BEATS * self._beats_every()


class DeviceView:
    """Last known joints and task of one device."""

    def __init__(self, device: str, limits: Mapping[str, Range]) -> None:
        self.device = device
        self._limits = limits
        self._joints: dict[str, Mapping[str, Any]] = {}
        self.task = "idle"
        self.no_joints = NO_JOINTS

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Update from an answer to getState or getStatus."""
        self.task = describe_state(state) or self.task
        if state.get("unavailable"):
            self.task, self.no_joints = "unavailable", plain(str(state["unavailable"]), 200)
        robots = state.get("robots")
        if isinstance(state.get("joints"), Mapping):
            self._joints[""] = state["joints"]
        for name, joints in robots.items() if isinstance(robots, Mapping) else ():
            if isinstance(joints, Mapping):
                self._joints[str(name)] = joints

    def take(self, event: RobotEvent) -> None:
        """Update from one event."""
        if event.joints is not None:
            self._joints[event.part] = event.joints
        self.task = describe_task(event) or self.task

    @property
    def summary(self) -> str:
        """The task, and why there are no joints where there are none."""
        return self.task if self._joints else f"{self.task}. {self.no_joints}"

    def draw(self, age_s: float = 0.0) -> RenderableType:
        """Return the device, its task, the age of its last sign of life, and its joints."""
        late = "bold red" if age_s > LATE_S else "bright_black"
        parts: list[Any] = [
            label(f"{self.device}: {self.task}", "bold"),
            label(f"last heard {age_s:.1f} s ago", late),
        ]
        if not self._joints:
            parts.append(label(self.no_joints, "bright_black"))
        for robot, joints in self._joints.items():
            if len(self._joints) > 1:
                parts.append(label(robot))
            parts.append(joints_table(joints, self._limits))
        return Group(*parts)


def describe_task(event: RobotEvent) -> str:
    """Return the task that an event reports, or an empty text."""
    facts = event.payload
    if event.name in ("taskStarted", "policyStarted"):
        return f"started {facts.get('instruction', '')!r} with {facts.get('policy_provider', '')}"
    if event.name in ("taskComplete", "policyComplete"):
        state, steps = facts.get("state", "completed"), facts.get("steps", "?")
        return f"{state}: {facts.get('instruction', '')!r} after {steps} steps"
    if event.name == "emergencyStop":
        return f"EMERGENCY STOP: {facts.get('reason', '')}"
    if facts.get("event") == "emergency_stop":
        return "EMERGENCY STOP"
    if event.task is None or event.name == "stateUpdate":
        return describe_state(facts) if event.name == "stateUpdate" else ""
    task = event.task
    return describe_state({**task, "task_status": task["state"], "step_count": task.get("step", 0)})


def describe_state(facts: Mapping[str, Any]) -> str:
    """Return the task in a ``stateUpdate`` or an answer to getStatus, or ""."""
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        tasks = [
            f"{name} does {row.get('instruction', '')!r}, step {row.get('step', '?')}"
            for name, row in running.items()
            if isinstance(row, Mapping)
        ]
        return "; ".join(tasks) or "idle"
    status = str(facts.get("task_status", ""))
    if not status or not facts.get("instruction"):
        return status
    return f"{status}: {facts['instruction']!r}, step {facts.get('step_count', 0)}"


def follow(signs: SignsOfLife, longest: float | None, device: str) -> Iterator[Frame]:
    """Yield the new events and the age of the last sign of life, once a redraw.

    Raises:
        CliError: the device is silent.
    """
    ends = math.inf if longest is None else time.monotonic() + longest
    while time.monotonic() < ends:
        # All at once: a screen that drew each of them would fall behind a device that sends many.
        events = signs.drain()
        yield events, signs.age_s
        if signs.silent:
            raise CliError(f"{device} is silent: its last sign of life came {signs.age_s:.1f} s ago.", Exit.SILENT)
        time.sleep(min(REDRAW_S, max(0.0, ends - time.monotonic())))


def print_changes(screen: Screen, device: str, now: str, events: Iterator[RobotEvent]) -> None:
    """Print the present task, and one line for each change of it."""
    screen.say(f"{device}: {now}")
    last = now
    for event in events:
        task = describe_task(event)
        if task and task != last:
            screen.say(f"{event.robot}: {task}")
            last = task


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
    grid = Table.grid(padding=(0, 2))
    grid.add_column(width=NAME_WIDTH, no_wrap=True, overflow="ellipsis")
    grid.add_column(no_wrap=True)
    grid.add_column(justify="right", no_wrap=True)
    drawn = {str(name): float(value) for name, value in joints.items() if is_finite(value)}
    for name, value in list(drawn.items())[:JOINTS_MAX]:
        around = limits.get(name) or (min(FULL_TURN[0], value), max(FULL_TURN[1], value))
        grid.add_row(label(name), joint_bar(value, around), Text(f"{value:+.3f}"))
    if len(drawn) > JOINTS_MAX:
        grid.add_row(Text(f"and {len(drawn) - JOINTS_MAX} more", style="bright_black"), "", "")
    return grid


def _present_state(there: NetworkAdapter, device: str, limits: Mapping[str, Range]) -> DeviceView:
    """Return a view of the device now; an idle robot may send no joints."""
    view = DeviceView(device, limits)
    for _, answer in _present_answers(there, device):
        view.take_state(answer)
    return view


def _present_answers(there: NetworkAdapter, device: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield its present state by function; an idle one sends none for 10 s."""
    for function in (there.reads["state"], there.reads["status"]):
        with contextlib.suppress(RefusalError):  # a device answers one of the two
            answer = there.call(device, function, {}, READ_S)
            if not is_error(answer):
                yield function, answer


def _limits(there: NetworkAdapter, device: str) -> dict[str, Range]:
    """Return the limits of its joints; a device that states none is drawn without.

    Raises:
        NoSuchRobotError: it is not in reach.
    """
    try:
        return joint_limits(there.call(device, there.reads["features"], {}, READ_S))
    except NoSuchRobotError:
        raise
    except RefusalError:
        return {}


def _draw_live(screen: Screen, view: DeviceView, frames: Iterator[Frame]) -> None:
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    with Live(view.draw(), console=screen.out, auto_refresh=False) as live:
        for events, age in frames:
            for event in events:
                view.take(event)
            live.update(view.draw(age), refresh=True)
