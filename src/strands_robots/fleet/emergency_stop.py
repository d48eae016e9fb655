"""Emergency stop in progress, and the search for the robots that must answer it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import replace

from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster_search import FoundDevices, RosterSearch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import StopOutcome

Devices = Callable[[threading.Event], FoundDevices]
"""Finds the devices in reach, on a thread of its own; it may connect at once, and searches once the event is set."""


class EmergencyStop:
    """An emergency stop on a thread of its own, which never waits for drawing.

    The roster must answer: it is read once the stop has begun, and united with what standing controllers report.

    Args:
        controller: sends it; the caller closes it.
        network: whose roster must answer.
        reason: sent to the robots.
        deadline_s: seconds until silence is reported as silence.
        named: robots that must answer besides the roster.
        devices: finds further robots that must answer; a search that fails is tried once more.
        scope: the robots that it is for.
        estop_id: 32 hex digits; a fresh one by default.
        link_wait_s: longest wait for the link before the deadline counts.

    Attributes:
        latest: the answers so far; None before the first report.
        report: the report of all answers, once the stop is over.
    """

    def __init__(
        self,
        controller: SafetyController,
        network: NetworkKey,
        reason: str,
        deadline_s: float,
        *,
        named: Collection[str] = (),
        devices: Devices | None = None,
        scope: Scope = EVERY_ROBOT,
        estop_id: str = "",
        link_wait_s: float = 0.0,
    ) -> None:
        self.latest: Progress | None = None
        self.report: Future[StopReport] = Future()
        self._controller, self._named, self._reason = controller, named, reason
        self._deadline_s, self._link_wait_s = deadline_s, link_wait_s
        self._begun = threading.Event()
        estop_id = estop_id or new_epoch()
        controller.press(estop_id)
        self._found: Future[FoundDevices] = Future()
        look_up = None if devices is None else self._found.result
        self._looks_up = devices is not None
        self._search = RosterSearch(controller, estop_id, network, look_up, scope, named=named)
        threading.Thread(target=self._run, name="estop", daemon=True).start()
        if devices is not None:
            threading.Thread(target=self._find, args=(devices,), name="estop lookup", daemon=True).start()

    def outcome(self) -> StopOutcome:
        """Wait for the report; return its outcome, which this console records.

        Raises:
            Exception: what the controller raised.
        """
        report = self.report.result()
        outcome = self.measured(report)
        self.record(outcome, report)
        return outcome

    def unanswered(self, report: StopReport) -> list[str]:
        """Return the devices in reach that can be stopped, and did not act on this stop.

        It waits for the search; where that failed there are none, and the outcome has its problem.
        """
        try:
            found = self._found.result()
        except BaseException:  # noqa: BLE001 - logged by the search, and told by the outcome
            return []
        self._search.complete(found)
        answered = {*report.stopped, *report.not_stopped, *report.refused}
        scope = EVERY_ROBOT if report.widened else self._search.scope
        return [
            name
            for name, (stops, cell) in found.devices.items()
            if stops and name not in answered and scope.covers(name, {cell or ""} - {""})
        ]

    def measured(self, report: StopReport) -> StopOutcome:
        """Return a report of this stop, measured by the roster."""
        why = self._search.problem
        problem = f"The robots that must answer could not be looked up: {why}." if why else ""
        return self._search.roster.outcome(report, replace(self._controller.sending, left=report.link), problem)

    def record(self, outcome: StopOutcome, report: StopReport) -> None:
        """Write the outcome into the audit, and remember who answered."""
        outcome.record(self._controller.controller_id)
        self._search.roster.remember(report)

    def _run(self) -> None:
        try:
            # Nothing can leave before the link is up; then the milliseconds are the robots' and not the handshake's.
            if self._link_wait_s:
                self._controller.wait_link(self._link_wait_s)
            report = self._controller.stop(
                self._named,
                self._reason,
                deadline_s=self._deadline_s,
                estop_id=self._search.estop_id,
                more=True,
                on_progress=self._progress,
                on_report=self._search.take,
                scope=self._search.scope,
            )
        except BaseException as exc:  # noqa: BLE001 - raised again by the future
            self.report.set_exception(exc)
        else:
            self.report.set_result(report)
        finally:
            # A stop that ends before its first progress leaves no search waiting.
            self._begun.set()
            self._search.start()

    def _progress(self, progress: Progress) -> None:
        first, self.latest = self.latest is None, progress
        self._search.begin(progress)
        if first and self._looks_up:
            threading.Thread(target=self._begin_search, name="estop lookup", daemon=True).start()

    def _begin_search(self) -> None:
        # What a search hears is written into the memory that the roster is read from, so that is read before.
        self._search.roster.wait_until_read()
        self._begun.set()

    def _find(self, devices: Devices) -> None:
        for last in (False, True):
            try:
                self._found.set_result(devices(self._begun))
            except BaseException as exc:  # noqa: BLE001 - raised again by the future; a binding's panic is no Exception
                self._search.failed(exc)
                # A network that is not there yet is asked again once the stop has begun.
                self._begun.wait()
                if last or self.report.done():
                    self._found.set_exception(exc)
                    return
            else:
                return
