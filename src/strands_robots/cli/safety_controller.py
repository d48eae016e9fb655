"""``safety-controller``: a full screen whose space bar stops every robot."""

from __future__ import annotations

import contextlib
import os
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from strands_robots.cli.command import OnMesh, command
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.lockout_report import LockoutReport
from strands_robots.cli.mesh_controller import MeshController
from strands_robots.cli.network import Network, mesh_peer
from strands_robots.cli.output import CliError, Exit, Screen, captured_log, label, table
from strands_robots.cli.resume import ask_robots, lockable_robots
from strands_robots.cli.stop_report import LATE_MS, SLOW_MS, outcome_lines, style_of, summary
from strands_robots.safety.answers import Answer
from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.lockout import utc
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster_search import RosterSearch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import StopOutcome, StopRoster
from strands_robots.tools.mesh_roster import stand_on_mesh
from strands_robots.utils import device_id, number

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

DRAW_S = 0.1
LOOK_S = 1.0
ASK_S = 1.0
ASKED_MOST = 32
"""Robots that are asked for their status at a look, if their beats say that they live: those asked longest ago."""

BEAT_FRESH_S = 3.0
"""Age of a beat up to which its robot is not asked out of turn."""

GONE_S = 5.0
"""A robot that was silent for this long is shown as gone; it must still answer a stop."""

Reports = Callable[[Collection[str], float], list[LockoutReport]]
"""Asks the robots in reach and those of these names, for at most so many seconds each."""

KEY_REPEAT_S = 1.0
"""Presses closer than this are one stop: a key held down repeats, and a robot distinguishes at most 64 stops."""


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
    if on_mesh:
        network.use_mesh()
        signer = None if key is None else signing_key(key, passphrase_file)
        with mesh_peer(None, source, "controller") as mesh:
            controls = MeshController(mesh, signer)
            fleet = FleetScreen(controls, controls.reports, every)
            with contextlib.closing(stand_on_mesh(mesh, signer, fleet.known)):
                if every is not None:
                    controls.check_in_every(every)
                _run(screen, controls, fleet, reason)
        screen.say(f"{source} is off. The robots it stopped stay locked.")
        return
    link = network.link()
    signer = None if key is None else signing_key(key, passphrase_file)
    from strands_robots.device_connect import safety_controller as network_side  # noqa: PLC0415 - loaded when it is used

    controller = network_side.safety_controller(
        source, link, signing_key=signer, require_signed=signer is not None, stands=True
    )
    with contextlib.closing(controller):
        fleet = FleetScreen(controller, link, every)
        with contextlib.closing(network_side.stand(controller, link, fleet.known)):
            if every is not None:
                controller.check_in_every(every)
            _run(screen, controller, fleet, reason)
    screen.say(f"{source} is off. The robots it stopped stay locked.")


def _run(screen: Screen, controller: SafetyController | MeshController, fleet: FleetScreen, reason: str) -> None:
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


