"""The roster: who must answer a stop, who need not, and what a stranger cannot change."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from strands_robots.safety import sighting_file, sightings
from strands_robots.safety.ed25519 import encode
from strands_robots.safety.identity import EnrolledKeys, Exemption
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.roster import Known, Roster, bounded
from strands_robots.safety.sighting_file import Note
from strands_robots.safety.sightings import RosterRow, Sightings, this_moment
from strands_robots.state_files import uptime

HERE = NetworkKey.of(DEVICE_CONNECT, ["nats://broker:4222"])
THERE = NetworkKey.of(DEVICE_CONNECT, ["nats://elsewhere:4222"])
FLEET = NetworkKey.of(DEVICE_CONNECT, ["nats://broker:4222"], "fleet")
ON_MESH = NetworkKey.of(MESH, ["tcp/127.0.0.1:7447"])
ARM, LEG = b"1" * 32, b"2" * 32


@pytest.fixture
def state(tmp_path: Path) -> Path:
    directory = tmp_path / "state"
    directory.mkdir(mode=0o700)
    return directory


@pytest.fixture
def enrolled(state: Path) -> EnrolledKeys:
    return EnrolledKeys(state)


@pytest.fixture
def store(state: Path) -> Sightings:
    return Sightings(state)


def names(rows: tuple[RosterRow, ...]) -> list[str]:
    return [each.name for each in rows]


def signed_row(store: Sightings, name: str, network: NetworkKey = HERE) -> None:
    """A robot that answered signed just now."""
    now = this_moment()
    store.file.write([Note(network, name, now, now)], [], now)


def test_where_no_robot_is_enrolled_every_row_must_answer(store: Sightings) -> None:
    store.note(HERE, "arm-1", stoppable=True)
    store.note(HERE, "arm-2")
    store.note(HERE, "camera-1", stoppable=False)
    store.serve(HERE, "arm-3")
    roster = Roster.of(HERE, store=store)
    assert set(names(roster.must_answer)) == {"arm-1", "arm-2", "arm-3"}
    assert set(names(roster.rows)) - set(names(roster.must_answer)) == {"camera-1"}
    assert roster.problems == ()


def test_where_robots_are_enrolled_a_name_that_was_only_heard_is_told(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"dead-1": ARM}, network=HERE)
    store.note(HERE, "stranger-1", stoppable=True)
    signed_row(store, "arm-2")
    store.serve(HERE, "arm-3")
    roster = Roster.of(HERE, store=store)
    assert [(each.name, each.known) for each in roster.must_answer] == [
        ("dead-1", Known.ENROLLED),
        ("arm-3", Known.SERVED),
        ("arm-2", Known.SIGNED),
    ]
    assert set(names(roster.rows)) - set(names(roster.must_answer)) == {"stranger-1"}
    assert roster.enrolled == 1


def test_a_robot_that_is_enrolled_and_dead_is_a_row_without_an_age(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"dead-1": ARM}, network=HERE)
    (row,) = Roster.of(HERE, store=store).must_answer
    assert (row.name, row.age_s) == ("dead-1", math.inf)


def test_a_stop_asks_the_robots_of_its_own_network_and_counts_the_others(
    store: Sightings, enrolled: EnrolledKeys
) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    enrolled.enroll({"arm-2": LEG}, network=THERE)
    store.serve(THERE, "arm-3")
    store.note(THERE, "heard-there")
    roster = Roster.of(HERE, store=store)
    assert names(roster.rows) == ["arm-1"]
    assert roster.elsewhere == 2


def test_a_robot_of_another_tenant_is_another_one(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    enrolled.enroll({"fleet.arm-1": LEG}, network=FLEET)
    store.note(FLEET, "arm-2")
    assert names(Roster.of(HERE, store=store).rows) == ["arm-1"]
    assert names(Roster.of(FLEET, store=store).rows) == ["arm-1", "arm-2"]
    assert Roster.of(ON_MESH, store=store).rows == ()


def test_an_old_record_counts_on_every_network_until_its_robot_answers(
    store: Sightings, enrolled: EnrolledKeys
) -> None:
    old = {"v": 1, "saved": 1.0, "robots": {"arm-1": {"key": encode(ARM)}}}
    enrolled.path.write_text(json.dumps(old), encoding="utf-8")
    enrolled.path.chmod(0o600)
    for network in (HERE, THERE, ON_MESH):
        assert names(Roster.of(network, store=store).must_answer) == ["arm-1"]
    # Its presence, which anyone may forge, moves it nowhere.
    store.note(THERE, "arm-1")
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]
    enrolled.heard("arm-1", LEG, THERE)
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]
    enrolled.heard("arm-1", ARM, THERE)
    assert Roster.of(HERE, store=store).must_answer == ()
    assert names(Roster.of(THERE, store=store).must_answer) == ["arm-1"]
    # A relayed answer does not move it on.
    enrolled.heard("arm-1", ARM, HERE)
    assert enrolled.robots()["arm-1"].networks == (THERE,)


def test_yesterdays_code_reads_the_file_of_today(enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    enrolled.exempt("arm-1", Exemption("off", "ann", "", 1.0))
    data = json.loads(enrolled.path.read_bytes())
    assert data["v"] == 1
    assert {name: each["key"] for name, each in data["robots"].items()} == {"arm-1": encode(ARM)}


def test_a_robot_is_expected_on_every_network_on_which_it_was_enrolled(
    store: Sightings, enrolled: EnrolledKeys
) -> None:
    for network in (HERE, ON_MESH, THERE):
        enrolled.enroll({"arm-1": ARM}, network=network)
    for network in (HERE, ON_MESH, THERE):
        assert names(Roster.of(network, store=store).must_answer) == ["arm-1"]
    # It has moved: --replace says so.
    enrolled.enroll({"arm-1": ARM}, network=THERE, replace=True)
    assert Roster.of(HERE, store=store).rows == ()
    assert names(Roster.of(THERE, store=store).rows) == names(Roster.of(ON_MESH, store=store).rows) == ["arm-1"]


@pytest.mark.parametrize("state_of", ["retired", "off"])
def test_an_exempt_robot_is_told_and_does_not_count(store: Sightings, enrolled: EnrolledKeys, state_of: str) -> None:
    enrolled.enroll({"arm-1": ARM, "arm-2": LEG}, network=HERE)
    enrolled.exempt("arm-1", Exemption(state_of, "ann", "moved house", 12.5))
    store.note(HERE, "arm-1", stoppable=True)
    roster = Roster.of(HERE, store=store)
    assert names(roster.rows) == ["arm-2"]
    (exempt,) = roster.exempt
    assert exempt.exemption == Exemption(state_of, "ann", "moved house", 12.5)
    # Heard in its name, unsigned: told by its age.
    assert exempt.age_s is not None and exempt.age_s < 60.0
    assert roster.enrolled == 1


def test_an_exempt_robot_that_is_served_here_counts(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    enrolled.exempt("arm-1", Exemption("off", "ann", "", 1.0))
    store.serve(HERE, "arm-1")
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]


def test_a_robot_that_is_enrolled_again_must_answer(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    enrolled.exempt("arm-1", Exemption("off", "ann", "", 1.0))
    assert set(enrolled.enroll({"arm-1": ARM}, network=HERE)) == {"arm-1"}
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]


def test_a_device_without_a_stop_cannot_be_made_of_a_robot_that_signs(store: Sightings) -> None:
    signed_row(store, "arm-1")
    store.note(HERE, "arm-1", stoppable=False)
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]


def test_an_enrolled_robot_cannot_be_told_to_have_no_stop(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    store.note(HERE, "arm-1", stoppable=False)
    assert names(Roster.of(HERE, store=store).must_answer) == ["arm-1"]


def test_ten_minutes_are_counted_before_the_press_and_later_ones_count(store: Sightings) -> None:
    now = this_moment()
    ages = {"long-ago": 650.0, "before": 500.0, "after": -5.0}
    pressed = uptime() - 60.0
    store.file.write([Note(HERE, name, now.earlier(60.0 + age)) for name, age in ages.items()], [], now)
    assert set(names(Roster.of(HERE, pressed, store=store).rows)) == {"before", "after"}


def test_a_roster_that_cannot_be_read_says_so(store: Sightings, enrolled: EnrolledKeys) -> None:
    store.file.path.write_bytes(b"no database" * 1000)
    store.file.path.chmod(0o600)
    enrolled.path.write_text("{", encoding="utf-8")
    enrolled.path.chmod(0o600)
    problems = Roster.of(HERE, store=store).problems
    assert len(problems) == 2
    assert "sightings.db" in problems[0] and "enrolled" in problems[1]


def test_made_up_names_displace_no_row_of_a_bounded_list(
    store: Sightings, enrolled: EnrolledKeys, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Ten thousand rows are read when a busy machine lets them.
    monkeypatch.setattr(sightings, "READ_S", 20.0)
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    store.note(HERE, "heard-first", stoppable=True)
    store.flush(5.0)
    now = this_moment()
    strangers = [Note(HERE, f"a-stranger-{number}", now, stoppable=True) for number in range(10_000)]
    store.file.write(strangers, [], now)
    signed_row(store, "z-signed")
    store.serve(HERE, "z-served")
    roster = Roster.of(HERE, store=store)
    kept, others = bounded(roster.rows)
    assert names(kept)[:4] == ["arm-1", "z-served", "z-signed", "heard-first"]
    assert len(kept) == 64 and 64 + others == len(roster.rows) <= sighting_file.ROWS_MAX + 2
    assert names(roster.must_answer) == ["arm-1", "z-served", "z-signed"]
    # Nor do they turn a stop red; without an enrolled robot, one that counts may be missing.
    assert roster.problems == ()
    enrolled.exempt("arm-1", Exemption("retired", "ann", "", 1.0))
    assert Roster.of(HERE, store=store).problems == (sighting_file.CROWDED,)


def test_a_robot_that_was_heard_here_and_signed_there_must_answer(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM}, network=HERE)
    store.note(HERE, "arm-9")
    roster = Roster.of(HERE, store=store).with_reported([RosterRow("arm-9", Known.SIGNED)], "page-1")
    assert names(roster.must_answer) == ["arm-1", "arm-9"]


def test_rows_that_a_controller_reports_are_added_and_take_none_away(store: Sightings, enrolled: EnrolledKeys) -> None:
    enrolled.enroll({"arm-1": ARM, "gone-1": LEG}, network=HERE)
    enrolled.exempt("gone-1", Exemption("retired", "ann", "", 1.0))
    reported = [RosterRow("arm-1", Known.HEARD), RosterRow("gone-1", Known.HEARD), RosterRow("arm-9", Known.SIGNED)]
    roster = Roster.of(HERE, store=store).with_reported(reported, "page-1")
    assert [(each.name, each.known, each.reported_by) for each in roster.must_answer] == [
        ("arm-1", Known.ENROLLED, ""),
        ("arm-9", Known.SIGNED, "page-1"),
    ]
