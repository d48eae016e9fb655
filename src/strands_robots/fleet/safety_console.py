"""Safety controllers of a program on every network, and an operator's console."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import LockoutReport, NetworkAdapter, StopSender
from strands_robots.fleet.networks import Networks
from strands_robots.safety.answers import Progress, StopReport
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import RosterSearch, StopOutcome, StopRoster
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)


CLOSE_S = 5.0
AGAIN_S, AGAIN_MAX_S = 1.0, 30.0
"""Seconds until a link that could not be opened is tried again: the first time, and at most."""

OPENING, DOWN = "its e-stop link is being opened", "its e-stop link is down"

OnStanding = Callable[[NetworkAdapter, StopSender], None]
"""Takes a network with its controller, on the thread that has opened it."""


class StandingController:
    """Safety controller of a program, on each of its networks.

    It reports whom it misses when others stop robots.

    On each network a thread opens the link, again and again until that succeeds, and closes it.

    Args:
        source: the program's name.
        networks: its networks.
        signing_key: signs stops and check-ins, or None.
        known: returns the robots that a network's name shows besides its roster.
        on_standing: told of each controller.
        waits: return from :meth:`open`, and from the joining of a network, once its link was tried.

    Attributes:
        senders: the controllers by network.
        failures: by network, what opening its link raised.
    """

    def __init__(
        self,
        source: str,
        networks: Networks,
        signing_key: Any = None,
        known: Callable[[str], Collection[str]] = lambda network: (),
        on_standing: OnStanding = lambda network, sender: None,
        *,
        waits: bool = False,
    ) -> None:
        self._source, self._networks, self._signing_key = source, networks, signing_key
        self._known, self._on_standing, self._waits = known, on_standing, waits
        self._closing, self._lock = threading.Event(), threading.Lock()
        self._threads: dict[str, threading.Thread] = {}
        self.senders: Mapping[str, StopSender] = {}
        self.failures: Mapping[str, Exception] = {}

    @property
    def problem(self) -> str:
        """Empty while it stands on each network, else the reasons why it does not."""
        absent, missing = self._networks.absent, self._networks.missing
        # A network that no one asked for need not be there.
        named = [each.name for each in self._networks.stated if each.name in missing or each.name not in absent]
        why = {name: self._problem_on(name) for name in named}
        return "; ".join(f"{name}: {problem}" for name, problem in why.items() if problem)

    def open(self) -> None:
        """Begin to open the links.

        Where stops have a connection of their own that is now, else once a network is joined.
        """
        for each in self._networks.stated:
            if self._waits and each.has_stop_link:
                self.stand(each)
        self._networks.on_joined(self.stand)

    def close(self) -> None:
        """Close the links."""
        with self._lock:
            self._closing.set()
            threads = list(self._threads.values())
        for each in threads:
            each.join(CLOSE_S)

    def stand(self, network: NetworkAdapter) -> None:
        """Begin to open the link of one network, where that has not begun."""
        tried = threading.Event()
        with self._lock:
            if network.name in self._threads or self._closing.is_set():
                return
            thread = threading.Thread(
                target=self._run, args=(network, tried), name=f"stand on {network.name}", daemon=True
            )
            self._threads[network.name] = thread
            thread.start()
        if self._waits:
            tried.wait()

    def _problem_on(self, network: str) -> str:
        sender = self.senders.get(network)
        if sender is not None:
            return "" if sender.link_up else DOWN
        if failure := self.failures.get(network):
            return f"its e-stop link cannot be opened: {failure}"
        return self._networks.absent.get(network) or OPENING

    def _run(self, network: NetworkAdapter, tried: threading.Event) -> None:
        again, name = AGAIN_S, network.name
        while not self._closing.is_set():
            try:
                with network.standing(self._signing_key, partial(self._known, name)) as sender:
                    if name in self.failures:
                        logger.warning("%s reports whom it misses on %s again.", self._source, name)
                    self._note(name, sender, None)
                    self._on_standing(network, sender)
                    tried.set()
                    self._closing.wait()
            except Exception as exc:  # noqa: BLE001 - logged and said; the other networks have their controller
                log = logger.debug if str(exc) == str(self.failures.get(name)) else logger.exception
                log("%s does not report whom it misses on %s; it tries again.", self._source, name)
                self._note(name, None, exc)
                tried.set()
                self._closing.wait(again)
                again = min(2 * again, AGAIN_MAX_S)
        self._note(name, None, None)
        tried.set()

    def _note(self, network: str, sender: StopSender | None, failure: Exception | None) -> None:
        # Read by screens meanwhile: replaced, not changed.
        with self._lock:
            senders = {**self.senders, network: sender}
            failures = {**self.failures, network: failure}
            self.senders = {name: each for name, each in senders.items() if each is not None}
            self.failures = {name: each for name, each in failures.items() if each is not None}


LOOK_S = 1.0
ASK_S = 1.0
ASKED_MOST = 32
"""Robots that are asked for their status at a look, if their beats say that they live: those asked longest ago.

