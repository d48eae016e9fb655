"""Outcome of a stop as the roster measures it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import pytest

from strands_robots.safety.answers import Answer, Answers, Received, StopReport
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, Exemption, KeyFile, of_tenant
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.scope import Scope
from strands_robots.safety.sighting_file import Served, own_run, process_start
from strands_robots.safety.sightings import sightings, this_moment
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome, StopRoster

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
OTHER_NAME = NetworkKey.of(DEVICE_CONNECT, ["tcp/router:7447"])
EPOCH = "0" * 32
VERDICT = {"device_id": "arm-1", "estop_id": EPOCH, "stopped": True, "halted": ["policy"]}


def outcome(*verdicts: Mapping[str, Any], roster: StopRoster | None = None) -> StopOutcome:
    """Measure a stop that robots answered, by default ``arm-1``."""
    answers = Answers(of_tenant(EnrolledKeys().load(), "default"), required=False, pressed_at=0.0)
    for each in verdicts:
        answers.take(each["device_id"], Received(each, 1.0, 0.0))
    if roster is None:
        roster = StopRoster(NETWORK)
        roster.read()
    stopped = {name: each for name, each in answers.by_robot.items() if not each.claimed}
    claimed = {name: each for name, each in answers.by_robot.items() if each.claimed}
    return roster.outcome(StopReport(EPOCH, stopped, {}, {}, (), True, 1.0, claimed=claimed))


def answered(name: str = "arm-1", **more: str) -> dict[str, Any]:
    """Return the verdict of a robot of this machine, signed by its key."""
    fields = {**VERDICT, "device_id": name, **more}
    return signed(KeyFile(ROBOTS, name).load_or_make(), Purpose.STOP_VERDICT, name, fields)


def enroll(network: NetworkKey, *names: str) -> None:
    found = {name: KeyFile(ROBOTS, name).load_or_make().public for name in names}
    EnrolledKeys().enroll(found, network=network)


def serve(name: str, pid: int, network: NetworkKey = NETWORK) -> str:
    """Have another living process serve a robot, and return its run id."""
    row = Served(network, name, pid, process_start(pid), this_moment())
    sightings().file.write([], [row], this_moment())
    return row.run


@pytest.mark.parametrize(
    ("network", "unsure"),
    [
        (OTHER_NAME, True),
        (NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7448"]), False),
        (NetworkKey.of(DEVICE_CONNECT, ["tcp/router:7447"], "fleet"), False),
        (NetworkKey.of(MESH, ["tcp/router:7447"]), False),
    ],
    ids=lambda each: each.text if isinstance(each, NetworkKey) else "",
)
def test_robot_served_under_an_address_that_may_be_this_network_hides_behind_no_green(
    network: NetworkKey, unsure: bool
) -> None:
    serve("arm-2", os.getppid(), network)
    one = outcome(VERDICT)
    assert one.ok is not unsure
    assert [each.startswith("arm-2: ") for each in one.problems] == [True] * unsure
    roster = StopRoster(NETWORK, scope=Scope.named(["arm-1"]))
    roster.read()
    assert outcome(VERDICT, roster=roster).ok


@pytest.fixture
def served() -> None:
    sightings().serve(NETWORK, "arm-1")


@pytest.mark.usefixtures("served")
def test_unsigned_answer_of_a_robot_that_is_served_here_is_a_claim() -> None:
    identity = KeyFile(ROBOTS, "arm-1").load_or_make()
    claimed = outcome(VERDICT)
    assert (claimed.ok, list(claimed.report.claimed)) == (False, ["arm-1"])
    other = KeyFile(ROBOTS, "arm-2").load_or_make()
    assert not outcome(signed(other, Purpose.STOP_VERDICT, "arm-1", VERDICT)).ok
    own = outcome(signed(identity, Purpose.STOP_VERDICT, "arm-1", VERDICT))
    assert (own.ok, list(own.report.stopped)) == (True, ["arm-1"])


@pytest.mark.usefixtures("served")
def test_robot_that_is_served_here_without_a_key_may_answer_unsigned() -> None:
    assert outcome(VERDICT).ok


def test_robot_of_another_machine_that_is_not_enrolled_may_answer_unsigned() -> None:
    KeyFile(ROBOTS, "arm-1").load_or_make()
    assert outcome(VERDICT).ok


@pytest.mark.usefixtures("served")
def test_process_that_gives_no_answer_is_missed_though_another_one_of_its_name_answers() -> None:
    other = serve("arm-1", os.getppid())
    one = outcome(answered(run=own_run()))
    assert (one.ok, one.report.silent) == (False, ("arm-1",))
    assert one.reasons["arm-1"] == f"its process {os.getppid()} gives no answer; another process of that name did"
    both = outcome(answered(run=own_run()), answered(run=other))
    assert (both.ok, list(both.report.stopped)) == (True, ["arm-1"])
    assert f"{os.getppid()} of this machine" in " ".join(stop_notes(both))


@pytest.mark.usefixtures("served")
def test_answer_of_a_process_elsewhere_does_not_settle_the_one_that_is_served_here() -> None:
    one = outcome(answered(run="f" * 16))
    assert (one.ok, one.report.silent) == (False, ("arm-1",))


@pytest.mark.usefixtures("served")
def test_answer_of_an_earlier_release_settles_a_name_that_one_process_serves() -> None:
    assert outcome(answered()).ok
    serve("arm-1", os.getppid())
    missed = outcome(answered())
    assert (missed.ok, missed.report.silent) == (False, ("arm-1",))


@pytest.mark.usefixtures("served")
def test_run_of_a_silent_process_in_an_unsigned_answer_settles_nothing() -> None:
    KeyFile(ROBOTS, "arm-1").load_or_make()
    other = serve("arm-1", os.getppid())
    assert not outcome(answered(run=own_run()), {**VERDICT, "run": other}).ok


@pytest.mark.usefixtures("served")
def test_stop_goes_on_until_each_process_of_a_name_has_answered() -> None:
    other = serve("arm-1", os.getppid())
    roster = StopRoster(NETWORK)
    roster.read()
    answers = Answers({}, required=False, pressed_at=0.0)
    assert roster.divided
    for run, goes_on in ((own_run(), True), (other, False)):
        answers.take("arm-1", Received(answered(run=run), 1.0, 0.0))
        assert roster.incomplete(answers.by_robot) is goes_on


@pytest.mark.usefixtures("served")
def test_plain_stop_afterwards_does_not_settle_a_silent_process() -> None:
    roster = StopRoster(NETWORK)
    roster.read()
    assert not outcome(answered(run="f" * 16), roster=roster).ok
    plain = Answer("arm-1", True, 1.0, "")
    assert not roster.outcome(StopReport(EPOCH, {"arm-1": plain}, {}, {}, (), True, 1.0)).ok


def test_robot_enrolled_under_another_address_that_answers_brings_the_robots_of_that_address() -> None:
    enroll(OTHER_NAME, "arm-1", "arm-2")
    before = StopRoster(NETWORK)
    before.read()
    assert (before.awaited(), before.outcome(StopReport(EPOCH, {}, {}, {}, (), True, 1.0)).roster.elsewhere) == (
        frozenset(),
        2,
    )
    one = outcome(answered("arm-1"))
    assert (one.ok, one.report.silent, one.roster.elsewhere) == (False, ("arm-2",), 0)
    assert "router:7447" in " ".join(stop_notes(one))
    assert outcome(answered("arm-1"), answered("arm-2")).ok


def test_unsigned_answer_brings_no_robots_of_another_address() -> None:
    enroll(OTHER_NAME, "arm-1", "arm-2")
    assert outcome(VERDICT).roster.joined == ()


def test_robot_whose_process_is_served_under_another_address_brings_the_robots_of_that_address() -> None:
    run = serve("arm-1", os.getppid(), OTHER_NAME)
    sightings().serve(OTHER_NAME, "arm-2")
    one = outcome(answered(run=run))
    assert (one.ok, one.report.silent) == (False, ("arm-2",))
    # Another process of that name may be on another network, or on this one.
    other = outcome(answered(run="f" * 16))
    assert (other.ok, other.report.silent) == (False, ())
    assert other.problems[0].startswith("arm-1, arm-2: served by this machine under another address")


@pytest.mark.parametrize("other", [NetworkKey.of(MESH, ["tcp/router:7447"]), OTHER_NAME])
def test_network_of_another_kind_or_tenant_is_never_joined(other: NetworkKey) -> None:
    other = other if other.kind == MESH else NetworkKey(other.kind, other.where, "fleet")
    enroll(other, "arm-1", "arm-2")
    assert outcome(answered("arm-1")).roster.joined == ()


def test_joined_network_makes_no_name_count_less() -> None:
    """A name that was only heard counts where no robot is enrolled, also when another address has enrolled ones."""
    enroll(OTHER_NAME, "arm-1")
    EnrolledKeys().enroll({"arm-3": b"3" * 32}, network=OTHER_NAME)
    EnrolledKeys().exempt("arm-3", Exemption("retired", "ann", "", 1.0))
    for name in ("arm-3", "arm-9"):
        sightings().note(NETWORK, name, stoppable=True)
    one = outcome(answered("arm-1"))
    assert one.roster.joined == (OTHER_NAME,)
    assert one.report.silent == ("arm-3", "arm-9")


CELL_1 = Scope(cell="cell-1")


def awaited_in_cell(name: str, stated: str | None) -> bool:
    """Return whether a robot must answer a stop of cell-1 while its presence states a cell."""
    roster = StopRoster(NETWORK, scope=CELL_1)
    roster.read()
    roster.find({name: True}, {name: stated})
    return name in roster.awaited()


def test_unsigned_presence_takes_no_robot_that_is_served_here_out_of_a_scope() -> None:
    sightings().serve(NETWORK, "arm-1")
    sightings().serve(NETWORK, "arm-2", cell="cell-2")
    assert awaited_in_cell("arm-1", "cell-2")
    # Its record is what counts.
    assert not awaited_in_cell("arm-2", "cell-2")
    assert not awaited_in_cell("arm-2", "")


@pytest.mark.parametrize("known", ["", "cell-1"])
def test_presence_that_contradicts_the_memory_takes_no_enrolled_robot_out_of_a_scope(known: str) -> None:
    enroll(NETWORK, "arm-1")
    sightings().note(NETWORK, "arm-1", cell=known)
    assert awaited_in_cell("arm-1", "cell-2")


def test_enrolled_robot_is_in_the_cell_of_its_enrolment_and_a_presence_only_adds_to_it() -> None:
    for name, cells in (("arm-1", {"arm-1": "cell-2"}), ("arm-2", None), ("arm-3", {"arm-3": "cell-1"})):
        EnrolledKeys().enroll({name: name.encode() * 6 + b"xx"}, network=NETWORK, cells=cells)
    assert not awaited_in_cell("arm-1", "cell-2")
    assert awaited_in_cell("arm-1", "cell-1")
    assert awaited_in_cell("arm-1", "")
    # Enrolled by an earlier release: what it states is not signed.
    assert awaited_in_cell("arm-2", "cell-2")
    assert awaited_in_cell("arm-3", "cell-2")
    sightings().note(NETWORK, "arm-1", cell="cell-2")
    assert not awaited_in_cell("arm-1", "cell-2")
    EnrolledKeys().enroll({"arm-1": b"arm-1" * 6 + b"xx"}, network=NETWORK)
    assert EnrolledKeys().robots()["arm-1"].cell == "cell-2"


def test_silent_enrolled_robot_of_another_cell_is_not_expected() -> None:
    EnrolledKeys().enroll({"arm-1": b"1" * 32}, network=NETWORK, cells={"arm-1": "cell-2"})
    roster = StopRoster(NETWORK, scope=CELL_1)
    roster.read()
    assert not roster.awaited()
