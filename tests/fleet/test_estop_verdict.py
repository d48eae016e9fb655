"""The agent's emergency stop: what a plain ``stop`` beside it can prove, and what it cannot."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from strands_robots.device_connect import safety_controller
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.envelope import Envelope, error, success, text_of
from strands_robots.fleet.adapter import StopRequest
from strands_robots.fleet.device_connect import stops
from strands_robots.safety import stop_roster
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.roster import Roster, Sending
from strands_robots.safety.sightings import Known, RosterRow

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
STOPPED = success("stopped", stopped=True)

Press = Callable[..., Envelope]


class PlainFleet:
    """A fleet in which each device answers a plain stop."""

    source, stale = "tool", ""
    link = LinkConfig(mode="peer", connect=("tcp/127.0.0.1:7447",), multicast=False)

    def __init__(self, plain: dict[str, Envelope]) -> None:
        self.plain, self.asked, self.measured = plain, list[str](), False

    def peers(self, timeout: float, *, thorough: bool) -> list[Any]:
        return [SimpleNamespace(id=name, stop_verb="stop", cell="") for name in self.plain]

    def stop_each(self, devices: list[str], seconds: float) -> dict[str, Envelope]:
        self.asked += devices
        # What has not stopped yet does not wait for the disk.
        assert not self.measured
        return {name: self.plain[name] for name in devices}


@pytest.fixture
def press(monkeypatch: pytest.MonkeyPatch) -> Press:
    """Press the agent's emergency stop: what came of it, who answers a plain stop, and who is known."""

    def pressed(
        plain: dict[str, Envelope],
        *answers: Answer,
        known: tuple[RosterRow, ...] = (),
        alarms: dict[str, str] | None = None,
    ) -> Envelope:
        enrolled = sum(row.known is Known.ENROLLED for row in known)
        monkeypatch.setattr(stop_roster.Roster, "of", lambda *_: Roster(NETWORK, known, enrolled=enrolled))
        fleet = PlainFleet(plain)
        stopped = {each.device_id: each for each in answers if not each.claimed}
        claimed = {each.device_id: each for each in answers if each.claimed}
        report = StopReport("e" * 32, stopped, {}, {}, (), True, 12.0, claimed=claimed, alarms=alarms or {})
        left = threading.Event()

        def sent(*_: Any, on_progress: Callable[[Progress], None], **__: Any) -> StopReport:
            on_progress(Progress("e" * 32, {}, (), True, 1.0))
            assert left.wait(20)
            return report

        def expect(estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
            if not more:
                left.set()
            return True

        controller = SimpleNamespace(
            sending=Sending(),
            close=lambda: None,
            press=lambda _: None,
            wait_link=lambda _: True,
            stop=sent,
            expect=expect,
            controller_id="tool",
        )
        monkeypatch.setattr(safety_controller, "safety_controller", lambda *_: controller)

        measure = stop_roster.StopRoster.outcome

        def measured(self: stop_roster.StopRoster, *given: Any) -> stop_roster.StopOutcome:
            fleet.measured = True
            return measure(self, *given)

        monkeypatch.setattr(stop_roster.StopRoster, "outcome", measured)
        outcome = stops.stopped_and_locked(fleet.link, fleet.source, lambda: nullcontext(fleet), StopRequest("test"))  # type: ignore[arg-type]
        answer = safety_controller.outcome_envelope(outcome)
        assert fleet.asked == [name for name in plain if name not in stopped]
        return answer

    return pressed


ENROLLED = RosterRow("arm-1", Known.ENROLLED)
SERVED = RosterRow("arm-1", Known.SERVED, alive=True, pid=1, processes=(("run", 1),))
SIGNED = RosterRow("arm-1", Known.SIGNED, age_s=3.0)


def test_plain_answer_clears_no_alarm(press: Press) -> None:
    answer = press({"arm-1": STOPPED}, known=(ENROLLED,), alarms={"arm-1": "a wrong key"})
    assert (answer["status"], answer["alarms"]) == ("error", {"arm-1": "a wrong key"})
    assert answer["roster"]["still"] == 0


def test_plain_answer_makes_no_claim_true(press: Press) -> None:
    claimed = Answer("arm-1", True, 3.0, "", {"estop_id": "e" * 32}, required=True)
    answer = press({"arm-1": STOPPED}, claimed, known=(ENROLLED,))
    assert (answer["status"], answer["claimed"]) == ("error", ["arm-1"])
    assert answer["roster"]["still"] == 0


@pytest.mark.parametrize("row", [ENROLLED, SERVED, SIGNED])
def test_robot_with_a_key_that_is_not_locked_is_an_error(press: Press, row: RosterRow) -> None:
    answer = press({"arm-1": STOPPED}, known=(row,))
    assert (answer["status"], answer["silent"], answer["not_locked"]) == ("error", ["arm-1"], ["arm-1"])
    assert "proves nothing" in answer["reasons"]["arm-1"]


def test_bare_device_that_stops_counts_and_is_said_not_to_be_locked(press: Press) -> None:
    answer = press({"lamp": STOPPED})
    assert (answer["status"], answer["not_locked"]) == ("success", ["lamp"])
    assert "Not locked: lamp." in text_of(answer)


def test_robot_that_says_that_it_did_not_stop_is_believed(press: Press) -> None:
    answer = press({"arm-1": error("no brakes", stopped=False)}, known=(ENROLLED,))
    assert (answer["status"], answer["not_stopped"]) == ("error", {"arm-1": "no brakes"})