As many more are asked of those that have no fresh beat and did not answer the last question.
"""

BEAT_FRESH_S = 3.0
"""Age of a beat up to which its robot is not asked out of turn."""

GONE_S = 5.0
"""A robot that was silent for this long is shown as gone; it must still answer a stop."""


class WatchedRobots:
    """Robots of one network that were seen and not forgotten.

    Attributes:
        problem: why the robots cannot be polled, or which of them give an alarm.
    """

    def __init__(self) -> None:
        self._robots: dict[str, LockoutReport] = {}
        self._beats: dict[str, float] = {}
        self._asked: dict[str, float] = {}
        self._unanswered: set[str] = set()
        self._all_since = float("-inf")
        self.problem = ""
        self._closed = threading.Event()

    @property
    def reports(self) -> Mapping[str, LockoutReport]:
        """The last report of each robot that gave one."""
        return self._robots

    @property
    def unanswered(self) -> Collection[str]:
        """Robots that did not answer the last question."""
        return self._unanswered

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

    def has(self, scope: Scope) -> bool:
        """Return whether a robot was seen that a stop of some robots is for."""
        robots = self._robots.items()
        if scope.only:
            return any(name in scope.only for name, _ in robots)
        return any(scope.covers(name, {str(last.facts.get("cell") or "")} - {""}) for name, last in robots)

    def known(self) -> Collection[str]:
        """Return the robots that were seen and not forgotten."""
        return tuple(self._robots)

    def forget(self) -> None:
        """Expect no answer any more from robots that are gone."""
        now = time.monotonic()
        self._robots = {name: last for name, last in self._robots.items() if now - self.seen_at(last) < GONE_S}

    def poll(self, network: NetworkAdapter) -> None:
        """Poll the robots of a network on a thread, until :meth:`close`."""
        threading.Thread(target=self._poll, args=(network,), name="watched robots", daemon=True).start()

    def close(self) -> None:
        """End polling."""
        self._closed.set()

    def take_beats(self, beats: Mapping[str, float | None]) -> None:
        """Take the monotonic times of the robots' last beats or heartbeats."""
        self._beats = {name: at for name, at in beats.items() if at is not None}

    def due(self, names: Collection[str]) -> list[str]:
        """Return the robots to ask now.

        All that are new, that were not asked since the last stop or the last change of a lockout, or that answer but
        have no fresh beat; of the others those asked longest ago. Those that did not answer come last.
        """
        now, reports, never = time.monotonic(), self._robots, float("-inf")
        asked = {name: self._asked.get(name, reports[name].at if name in reports else never) for name in names}
        settled = {name for name in names if asked[name] > self._all_since + GONE_S}
        calm = {name for name in settled if name in reports and now - self._beats.get(name, never) < BEAT_FRESH_S}
        silent = (settled & self._unanswered) - calm
        # By the question and not by the answer: those that no longer answer would take the turns of all others.
        in_turn = {
            name for each in (calm, silent) for name in sorted(each, key=lambda one: (asked[one], one))[:ASKED_MOST]
        }
        chosen = sorted({*names} - calm - silent | in_turn, key=lambda name: (name in self._unanswered, name))
        self._asked = asked | dict.fromkeys(chosen, now)
        return chosen

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
        self.problem = " ".join(alarms)

    def seen_at(self, last: LockoutReport) -> float:
        """Return when a robot gave its last sign of life, in monotonic seconds."""
        return max(last.at, self._beats.get(last.name, last.at))

    def _poll(self, network: NetworkAdapter) -> None:
        while not self._closed.wait(LOOK_S):
            try:
                names = {*network.lockable(ASK_S), *self._robots}
                self.take_beats(network.beats(names))
                self.update(network.lockouts(self.due(names), ASK_S))
            except (RefusalError, TimeoutError, KeyFileError) as exc:
                self.problem = f"The robots cannot be polled: {exc}"


