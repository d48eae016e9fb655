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

from strands_robots.cli.command import OnMesh, command
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.network import Network, mesh_peer
from strands_robots.cli.output import CliError, Exit, Screen, captured_log, label, table
from strands_robots.cli.stop_report import LATE_MS, SLOW_MS, outcome_lines, style_of, summary
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.lockout_report import LockoutReport
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.stop_button import StopButton, StopButtons, StopSender
from strands_robots.fleet.watched_robots import BEAT_FRESH_S, GONE_S, Join, WatchedRobots
from strands_robots.safety.answers import Answer
from strands_robots.safety.lockout import utc
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.utils import device_id, number

DRAW_S = 0.1


def register(app: typer.Typer) -> None:
    """Add ``safety-controller`` to the application."""
    command(app, "safety-controller", network=True)(safety_controller)


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
    on_mesh: OnMesh = False,
) -> None:
    """Stop every robot at once with the SPACE bar; show each robot, its lockout, answers and check-in."""
    if not (screen.live and sys.stdin.isatty()):
        raise CliError(
            "safety-controller needs a terminal, for its keys and its screen; in a script use strands-robots estop.",
            Exit.USAGE,
        )
    source = device_id("--id", source)
    every = None if check_in is None else number("--check-in", check_in, low=0.02, high=60)
    with contextlib.ExitStack() as stack:
        if on_mesh:
            network.use_mesh()
            signer = None if key is None else signing_key(key, passphrase_file)
            there: NetworkAdapter = MeshNetwork.joined(stack.enter_context(mesh_peer(None, source, "controller")))
            join = lambda: there  # noqa: E731 - the one peer has this id
        else:
            link = network.link()
            signer = None if key is None else signing_key(key, passphrase_file)
            there, join = DeviceConnectNetwork(link, source), lambda: _opened(DeviceConnectNetwork(link, source))
        watched: list[FleetScreen] = []
        known = lambda: watched[0].known() if watched else ()  # noqa: E731 - asked later, on another thread
        controller = stack.enter_context(there.standing(signer, known))
        watched.append(FleetScreen(controller, join, every))
        if every is not None:
            controller.check_in_every(every)
        _run(screen, controller, watched[0], reason)
    screen.say(f"{source} is off. The robots it stopped stay locked.")


def _opened(network: NetworkAdapter) -> NetworkAdapter:
    network.open()
    return network


def _run(screen: Screen, controller: StopSender, fleet: FleetScreen, reason: str) -> None:
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    done = threading.Event()
    buttons = StopButtons(lambda scope: StopButton(controller, lambda: fleet.expected(scope), reason, scope))

    def pressed(key: str) -> None:
        if key == " ":
            buttons.press()
        elif key in "jk":
            fleet.choose(1 if key == "j" else -1)
        elif key in "oc":
            buttons.press(fleet.chosen_scope(cell=key == "c"))
        elif key in "qQ":
            done.set()
        elif key in "fF":
            fleet.forget()

    with captured_log() as lines, fleet.polling(), _keys(pressed, done.set):
        try:
            with Live(fleet.draw(buttons.latest, lines), console=screen.out, screen=True, auto_refresh=False) as live:
                while not done.wait(DRAW_S):
                    buttons.review()
                    live.update(fleet.draw(buttons.latest, lines), refresh=True)
        finally:
            buttons.close()


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


