"""Emergency stop in progress, and the search for the robots that must answer it."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING

from strands_robots.cli.output import plain
from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster_report import RosterReport
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import StopOutcome, StopRoster

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

LINK_WAIT_S = 2.0

LOOKUP_SHARE = 2 / 3
"""Part of the deadline in which robots are looked up; the rest is for their answers."""


class RunningStop:
    """An emergency stop on a thread of its own, which never waits for drawing.

    The roster must answer: it is read once the stop has begun, and united with what standing controllers report.
    Without ``named``, every robot that can be found and stopped is looked up as well, on a connection of its own.
    """

    def __init__(
        self,
        controller: SafetyController,
        named: list[str],
        reason: str,
        deadline_s: float,
        link: LinkConfig,
        *,
        scope: Scope = EVERY_ROBOT,
    ) -> None:
        from strands_robots.device_connect.enrollment import network_of  # noqa: PLC0415 - loaded when it is used

        self.latest: Progress | None = None
        self._controller, self._named, self._reason = controller, named, reason
        self._deadline_s, self._link = deadline_s, link
        self._id = new_epoch()
        controller.press(self._id)
        self._scope = scope
        self._roster = StopRoster(network_of(link), named, scope)
        self._begun = threading.Event()
        self._looking = threading.Lock()
        self._missed = "" if named else "no list of them in time"
        self._searching = {"the roster"} if named else {"the roster", "the network"}
        self.report: Future[StopReport] = Future()
        threading.Thread(target=self._run, name="estop", daemon=True).start()
        threading.Thread(target=self._read_roster, name="estop roster", daemon=True).start()
        if not named:
            threading.Thread(target=self._expect_all, name="estop lookup", daemon=True).start()

    def outcome(self) -> StopOutcome:
        """Wait for the report; return its outcome, which this console records."""
        report = self.report.result()
        with self._looking:
            problem = f"The robots that must answer could not be looked up: {self._missed}." if self._missed else ""
        sending = replace(self._controller.sending, left=report.link)
        outcome = self._roster.outcome(report, sending, problem)
        outcome.record(self._controller.controller_id)
        self._roster.remember(report)
        return outcome

    def _run(self) -> None:
        try:
            # Nothing can leave before the link is up; then the milliseconds are the robots' and not the handshake's.
            self._controller.wait_link(LINK_WAIT_S)
            report = self._controller.stop(
                self._named,
                self._reason,
                deadline_s=self._deadline_s,
                estop_id=self._id,
                more=True,
                on_progress=self._progress,
                on_report=self._take_report,
                scope=self._scope,
            )
        except BaseException as exc:  # noqa: BLE001 - raised again by the future
            self.report.set_exception(exc)
        else:
            self.report.set_result(report)
        finally:
            # A stop that ends before its first progress leaves no lookup waiting.
            self._begun.set()

    def _progress(self, progress: Progress) -> None:
        widened = progress.widened and not (self.latest is not None and self.latest.widened)
        self.latest = progress
        self._begun.set()
        if widened:
            self._roster.widen()
        if widened or self._roster.divided:
            self._expect()

    def _read_roster(self) -> None:
        self._begun.wait()
        self._roster.read()
        self._expect("the roster")

    def _take_report(self, report: RosterReport) -> None:
        if self._roster.take(report):
            self._expect()

    def _expect(self, searched: str = "", missed: str = "") -> None:
        """Name the robots that must answer, once ``searched`` is known."""
        # The report of a stop that this completes is read after what this says.
        with self._looking:
            self._searching.discard(searched)
            answered = self.latest.answered if self.latest else {}
            awaited = self._roster.awaited(answered)
            more = bool(self._searching) or self._roster.incomplete(answered)
            if self._controller.expect(self._id, awaited, more=more) and searched == "the network":
                self._missed = missed

    def _expect_all(self) -> None:
        if not self._found():
            # A network that is not there yet is asked again once the stop has begun.
            self._begun.wait()
            if not self.report.done():
                self._found()

    def _found(self) -> bool:
        """Look up those that must answer; False when it failed, with the reason kept."""
        try:
            self._look_up()
        except Exception as exc:  # noqa: BLE001 - said with the report, which names those that answered
            with self._looking:
                self._missed = plain(str(exc).rstrip(".") or type(exc).__name__, 300)
            return False
        return True

    def _look_up(self) -> None:
        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - the network is loaded when it is used

        with FleetClient(self._link) as fleet:
            self._begun.wait()
            if self.report.done():
                return
            within = min(2.0, self._deadline_s * LOOKUP_SHARE)
            peers = fleet.peers(within, thorough=True)
            self._roster.find(
                {peer.id: peer.stop_verb is not None for peer in peers}, {peer.id: peer.cell for peer in peers}
            )
            stale = fleet.stale
        self._expect("the network", stale.rstrip("."))