def _epochs(report: LockoutReport) -> set[str]:
    return {each.epoch for each in report.lockouts}


KEY_REPEAT_S = 1.0
"""Presses closer than this are one stop: a key held down repeats, and a robot distinguishes at most 64 stops."""


LATE_S = 10.0
"""Seconds after a press in which it leaves on a network that is added then."""

Expected = Callable[[Scope], Collection[str]]
"""Returns the robots that must answer a stop of a scope."""


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
        controller: StopSender,
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
        self._over = ""
        self._closing = threading.Event()

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        return self._running

    def press(self, estop_id: str = "") -> None:
        """Stop everything; returns at once.

        Args:
            estop_id: of a stop that begins with this press, 32 hex digits; a fresh one by default.
        """
        now = time.monotonic()
        with self._guard:
            repeated, self._last = now - self._last < KEY_REPEAT_S, now
            if repeated and self._running:
                return
            if not (repeated and self._id):
                self._id = new_epoch() if estop_id in ("", self._over) else estop_id
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
                    if report.refused:
                        # A robot that was resumed meanwhile acts only on a stop with a new id.
                        self._id, self._over = "", estop_id
                    return

    def _measured(self, roster: StopRoster | None, report: StopReport) -> StopOutcome | None:
        if roster is None:
            return None
        return roster.outcome(report, replace(self._controller.sending, left=report.link))


class StopButtons:
    """Stop buttons of a console: for each scope that was pressed one on each network.

    Each press of another scope is a stop of its own, so that none waits for another or narrows it. One press has one
    id on all networks. A stop of every robot leaves on a network that is added later, too, under its id: where it was
    pressed in the last :data:`LATE_S` seconds, or still runs on another network. One of some robots does not: it is
    for the networks that have them.

    Args:
        reason: sent to the robots.
    """

    def __init__(self, reason: str) -> None:
        self._reason = reason
        self._lock = threading.Lock()
        self._networks: dict[str, tuple[StopSender, Expected]] = {}
        self._buttons: dict[tuple[str, Scope], StopButton] = {}
        self._pressed: dict[Scope, tuple[str, float]] = {}
        self._scope = EVERY_ROBOT

    def add(self, network: str, controller: StopSender, expected: Expected) -> None:
        """Add a network; a press that it has missed leaves on it.

        Args:
            network: its name.
            controller: sends on it.
            expected: returns the robots that must answer a stop of a scope; called at each press.
        """
        with self._lock:
            self._networks[network] = controller, expected
            estop_id, at = self._pressed.get(EVERY_ROBOT, ("", float("-inf")))
            held = any(each.running for (_, scope), each in self._buttons.items() if scope.everything)
            late = self._button(network, EVERY_ROBOT) if held or time.monotonic() - at < LATE_S else None
        if late is not None:
            late.press(estop_id)

    def press(self, scope: Scope = EVERY_ROBOT, networks: Collection[str] = ()) -> None:
        """Stop the robots of a scope; returns at once.

        Args:
            scope: the robots.
            networks: names of those that have them; all by default.
        """
        now = time.monotonic()
        with self._lock:
            estop_id, at = self._pressed.get(scope, ("", float("-inf")))
            # A key that is held down repeats: it is one stop.
            estop_id = estop_id if now - at < KEY_REPEAT_S else new_epoch()
            self._pressed[scope], self._scope = (estop_id, now), scope
            meant = [name for name in self._networks if name in networks] or list(self._networks)
            buttons = [self._button(name, scope) for name in meant]
        for each in buttons:
            each.press(estop_id)

    @property
    def latest(self) -> dict[str, StopButton]:
        """The buttons of the scope that was pressed last, by network."""
        with self._lock:
            return {name: each for (name, scope), each in self._buttons.items() if scope == self._scope}

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        return any(each.running for each in self.every.values())

    @property
    def every(self) -> dict[tuple[str, Scope], StopButton]:
        """All buttons, by network and scope."""
        with self._lock:
            return self._buttons.copy()

    def review(self) -> None:
        """Take what robots have said since the stops ended."""
        for each in self.every.values():
            each.review()

    def close(self) -> None:
        """Give up stops that wait for the link."""
        for each in self.every.values():
            each.close()

    def _button(self, network: str, scope: Scope) -> StopButton:
        if (network, scope) not in self._buttons:
            controller, expected = self._networks[network]
            self._buttons[network, scope] = StopButton(controller, partial(expected, scope), self._reason, scope)
        return self._buttons[network, scope]


