"""Search for the robots that must answer a stop, once it has left."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

from strands_robots.safety.answers import Answer
from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster_report import RosterReport
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import StopRoster
from strands_robots.stop_log import stop_logger
from strands_robots.utils import plain_text

logger = stop_logger(__name__)


@dataclass(frozen=True, slots=True)
class FoundDevices:
    """Devices in reach, each with its cell and whether it has a stop.

    The cell is None where it states none. ``problem`` says why there may be more; empty where there are none.
    """

    devices: Mapping[str, tuple[bool, str | None]]
    problem: str = ""


LookUp = Callable[[], FoundDevices]


class Expecting(Protocol):
    """A controller that is told who must answer."""

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer."""


class RosterSearch:
    """Names the robots of the roster as those that must answer.

    Args:
        controller: that sends the stop.
        estop_id: of the stop.
        network: whose roster it is.
        look_up: finds devices, on a thread of its own; the stop goes on until then.
        scope: the robots that the stop is for.
        named: robots that must answer besides the roster.
    """

    def __init__(
        self,
        controller: Expecting,
        estop_id: str,
        network: NetworkKey,
        look_up: LookUp | None = None,
        scope: Scope = EVERY_ROBOT,
        *,
        named: Collection[str] = (),
    ) -> None:
        self.roster, self.begun = StopRoster(network, named, scope), False
        self.estop_id, self.scope = estop_id, scope
        self._controller, self._look_up = controller, look_up
        self._answered: Mapping[str, Answer] = {}
        self._lock = threading.Lock()
        self._left = 1 if look_up is None else 2
        self._problem = "" if look_up is None else "no list of them in time"

    @property
    def problem(self) -> str:
        """Reason why robots may be missing that were to be found."""
        with self._lock:
            return self._problem

    def begin(self, progress: Progress) -> None:
        """Take the answers so far; start the search at the first call."""
        self._answered = progress.answered
        widened = progress.widened and not self.roster.scope.everything
        if widened:
            self.roster.widen()
        if widened or self.roster.divided:
            self._expect(0)
        self.start()

    def start(self) -> None:
        """Start the search; a second call does nothing."""
        if not self.begun:
            self.begun = True
            threading.Thread(target=self._read, name="stop roster", daemon=True).start()
            if self._look_up is not None:
                threading.Thread(target=self._find, args=(self._look_up,), name="stop lookup", daemon=True).start()

    def take(self, report: RosterReport) -> None:
        """Take the robots that another standing controller misses."""
        if self.roster.take(report):
            self._expect(0)

    def _read(self) -> None:
        self.roster.read()
        self._expect(1)

    def _find(self, look_up: LookUp) -> None:
        try:
            found = look_up()
        except BaseException as exc:  # noqa: BLE001 - said with the report; the stop goes on to its deadline
            logger.warning("The search for robots failed: %s", exc)
            self.failed(exc)
            return
        self.roster.find(
            {name: stops for name, (stops, _) in found.devices.items()},
            {name: cell for name, (_, cell) in found.devices.items()},
        )
        self._expect(1, found.problem.rstrip("."))

    def complete(self, found: FoundDevices) -> None:
        """Note that these are all devices in reach, also where the stop is over."""
        with self._lock:
            self._problem = found.problem.rstrip(".")

    def failed(self, exc: BaseException) -> None:
        """Note why devices in reach could not be looked up."""
        with self._lock:
            self._problem = plain_text(str(exc), 300).rstrip(".") or type(exc).__name__

    def _expect(self, done: int, problem: str | None = None) -> None:
        # The report of a stop that this completes is read after what this says.
        with self._lock:
            self._left -= done
            more = self._left > 0 or self.roster.incomplete(self._answered)
            goes_on = self._controller.expect(self.estop_id, self.roster.awaited(self._answered), more=more)
            if goes_on and problem is not None:
                self._problem = problem


def stop_and_search(
    controller: SafetyController, search: RosterSearch, expected: Collection[str], reason: str, deadline_s: float
) -> StopReport:
    """Send the stop of ``search``, which goes on meanwhile; return the report."""
    return controller.stop(
        expected,
        reason,
        deadline_s=deadline_s,
        estop_id=search.estop_id,
        more=True,
        on_progress=search.begin,
        on_report=search.take,
        scope=search.scope,
    )