class FleetScreen(WatchedRobots):
    """Table of the watched robots, with one that is chosen.

    Args:
        controller: whose link and id are shown.
        join: joins the network that is polled.
        check_in_s: seconds between the controller's check-ins, or None.
    """

    def __init__(self, controller: StopSender, join: Join, check_in_s: float | None) -> None:
        super().__init__(join)
        self._controller, self._check_in_s = controller, check_in_s
        self._chosen = ""

    def choose(self, step: int) -> None:
        """Choose the next robot of the table, or the one before."""
        names = sorted(self.reports)
        if names:
            at = names.index(self._chosen) + step if self._chosen in names else min(step, 0)
            self._chosen = names[at % len(names)]

    def chosen_scope(self, *, cell: bool) -> Scope:
        """Return the scope of the chosen robot, or of its cell; every robot without one."""
        last = self.reports.get(self._chosen)
        if last is None:
            return EVERY_ROBOT
        return Scope.read({"cell": last.facts.get("cell")}) if cell else Scope.named([last.name])

    def draw(self, button: StopButton, log: Collection[str]) -> RenderableType:
        """Return the whole screen."""
        up = self._controller.link_up
        head = f"{self._controller.controller_id}: the stop link is {'up' if up else 'DOWN'}"
        if self._check_in_s is not None:
            head += f"; checks in every {self._check_in_s:g} s"
        answers = button.progress.answered if button.progress is not None else {}
        columns = ("robot", "lockout", "since, by whom", "last stop", "status", "last seen", "check-in")
        robots = sorted(self.reports.items())
        silent = self.unanswered
        rows = (
            _row(name, last, self.seen_at(last), name in silent, answers.get(name), chosen=name == self._chosen)
            for name, last in robots
        )
        return Group(
            label(head, "bold green" if up else "bold white on red"),
            label("SPACE stops everything    f forgets robots that are gone    q quits", "bold"),
            label("j k choose a robot    o stops that one alone    c stops its cell, and robots without one"),
            table("", columns, rows),
            *([label(self.problem, "yellow")] if self.problem else []),
            _outcome(button),
            *(label(line, "red") for line in log),
        )


def _row(
    name: str, last: LockoutReport, seen_at: float, unanswered: bool, answer: Answer | None, *, chosen: bool = False
) -> tuple[Any, ...]:
    now, lockouts, trip_ms = time.monotonic(), last.lockouts, last.round_trip_ms
    age, report_age = now - seen_at, now - last.at
    locked = f"LOCKED x{len(lockouts)}" if len(lockouts) > 1 else "LOCKED"
    old = f", {report_age:.0f} s ago" if report_age > BEAT_FRESH_S else ""
    seen = f"GONE, {age:.0f} s"
    if age < GONE_S:
        seen = f"beats, NO ANSWER for {report_age:.0f} s" if unanswered and old else f"{age:.0f} s ago"
    cell = last.facts.get("cell")
    place = f", {cell}" if isinstance(cell, str) and cell else "" if isinstance(cell, str) else ", stops always"
    scope = f" for {lockouts[0].scope}" if lockouts and not lockouts[0].scope.everything else ""
    return (
        label(f"{'> ' if chosen else ''}{name}{place}", "reverse" if chosen else ""),
        label(locked + old, "bold red") if lockouts else label("free" + old),
        f"{utc(lockouts[0].at)} {lockouts[0].source}{scope} {lockouts[0].reason}" if lockouts else "",
        _stop_cell(answer),
        label(f"{trip_ms:.1f} ms", "red" if trip_ms > SLOW_MS else ""),
        label(seen, "" if seen.endswith("ago") else "bold red"),
        _check_in_cell(last.facts.get("check_in")),
    )


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


def _outcome(button: StopButton) -> Text:
    if button.running and button.progress is not None:
        silent = button.progress.unconfirmed
        waiting = f"; unconfirmed: {', '.join(silent)}" if silent else ""
        link = "" if button.progress.link_up else "; THE LINK IS DOWN, the stop leaves when it is back"
        elapsed = button.progress.elapsed_ms
        age = f", pressed {elapsed / 1000:.1f} s ago" if elapsed > LATE_MS else ""
        return label(f"STOPPING{age}: {len(button.progress.answered)} answered{waiting}{link}", "bold red")
    if button.report is None:
        return label("")
    outcome = button.outcome
    report = button.report if outcome is None else outcome.report
    reasons = {} if outcome is None else outcome.reasons
    missing = [f"{name}{f' ({reasons[name]})' if name in reasons else ''}" for name in report.silent]
    silent_names = f" No answer: {', '.join(missing)}." if missing else ""
    alarms = " ".join(f" ALARM: {name}: {why}." for name, why in report.alarms.items())
    told = "" if outcome is None else f"\n{' '.join([outcome.sentence, *outcome_lines(outcome)])}"
    doubtful = alarms or (outcome is not None and outcome.problems)
    return label(f"{summary(report)}{silent_names}{alarms}{told}", "bold red" if doubtful else style_of(report))
