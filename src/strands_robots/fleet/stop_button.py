"""Stop button: an emergency stop at each press, with its progress and outcome."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

from strands_robots.safety.answers import OnProgress, Press, Progress, StopReport
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster import OnReport, Sending
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import RosterSearch, StopOutcome, StopRoster

KEY_REPEAT_S = 1.0
"""Presses closer than this are one stop: a key held down repeats, and a robot distinguishes at most 64 stops."""


LATE_S = 10.0
"""Seconds after a press in which it leaves on a network that is added then."""

Expected = Callable[[Scope], Collection[str]]
"""Returns the robots that must answer a stop of a scope."""


class StopSender(Protocol):
    """Sender of emergency stops on one network, such as a ``SafetyController``."""

    @property
    def controller_id(self) -> str:
        """The source that robots see."""

    @property
    def network(self) -> NetworkKey | None:
        """The network of its stops, whose roster must answer; None where it is not known."""

    @property
    def link_up(self) -> bool:
        """True while a stop would leave at once."""

    @property
    def sending(self) -> Sending:
        """The way its stops leave."""

    def press(self, estop_id: str) -> Press:
        """Note the moment of a press, once."""

    def check_in_every(self, interval_s: float) -> None:
        """Check in with the robots that need a live controller."""

    def stop(
        self,
        expected: Collection[str] = (),
        reason: str = "",
        *,
        estop_id: str = "",
        more: bool = False,
        on_progress: OnProgress = lambda progress: None,
        on_report: OnReport = lambda report: None,
        scope: Scope = EVERY_ROBOT,
    ) -> StopReport:
        """Stop every robot, or those of ``scope``, and wait for answers."""

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer; False when the stop is over."""

    def review(self, report: StopReport) -> StopReport:
        """Return the report with what came since."""


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