class StopButton:
    """Emergency stop at each press, with the latest progress and report.

    A press during a running stop is part of it. A stop runs until it has left and every expected robot has answered:
    a link that swallows everything looks as if it were up for seconds.

    Args:
        controller: sends.
        expected: returns the robots that must answer; called at each press.
        reason: sent to the robots.
        scope: the robots that it is for.
    """

    def __init__(
        self,
        controller: SafetyController | MeshController,
        expected: Callable[[], Collection[str]],
        reason: str,
        scope: Scope = EVERY_ROBOT,
    ) -> None:
        self.progress: Progress | None = None
        self.report: StopReport | None = None
        self.outcome: StopOutcome | None = None
        """The report measured by the roster; None before the first, or where the network has no roster."""
        self._roster: StopRoster | None = None
        self._controller, self._expected, self._reason = controller, expected, reason
        self._scope = scope
        self._guard = threading.Lock()
        self._id, self._running, self._last = "", False, float("-inf")
        self._closing = threading.Event()

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        return self._running

    def press(self) -> None:
        """Stop everything; returns at once."""
        now = time.monotonic()
        with self._guard:
            repeated, self._last = now - self._last < KEY_REPEAT_S, now
            if repeated and self._running:
                return
            if not (repeated and self._id):
                self._id = new_epoch()
                self._controller.press(self._id)
            self._running = True
            threading.Thread(target=self._stop, args=(self._id,), name="space bar", daemon=True).start()

    def review(self) -> None:
        """Take what robots have said since the stop ended."""
        with self._guard:
            report, progress = self.report, self.progress
            if report is None or self._running:
                return
        later = self._controller.review(report)
        if later is report:
            return
        outcome = self._measured(self._roster, later)
        with self._guard:
            if report is self.report and not self._running:
                self.report, self.outcome = later, outcome
                if progress is not None:
                    self.progress = replace(progress, answered=later.answered)

    def close(self) -> None:
        """Give up a stop that waits for the link."""
        self._closing.set()

    def _stop(self, estop_id: str) -> None:
        network = self._controller.network
        search = None if network is None else RosterSearch(self._controller, estop_id, network, scope=self._scope)

        def note(progress: Progress) -> None:
            if estop_id == self._id:
                self.progress = progress
            if search is not None:
                search.begin(progress)

        recorded, scope = False, self._scope
        while True:
            expected = self._expected()
            options: dict[str, Any] = {} if search is None else {"more": not search.begun, "on_report": search.take}
            options |= {} if scope.everything else {"scope": scope}
            report = self._controller.stop(expected, self._reason, estop_id=estop_id, on_progress=note, **options)
            scope = EVERY_ROBOT if report.widened else scope
            roster = None if search is None else search.roster
            outcome = self._measured(roster, report)
            if outcome is not None and not recorded:
                recorded = True
                outcome.record(self._controller.controller_id)
            # The roster's rows that no screen shows have had their time: a robot that is back asks by itself.
            unfinished = not report.link or not {*expected}.isdisjoint(report.unanswered)
            with self._guard:
                if estop_id != self._id:
                    return
                self.outcome, self._roster = outcome, roster
                self.report, self._running = report, unfinished and not self._closing.is_set()
                if not self._running:
                    # A robot that was resumed meanwhile acts only on a stop with a new id.
                    self._id = "" if report.refused else self._id
                    return

    def _measured(self, roster: StopRoster | None, report: StopReport) -> StopOutcome | None:
        if roster is None:
            return None
        return roster.outcome(report, replace(self._controller.sending, left=report.link))


class StopButtons:
    """Stop button of all robots, and one for each robot or cell that was pressed.

    Each press of another one is a stop of its own, so that none waits for another or narrows it.

    Args:
        make: makes the button of a scope.
    """

    def __init__(self, make: Callable[[Scope], StopButton]) -> None:
        self._make = make
        self.latest = make(EVERY_ROBOT)
        """The button that was pressed last."""
        self._buttons = {EVERY_ROBOT: self.latest}

    def press(self, scope: Scope = EVERY_ROBOT) -> None:
        """Stop the robots of a scope; returns at once."""
        if scope not in self._buttons:
            self._buttons = {**self._buttons, scope: self._make(scope)}
        self.latest = self._buttons[scope]
        self.latest.press()

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        return any(each.running for each in self._buttons.values())

    def review(self) -> None:
        """Take what robots have said since the stops ended."""
        for each in self._buttons.values():
            each.review()

    def close(self) -> None:
        """Give up stops that wait for the link."""
        for each in self._buttons.values():
            each.close()