class SafetyConsole:
    """Stop buttons and watched robots of every network of a caller.

    A network that is joined later gets its button then; a stop that it has missed leaves on it, as
    :class:`~strands_robots.fleet.safety_console.StopButtons` says. A press waits for no network.

    Args:
        networks: those of the console, which opens and closes them.
        signing_key: signs stops and check-ins, or None.
        reason: sent to the robots.
        check_in_s: seconds between check-ins, or None.

    Attributes:
        buttons: those of all networks.
        watched: the robots of each network that has a button.
    """

    def __init__(
        self, networks: Networks, signing_key: Any = None, reason: str = "", check_in_s: float | None = None
    ) -> None:
        self.buttons = StopButtons(reason)
        self._robots = {each.name: WatchedRobots() for each in networks.stated}
        self.watched: Mapping[str, WatchedRobots] = {}
        self._lock = threading.Lock()
        self._networks, self._check_in_s = networks, check_in_s
        self._were_up: frozenset[str] = frozenset()
        self._standing = StandingController(
            "safety-controller", networks, signing_key, self._known, self._add_button, waits=True
        )

    def open(self) -> None:
        """Begin to join the networks; return at once."""
        self._standing.open()
        self._networks.on_joined(lambda network: self._robots[network.name].poll(network))
        self._networks.begin()

    def close(self) -> None:
        """Give up stops that wait for a link, and leave the networks."""
        self.buttons.close()
        for each in self._robots.values():
            each.close()
        self._standing.close()
        self._networks.close()

    def press(self, scope: Scope = EVERY_ROBOT) -> None:
        """Stop the robots of a scope on the networks that have them; returns at once."""
        having = () if scope.everything else [name for name, each in self.watched.items() if each.has(scope)]
        self.buttons.press(scope, having)

    def forget(self) -> None:
        """Expect no answer any more from robots that are gone."""
        for each in self.watched.values():
            each.forget()

    @property
    def links(self) -> Mapping[str, bool]:
        """By network, whether a stop would leave at once.

        A network that can be joined and never had a link is left out beside others: nobody is there.
        """
        up = {name: each.link_up for name, each in self._standing.senders.items()}
        # What was asked for and is not there yet has no sender.
        up |= {name: False for name in self.absent if name not in up}
        self._were_up |= {name for name, is_up in up.items() if is_up}
        known = self._were_up | self.absent.keys() | {name for name, each in self.watched.items() if each.reports}
        return {name: is_up for name, is_up in up.items() if name in known} or up

    @property
    def absent(self) -> Mapping[str, str]:
        """Networks that someone asked for and that are not joined, with reasons."""
        failures = {name: plain_text(f"{type(exc).__name__}: {exc}") for name, exc in self._standing.failures.items()}
        return {**self._networks.missing, **failures}

    def _known(self, network: str) -> Collection[str]:
        return self._robots[network].known()

    def _add_button(self, network: NetworkAdapter, controller: StopSender) -> None:
        with self._lock:
            # Read by the screen meanwhile: replaced, not changed.
            self.watched = {**self.watched, network.name: self._robots[network.name]}
        self.buttons.add(network.name, controller, self._robots[network.name].expected)
        if self._check_in_s is not None:
            controller.check_in_every(self._check_in_s)
