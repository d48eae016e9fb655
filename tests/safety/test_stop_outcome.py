"""Who must answer a stop: what counts, what is only told, and why a robot is silent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.safety import stop_roster
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.safety.identity import Exemption
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.roster import Roster, RosterReport, Sending, process_state, reason_of
from strands_robots.safety.sightings import Known, RosterRow
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome, StopRoster

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
ELSEWHERE = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"], "lab")

Measure = Callable[..., StopOutcome]


def answer(name: str, stopped: bool | None = True, **more: Any) -> Answer:
    return Answer(name, stopped, 3.0, "" if stopped else "no brakes", {"estop_id": "e" * 32}, **more)


def report(*answers: Answer) -> StopReport:
    stopped = {each.device_id: each for each in answers if each.stopped}
    others = {each.device_id: each for each in answers if not each.stopped}
    return StopReport("e" * 32, stopped, others, {}, (), True, 12.0)


@pytest.fixture
def measure(monkeypatch: pytest.MonkeyPatch) -> Measure:
    """Measure answers by a roster of these rows."""

    def one(
        rows: tuple[RosterRow, ...],
        *answers: Answer,
        enrolled: int = 0,
        named: tuple[str, ...] = (),
        reports: tuple[RosterReport, ...] = (),
        found: dict[str, bool] | None = None,
        sending: Sending | None = None,
        **more: Any,
    ) -> StopOutcome:
        roster = Roster(NETWORK, rows, enrolled=enrolled, **more)
        monkeypatch.setattr(stop_roster.Roster, "of", lambda *_: roster)
        searched = StopRoster(NETWORK, named)
        searched.read()
        searched.find(found or {})
        for each in reports:
            searched.take(each)
        return searched.outcome(report(*answers), sending)

    return one


ENROLLED, HEARD = RosterRow("arm-1", Known.ENROLLED), RosterRow("arm-2", Known.HEARD, age_s=3.0)


def test_silent_robot_of_the_roster_is_no_success(measure: Measure) -> None:
    outcome = measure((ENROLLED, HEARD), answer("arm-2"), enrolled=1)
    assert (outcome.ok, outcome.report.silent, outcome.size) == (False, ("arm-1",), 1)
    assert outcome.sentence == "The one robot of the roster is not known to stand still."


def test_name_that_was_only_heard_counts_where_no_robot_is_enrolled(measure: Measure) -> None:
    served = RosterRow("arm-1", Known.SERVED)
    outcome = measure((served, HEARD), answer("arm-1"))
    assert (outcome.ok, outcome.report.silent, outcome.size) == (False, ("arm-2",), 2)
    assert "strands-robots enroll" in outcome.worth


@pytest.mark.parametrize("stopped", [True, False, None])
def test_name_that_was_only_heard_is_told_where_a_robot_is_enrolled(measure: Measure, stopped: bool | None) -> None:
    outcome = measure((ENROLLED, HEARD), answer("arm-1"), answer("arm-2", stopped), enrolled=1)
    assert outcome.ok
    assert (outcome.size, outcome.worth) == (1, "")
    assert any("arm-2" in each for each in stop_notes(outcome)) is (stopped is not True)


def test_ten_thousand_made_up_names_alter_nothing(measure: Measure) -> None:
    liars = [answer(f"liar-{n}", n % 2 == 0) for n in range(10_000)]
    unproven = RosterReport(
        "stranger", "e" * 32, tuple(RosterRow(f"g{n}", Known.ENROLLED) for n in range(64)), 99, False
    )
    found = {f"made-up-{n}": True for n in range(10_000)}
    green = measure((ENROLLED,), answer("arm-1"), *liars, enrolled=1, reports=(unproven,), found=found)
    assert (green.ok, green.size) == (True, 1)
    red = measure((ENROLLED,), *liars, enrolled=1, reports=(unproven,), found=found)
    assert (red.ok, red.report.silent) == (False, ("arm-1",))
    assert all(len(each) < 400 for each in stop_notes(red))


def test_made_up_names_keep_no_stop_going(measure: Measure, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_roster.Roster, "of", lambda *_: Roster(NETWORK, (ENROLLED,), enrolled=1))
    searched = StopRoster(NETWORK)
    searched.read()
    searched.find({f"made-up-{n}": True for n in range(10_000)})
    awaited = searched.awaited()
    assert "arm-1" in awaited
    assert len(awaited) <= 1 + stop_roster.OTHERS_AWAITED


def test_forged_presence_without_a_stop_exempts_no_enrolled_robot(measure: Measure) -> None:
    outcome = measure((replace(ENROLLED, stoppable=False),), enrolled=1, found={"arm-1": False})
    assert outcome.report.silent == ("arm-1",)
    assert outcome.no_stop == ()


def test_device_without_a_stop_is_a_row_of_its_own(measure: Measure) -> None:
    outcome = measure((ENROLLED,), answer("arm-1"), enrolled=1, found={"lamp": False})
    assert (outcome.ok, outcome.no_stop, outcome.size) == (True, ("lamp",), 1)


def test_named_robots_are_added_to_the_roster(measure: Measure) -> None:
    outcome = measure((ENROLLED,), answer("arm-1"), enrolled=1, named=("arm-9",))
    assert (outcome.ok, outcome.report.silent, outcome.size) == (False, ("arm-9",), 2)


@pytest.mark.parametrize(("trusted", "code"), [(True, False), (False, True)])
def test_report_of_a_controller_counts_by_its_signature(measure: Measure, trusted: bool, code: bool) -> None:
    missed = RosterReport("safety-2", "e" * 32, (RosterRow("arm-7", Known.SIGNED),), 0, trusted)
    outcome = measure((ENROLLED,), answer("arm-1"), enrolled=1, reports=(missed,))
    assert outcome.ok is code
    assert outcome.report.silent == (() if code else ("arm-7",))
    assert outcome.unproven == ({"arm-7": "safety-2"} if code else {})
    assert code or "safety-2" in outcome.reasons["arm-7"]


def test_controller_that_misses_more_than_it_names_keeps_the_exit_code_from_0(measure: Measure) -> None:
    missed = RosterReport("safety-2", "e" * 32, (), 3, True)
    outcome = measure((ENROLLED,), answer("arm-1"), enrolled=1, reports=(missed,))
    assert not outcome.ok
    assert "safety-2 misses 3 more" in outcome.problems[0]


def test_exempt_robot_is_printed_and_its_own_answer_counts(measure: Measure) -> None:
    exempt = (replace(ENROLLED, exemption=Exemption("retired", "ann", "sold", 0.0)),)
    enrolled = RosterRow("arm-3", Known.ENROLLED)
    calm = measure((enrolled,), answer("arm-3"), enrolled=1, exempt=exempt, found={"arm-1": True})
    assert calm.ok
    assert calm.facts()["retired"] == ["arm-1"]
    assert any("arm-1 (retired)" in each for each in stop_notes(calm))
    moving = measure((enrolled,), answer("arm-3"), answer("arm-1", False, enrolled=True), enrolled=1, exempt=exempt)
    assert set(moving.report.not_stopped) == {"arm-1"}


def test_outcome_is_one_bounded_record_in_the_audit(measure: Measure) -> None:
    rows = tuple(RosterRow(f"arm-{n}", Known.ENROLLED) for n in range(1000))
    measure(rows, answer("arm-1"), enrolled=1000).record("desk-1")
    (record,) = [each for each in read_audit_log() if each["event"] == "estop_outcome"]
    assert record["payload"]["silent_in_all"] == 999
    assert len(record["payload"]["silent"]) == stop_roster.NAMED_MAX


@pytest.mark.parametrize(
    ("row", "sending", "found", "said"),
    [
        (ENROLLED, Sending(left=False), False, "the link is down"),
        (ENROLLED, Sending(denied="nats: permissions violation"), False, "the broker refuses"),
        (replace(ENROLLED, signed_only=True), Sending(), True, "estop --key"),
        (replace(ENROLLED, signed_only=True), Sending(signed=True), True, "does not answer"),
        (replace(ENROLLED, departed=True), Sending(), False, "leaves"),
        (ENROLLED, Sending(), True, "is on this network and does not answer"),
        (replace(ENROLLED, age_s=42.0), Sending(), False, "no route to it: it was last heard 42 s before"),
        (ENROLLED, Sending(), False, "not heard in the last ten minutes"),
        (replace(ENROLLED, alive=False), Sending(), False, "its process on this machine has ended"),
        (replace(ENROLLED, alive=True, pid=1), Sending(), False, "is there and does not answer"),
    ],
)
def test_reason_of_silence_is_what_is_known(row: RosterRow, sending: Sending, found: bool, said: str) -> None:
    assert said in reason_of(row, sending, found=found, elsewhere={})


def test_robot_on_another_tenant_is_told_so() -> None:
    said = reason_of(ENROLLED, Sending(), found=False, elsewhere={"arm-1": (ELSEWHERE, 12.0)})
    assert said == "it was heard 12 s ago on another network: tenant lab at 127.0.0.1:7447"


@pytest.fixture
def child() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    yield process
    process.kill()
    process.wait()


def test_stopped_process_is_told_from_one_that_runs_or_has_ended(child: subprocess.Popen[bytes]) -> None:
    row = replace(ENROLLED, alive=True, pid=child.pid)
    os.kill(child.pid, signal.SIGSTOP)
    eventually(lambda: process_state(child.pid) == "T")
    assert "is stopped (SIGSTOP)" in reason_of(row, Sending(), found=False, elsewhere={})
    child.kill()
    eventually(lambda: process_state(child.pid) == "Z")
    assert "has ended" in reason_of(row, Sending(), found=False, elsewhere={})
