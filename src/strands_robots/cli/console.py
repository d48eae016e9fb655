"""What the safety controller's screen shows: each robot, its lockout, its last answer and its check-in."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from strands_robots.cli import holds
from strands_robots.cli.estop import SLOW_MS, counts, verdict
from strands_robots.cli.holds import Standing
from strands_robots.cli.output import Exit, label, table
from strands_robots.safety.lockout import utc

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.text import Text

    from strands_robots.cli.button import Button
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.safety.controller import Answer, SafetyController

LOOK_S = 1.0
ASK_S = 1.0
GONE_S = 5.0
"""A robot that said nothing for this long is shown as gone, and still expected to answer a stop."""

COLUMNS = ("robot", "lockout", "since, by whom", "last stop", "status", "heard", "check-in")


@dataclass(frozen=True, slots=True)
class Seen:
    """A robot as it last stood, and when it last answered (monotonic seconds)."""

    standing: Standing
    at: float


class Board:
    """Looks at the fleet on a thread and a connection of its own, and draws what it knows.

    Args:
        controller: whose link and id are shown.
        link: the network that is looked at.
        check_in_s: how often the controller checks in, or None.
    """

    def __init__(self, controller: SafetyController, link: LinkConfig, check_in_s: float | None) -> None:
        self._controller, self._link, self._check_in_s = controller, link, check_in_s
        self._seen: dict[str, Seen] = {}
        self._problem = "Looking for robots..."
        self._ended = threading.Event()

    def expected(self) -> Collection[str]:
        """Who must answer a stop: every robot that was seen and not forgotten."""
        return tuple(self._seen)

    def forget(self) -> None:
        """Expect nothing more of robots that are gone."""
        now = time.monotonic()
        self._seen = {name: seen for name, seen in self._seen.items() if now - seen.at < GONE_S}

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Look at the fleet for the length of the block."""
        thread = threading.Thread(target=self._look, name="board", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._ended.set()
            thread.join(2 * ASK_S + 1.0)

    def _look(self) -> None:
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - the network is loaded when it is used

        from strands_robots.device_connect import FleetClient  # noqa: PLC0415

        while not self._ended.is_set():
            try:
                with FleetClient(self._link, self._controller.controller_id) as fleet:
                    while not self._ended.wait(LOOK_S):
                        names = {*holds.robots(fleet, ASK_S), *self._seen}
                        self.learn(holds.standing(fleet, sorted(names), ASK_S))
            except (MessagingError, TimeoutError) as exc:
                self._problem = f"The robots cannot be looked at: {exc}. The space bar has a connection of its own."
                self._ended.wait(LOOK_S)

    def learn(self, found: Sequence[Standing]) -> None:
        """Take what robots answered; one that did not keeps what it said before."""
        now, seen = time.monotonic(), dict(self._seen)
        for each in found:
            known = seen.get(each.name)
            if not each.problem:
                seen[each.name] = Seen(each, now)
            elif known is not None:
                seen[each.name] = replace(known, standing=replace(known.standing, problem=each.problem))
        # A new one each time: the screen and the space bar read the old one meanwhile.
        self._seen = seen
        self._problem = "" if self._seen else "Nobody is on this network yet."

    def draw(self, button: Button, log: Collection[str]) -> RenderableType:
        """The whole screen."""
        from rich.console import Group  # noqa: PLC0415 - Rich is loaded when something is shown

        up = self._controller.link_up
        head = f"{self._controller.controller_id}: the stop link is {'up' if up else 'DOWN'}"
        if self._check_in_s is not None:
            head += f"; checks in every {self._check_in_s:g} s"
        parts: list[Any] = [label(head, "bold green" if up else "bold white on red")]
        parts.append(label("SPACE stops everything    f forgets robots that are gone    q quits", "bold"))
        answers = button.progress.answered if button.progress is not None else {}
        seen = sorted(self._seen.items())
        parts.append(table("", COLUMNS, (_row(name, each, answers.get(name)) for name, each in seen)))
        if self._problem:
            parts.append(label(self._problem, "yellow"))
        parts.append(_outcome(button))
        parts += [label(line, "red") for line in log]
        return Group(*parts)


def _row(name: str, seen: Seen, answer: Answer | None) -> tuple[Any, ...]:
    age, held, trip_ms = time.monotonic() - seen.at, seen.standing.holds, seen.standing.round_trip_ms
    locked = f"LOCKED x{len(held)}" if len(held) > 1 else "LOCKED"
    return (
        name,
        label(locked, "bold red") if held else label("free"),
        f"{utc(held[0].at)} {held[0].source} {held[0].reason}" if held else "",
        _stop_cell(answer),
        label(f"{trip_ms:.1f} ms", "red" if trip_ms > SLOW_MS else ""),
        label(f"{age:.0f} s ago" if age < GONE_S else f"GONE, {age:.0f} s", "" if age < GONE_S else "bold red"),
        _check_in_cell(seen.standing.facts.get("check_in")),
    )


def _stop_cell(answer: Answer | None) -> Text | str:
    if answer is None:
        return ""
    if answer.stopped:
        slow = answer.latency_ms > SLOW_MS
        return label(f"stopped in {answer.latency_ms:.1f} ms", "bold red" if slow else "green")
    return label("DID NOT STOP" if answer.stopped is False else "NOBODY KNOWS", "bold red")


def _check_in_cell(told: object) -> Text | str:
    if not isinstance(told, Mapping) or told.get("required") is not True:
        return "not needed"
    left = told.get("time_left_s")
    seconds = float(left) if isinstance(left, int | float) else 0.0
    return label(f"{seconds:.1f} s left", "" if seconds > 0 else "bold red")


def _outcome(button: Button) -> Text:
    if button.running and button.progress is not None:
        silent = button.progress.unconfirmed
        waiting = f"; unconfirmed: {', '.join(silent)}" if silent else ""
        link = "" if button.progress.link_up else "; THE LINK IS DOWN, it leaves when that is back"
        return label(f"STOPPING: {len(button.progress.answered)} answered{waiting}{link}", "bold red")
    if button.report is None:
        return label("")
    report = button.report
    silent_names = f" No answer: {', '.join(report.silent)}." if report.silent else ""
    return label(f"{counts(report)}{silent_names}", "green" if verdict(report) is Exit.OK else "bold red")
