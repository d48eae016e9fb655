"""``safety-controller``: a full screen whose space bar stops every robot."""

from __future__ import annotations

import contextlib
import os
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen, captured_log, label, table
from strands_robots.cli.stop import LATE_MS, SLOW_MS, outcome_lines, style_of, summary
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.fleet.safety_console import BEAT_FRESH_S, GONE_S, SafetyConsole, StopButton
from strands_robots.safety.answers import Answer
from strands_robots.safety.lockout import utc
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.utils import device_id, number

DRAW_S = 0.1
COLUMNS = ("lockout", "since, by whom", "last stop", "status", "last seen", "check-in")


def safety_controller(
    screen: Screen,
    network: Network,
    *,
    source: Annotated[str, typer.Option("--id", help="The source that robots see.")] = "safety-1",
    check_in: Annotated[
        float | None, typer.Option("--check-in", help="Seconds between check-ins; robots may need them to move.")
    ] = None,
    reason: Annotated[
        str, typer.Option("--reason", help="Sent to the robots and written to their audit.")
    ] = "space bar",
    key: Annotated[Path | None, typer.Option("--key", help="Sign stops and check-ins with it.")] = None,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Stop every robot on every network at once with the SPACE bar.

    The screen shows each robot, its lockout, answers and check-in.
    """
    if not (screen.live and sys.stdin.isatty()):
        raise CliError(
            "safety-controller needs a terminal, for its keys and its screen; in a script use strands-robots estop.",
            Exit.USAGE,
        )
    source = device_id("--id", source)
    every = None if check_in is None else number("--check-in", check_in, low=0.02, high=60)
    networks = network.networks(source=source, stays=True, console=True)
    signer = None if key is None else signing_key(key, passphrase_file)
    with contextlib.closing(SafetyConsole(networks, signer, reason, every)) as console:
        _run(console, ConsoleScreen(console, source, every), screen)
    screen.say(f"{source} is off. The robots it stopped stay locked.")


def _run(console: SafetyConsole, robots: ConsoleScreen, screen: Screen) -> None:
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    done = threading.Event()

    def pressed(key: str) -> None:
        if key == " ":
            console.press()
        elif key in "jk":
            robots.choose(1 if key == "j" else -1)
        elif key in "oc":
            console.press(robots.chosen_scope(cell=key == "c"))
        elif key in "qQ":
            done.set()
        elif key in "fF":
            console.forget()

    with captured_log() as lines, _keys(pressed, done.set):
        # The keys count from now on, whatever the networks do.
        console.open()
        with Live(robots.draw(lines), console=screen.out, screen=True, auto_refresh=False) as live:
            while not done.wait(DRAW_S):
                console.buttons.review()
                live.update(robots.draw(lines), refresh=True)


@contextmanager
def _keys(pressed: Callable[[str], None], closed: Callable[[], None]) -> Iterator[None]:
    """Call ``pressed`` with each key of the terminal, on a thread of its own.

    Ctrl-C stays a signal. The terminal's modes are restored when the block is left.
    """
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def read() -> None:
        # A terminal that hangs up answers with an error, or with nothing.
        with contextlib.suppress(OSError):
            while data := os.read(terminal, 64):
                for key in data.decode("utf-8", "replace"):
                    pressed(key)
        closed()

    tty.setcbreak(terminal, termios.TCSANOW)
    threading.Thread(target=read, name="keys", daemon=True).start()
    try:
        yield
    finally:
        # A terminal that is gone has no modes to restore.
        with contextlib.suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)


class ConsoleScreen:
    """Table of the robots that a console watches, with one that is chosen.

    Args:
        console: whose robots and links are shown.
        source: its name.
        check_in_s: seconds between its check-ins, or None.
    """

    def __init__(self, console: SafetyConsole, source: str, check_in_s: float | None) -> None:
        self._console, self._source, self._check_in_s = console, source, check_in_s
        self._chosen = ("", "")

    def choose(self, step: int) -> None:
        """Choose the next robot of the table, or the one before."""
        robots = sorted(self._reports())
        if robots:
            at = robots.index(self._chosen) + step if self._chosen in robots else min(step, 0)
            self._chosen = robots[at % len(robots)]

    def chosen_scope(self, *, cell: bool) -> Scope:
        """Return the scope of the chosen robot, or of its cell; every robot without one."""
        last = self._reports().get(self._chosen)
        if last is None:
            return EVERY_ROBOT
        return Scope.read({"cell": last.facts.get("cell")}) if cell else Scope.named([last.name])

    def draw(self, log: Collection[str]) -> RenderableType:
        """Return the whole screen."""
        console, links = self._console, self._console.links
        head = f"{self._source}: the stop link is {_link_state(links)}"
        if self._check_in_s is not None:
            head += f"; checks in every {self._check_in_s:g} s"
        reports = self._reports()
        several = len({network for _, network in reports}) > 1
        columns = ("robot", *(["network"] if several else []), *COLUMNS)
        rows = [
            (first, *([network] if several else []), *others)
            for (name, network), last in sorted(reports.items())
            for first, *others in [self._row(name, network, last)]
        ]
        up = bool(links) and all(links.values())
        said = [f"{name}: {why}" for name, why in console.absent.items() if name in links]
        said += [each.problem for each in console.watched.values() if each.problem]
        said += [] if rows or said else ["No robot is on the network yet."]
        return Group(
            label(head, "bold green" if up else "bold white on red"),
            label("SPACE stops everything    f forgets robots that are gone    q quits", "bold"),
            label("j k choose a robot    o stops that one alone    c stops its cell, and robots without one"),
            # Above the table: a terminal cuts off what is below many robots.
            *_outcomes(console.buttons.latest, links),
            *(label(each, "yellow") for each in said),
            table("", columns, rows),
            *(label(line, "red") for line in log),
        )

    def _reports(self) -> dict[tuple[str, str], LockoutReport]:
        """Return the last report of each robot, by its name and its network."""
        watched = self._console.watched.items()
        return {(name, network): last for network, each in watched for name, last in each.reports.items()}

    def _row(self, name: str, network: str, last: LockoutReport) -> tuple[Any, ...]:
        watched, button = self._console.watched[network], self._console.buttons.latest.get(network)
        answers = button.progress.answered if button is not None and button.progress is not None else {}
        chosen = (name, network) == self._chosen
        now, lockouts, trip_ms = time.monotonic(), last.lockouts, last.round_trip_ms
        age, report_age = now - watched.seen_at(last), now - last.at
        locked = f"LOCKED x{len(lockouts)}" if len(lockouts) > 1 else "LOCKED"
        old = f", {report_age:.0f} s ago" if report_age > BEAT_FRESH_S else ""
        seen = f"GONE, {age:.0f} s"
        if age < GONE_S:
            silent = name in watched.unanswered and old
            seen = f"beats, NO ANSWER for {report_age:.0f} s" if silent else f"{age:.0f} s ago"
        cell = last.facts.get("cell")
        place = f", {cell}" if isinstance(cell, str) and cell else "" if isinstance(cell, str) else ", stops always"
        scope = f" for {lockouts[0].scope}" if lockouts and not lockouts[0].scope.everything else ""
        return (
            label(f"{'> ' if chosen else ''}{name}{place}", "reverse" if chosen else ""),
            label(locked + old, "bold red") if lockouts else label("free" + old),
            f"{utc(lockouts[0].at)} {lockouts[0].source}{scope} {lockouts[0].reason}" if lockouts else "",
            _stop_cell(answers.get(name)),
            label(f"{trip_ms:.1f} ms", "red" if trip_ms > SLOW_MS else ""),
            label(seen, "" if seen.endswith("ago") else "bold red"),
            _check_in_cell(last.facts.get("check_in")),
        )


def _link_state(links: Mapping[str, bool]) -> str:
    states = {name: "up" if up else "DOWN" for name, up in links.items()}
    if len(states) < 2:
        return next(iter(states.values()), "DOWN")
    return ", ".join(f"{state} on {name}" for name, state in states.items())


def _stop_cell(answer: Answer | None) -> Text | str:
    if answer is None:
        return ""
    if answer.stopped and answer.claimed:
        return label("claimed to have stopped; not signed", "yellow")
    if answer.stopped:
        if answer.latency_ms > LATE_MS:
            return label(f"stopped {answer.latency_ms / 1000:.1f} s after the press", "bold red")
        slow = answer.latency_ms > SLOW_MS
        return label(f"stopped in {answer.latency_ms:.1f} ms", "bold red" if slow else "green")
    return label("DID NOT STOP" if answer.stopped is False else "UNKNOWN", "bold red")


def _check_in_cell(state: object) -> Text | str:
    if not isinstance(state, Mapping) or state.get("required") is not True:
        return "not needed"
    left = state.get("time_left_s")
    seconds = float(left) if isinstance(left, int | float) else 0.0
    return label(f"{seconds:.1f} s left", "" if seconds > 0 else "bold red")


def _outcomes(buttons: Mapping[str, StopButton], links: Mapping[str, bool]) -> list[Text]:
    """Return what came of the latest press on each network that has a link or robots."""
    shown = {
        name: each
        for name, each in buttons.items()
        if name in links or (each.outcome is not None and each.outcome.size)
    }
    return [line for name, each in shown.items() for line in _outcome(each, f"On {name}: " if len(shown) > 1 else "")]


def _outcome(button: StopButton, where: str) -> list[Text]:
    if button.running and button.progress is not None:
        silent = button.progress.unconfirmed
        waiting = f"; unconfirmed: {', '.join(silent)}" if silent else ""
        link = "" if button.progress.link_up else "; THE LINK IS DOWN, the stop leaves when it is back"
        elapsed = button.progress.elapsed_ms
        age = f", pressed {elapsed / 1000:.1f} s ago" if elapsed > LATE_MS else ""
        return [label(f"{where}STOPPING{age}: {len(button.progress.answered)} answered{waiting}{link}", "bold red")]
    if button.report is None:
        return []
    outcome = button.outcome
    report = button.report if outcome is None else outcome.report
    reasons = {} if outcome is None else outcome.reasons
    missing = [f"{name}{f' ({reasons[name]})' if name in reasons else ''}" for name in report.silent]
    silent_names = f" No answer: {', '.join(missing)}." if missing else ""
    alarms = " ".join(f" ALARM: {name}: {why}." for name, why in report.alarms.items())
    lines = [f"{where}{summary(report)}{silent_names}{alarms}"]
    lines += [] if outcome is None else [" ".join([outcome.sentence, *outcome_lines(outcome)])]
    doubtful = alarms or (outcome is not None and outcome.problems)
    return [label(line, "bold red" if doubtful else style_of(report)) for line in lines]
