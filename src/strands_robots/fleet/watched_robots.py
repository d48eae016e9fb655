"""Robots of one network as they last reported, asked in turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Mapping, Sequence

from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.lockout_report import LockoutReport
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.scope import EVERY_ROBOT, Scope

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