class FleetScreen:
    """Table of robots, polled on a thread and a connection of its own.

    Args:
        controller: whose link and id are shown.
        link: the network that is polled, or a function that polls it.
        check_in_s: seconds between the controller's check-ins, or None.
    """

    def __init__(
        self, controller: SafetyController | MeshController, link: LinkConfig | Reports, check_in_s: float | None
    ) -> None:
        self._controller, self._link, self._check_in_s = controller, link, check_in_s
        self._robots: dict[str, LockoutReport] = {}
        self._chosen = ""
        self._beats: dict[str, float] = {}
        self._asked: dict[str, float] = {}
        self._unanswered: set[str] = set()
        self._all_since = float("-inf")
        self._problem = "Looking for robots..."
        self._closed = threading.Event()

    def expected(self, scope: Scope = EVERY_ROBOT) -> Collection[str]:
        """Return the robots that must answer a stop: seen, in its scope, not forgotten.

        A robot that states no cell reads no scope, and stops whatever it is.
        """
        # A stop asks for them: what each reports of itself is read anew.
        self._all_since = time.monotonic()
        cells = {name: last.facts.get("cell") for name, last in self._robots.items()}
        return tuple(
            name for name, cell in cells.items() if not isinstance(cell, str) or scope.covers(name, {cell} - {""})
        )

    def choose(self, step: int) -> None:
        """Choose the next robot of the table, or the one before."""
        names = sorted(self._robots)
        if names:
            at = names.index(self._chosen) + step if self._chosen in names else min(step, 0)
            self._chosen = names[at % len(names)]

    def chosen_scope(self, *, cell: bool) -> Scope:
        """Return the scope of the chosen robot, or of its cell; every robot without one."""
        last = self._robots.get(self._chosen)
        if last is None:
            return EVERY_ROBOT
        return Scope.read({"cell": last.facts.get("cell")}) if cell else Scope.named([last.name])

    def known(self) -> Collection[str]:
        """Return the robots that were seen and not forgotten."""
        return tuple(self._robots)

    def forget(self) -> None:
        """Expect no answer any more from robots that are gone."""
        now = time.monotonic()
        self._robots = {name: last for name, last in self._robots.items() if now - self._seen_at(last) < GONE_S}

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Poll the robots for the length of the block."""
        thread = threading.Thread(target=self._poll, name="fleet screen", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._closed.set()
            thread.join(2 * ASK_S + 1.0)

    def _poll(self) -> None:
        if callable(self._link):
            while not self._closed.wait(LOOK_S):
                self.update(self._link(self._robots, ASK_S))
            return
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - the network is loaded when it is used

        from strands_robots.device_connect import FleetClient  # noqa: PLC0415

        while not self._closed.is_set():
            try:
                with FleetClient(self._link, self._controller.controller_id) as fleet:
                    while not self._closed.wait(LOOK_S):
                        names = {*lockable_robots(fleet, ASK_S), *self._robots}
                        self.take_beats({name: fleet.last_heartbeat(name) for name in names})
                        self.update(ask_robots(fleet, self.due(names), ASK_S))
            except (MessagingError, TimeoutError) as exc:
                self._problem = f"The robots cannot be polled: {exc}. The space bar has a connection of its own."
                self._closed.wait(LOOK_S)

    def take_beats(self, beats: Mapping[str, float | None]) -> None:
        """Take the monotonic times of the robots' last beats or heartbeats."""
        self._beats = {name: at for name, at in beats.items() if at is not None}

    def due(self, names: Collection[str]) -> list[str]:
        """Return the robots to ask now.

        All that are new, that have no fresh beat, or that were not asked since the last stop or the last change of a
        lockout; of the others those asked longest ago.
        """
        now, reports = time.monotonic(), self._robots
        asked = {name: self._asked.get(name, reports[name].at) for name in names if name in reports}
        calm = [
            name
            for name in names
            if name in reports
            and asked[name] > self._all_since + GONE_S
            and now - self._beats.get(name, float("-inf")) < BEAT_FRESH_S
        ]
        # By the question and not by the answer: those that no longer answer would take the turns of all others.
        in_turn = sorted(calm, key=lambda name: asked[name])[:ASKED_MOST]
        chosen = sorted({*names} - {*calm} | {*in_turn})
        self._asked = asked | dict.fromkeys(chosen, now)
        return chosen

    def _seen_at(self, last: LockoutReport) -> float:
        return max(last.at, self._beats.get(last.name, last.at))

    def update(self, reports: Sequence[LockoutReport]) -> None:
        """Take the robots' reports; a robot that did not answer keeps its last one."""
        robots = dict(self._robots)
        for each in reports:
            if each.problem:
                self._unanswered = {*self._unanswered, each.name}
                continue
            last = robots.get(each.name)
            if last is not None and _epochs(last) != _epochs(each):
                # Another controller stops or resumes robots: what the others reported may be old as well.
                self._all_since = time.monotonic()
            robots[each.name] = each
            self._unanswered = self._unanswered - {each.name}
        # The screen and the space bar may be reading the old dictionary, so it is replaced and not changed.
        self._robots = robots
        alarms = [f"{each.name}: {each.problem}." for each in reports if "ALARM" in each.problem]
        self._problem = " ".join(alarms) if robots or alarms else "No robot is on this network yet."

    def draw(self, button: StopButton, log: Collection[str]) -> RenderableType:
        """Return the whole screen."""
        up = self._controller.link_up
        head = f"{self._controller.controller_id}: the stop link is {'up' if up else 'DOWN'}"
        if self._check_in_s is not None:
            head += f"; checks in every {self._check_in_s:g} s"
        answers = button.progress.answered if button.progress is not None else {}
        columns = ("robot", "lockout", "since, by whom", "last stop", "status", "last seen", "check-in")
        robots = sorted(self._robots.items())
        silent = self._unanswered
        rows = (
            _row(name, last, self._seen_at(last), name in silent, answers.get(name), chosen=name == self._chosen)
            for name, last in robots
        )
        return Group(
            label(head, "bold green" if up else "bold white on red"),
            label("SPACE stops everything    f forgets robots that are gone    q quits", "bold"),
            label("j k choose a robot    o stops that one alone    c stops its cell, and robots without one"),
            table("", columns, rows),
            *([label(self._problem, "yellow")] if self._problem else []),
            _outcome(button),
            *(label(line, "red") for line in log),
        )


def _epochs(report: LockoutReport) -> set[str]:
    return {each.epoch for each in report.lockouts}


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
