"""Standing controllers: what they report of the stops of others, and who is believed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.waiting import eventually

from strands_robots.rate_limits import EventBudget
from strands_robots.safety import ed25519, standing_roster
from strands_robots.safety.identity import console_key
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.orders import new_epoch, signed_stop
from strands_robots.safety.roster import (
    REPORT_MAX_BYTES,
    Roster,
    RosterInbox,
    RosterReport,
    read_report,
    report_fields,
    trusted_controllers,
)
from strands_robots.safety.sightings import Known, RosterRow
from strands_robots.safety.standing_roster import StandingRoster
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_link import ESTOP, STOP_ROSTER, VERDICT, notification

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])


class Standing:
    """A standing controller that knows some robots, and its reports."""

    def __init__(self, *names: str) -> None:
        self.reports: list[Mapping[str, Any]] = []
        rows = tuple(RosterRow(name, Known.ENROLLED) for name in names)
        self.roster = StandingRoster(
            "safety-2",
            self.reports.append,
            roster=lambda: Roster(NETWORK, rows, enrolled=len(rows)),
            keys=dict,
            identity=lambda: console_key().load_or_make(),
        )

    def stop(self, estop_id: str, source: str = "desk-1") -> None:
        self.roster.hear(ESTOP, source, notification(ESTOP, {"estop_id": estop_id, "t": 1.0}))

    def verdict(self, estop_id: str, name: str) -> None:
        facts = {"estop_id": estop_id, "device_id": name, "stopped": True}
        self.roster.hear(VERDICT, name, notification(VERDICT, facts))


@pytest.fixture
def standing(monkeypatch: pytest.MonkeyPatch) -> Iterator[Standing]:
    monkeypatch.setattr(standing_roster, "REPORT_AT_S", (0.1, 0.2, 0.3))
    monkeypatch.setattr(standing_roster, "SPREAD_S", 0.0)
    made = Standing("arm-1", "arm-2")
    yield made
    made.roster.close()


def test_robot_without_an_answer_is_reported_once_and_signed(standing: Standing) -> None:
    estop_id = new_epoch()
    standing.stop(estop_id)
    standing.verdict(estop_id, "arm-1")
    eventually(lambda: standing.reports)
    report = read_report("safety-2", standing.reports[0], trusted_controllers())
    assert report is not None
    assert (report.trusted, report.estop_id, report.more) == (True, estop_id, 0)
    assert [(row.name, row.known) for row in report.rows] == [("arm-2", Known.ENROLLED)]
    eventually(lambda: not standing.roster._followed)
    assert len(standing.reports) == 1


def test_controller_says_when_it_misses_none_any_more(standing: Standing) -> None:
    estop_id = new_epoch()
    standing.stop(estop_id)
    eventually(lambda: standing.reports)
    standing.verdict(estop_id, "arm-1")
    standing.verdict(estop_id, "arm-2")
    eventually(lambda: len(standing.reports) == 2)
    assert standing.reports[1]["missing"] == []


def test_own_stop_is_not_reported(standing: Standing) -> None:
    standing.stop(new_epoch(), "safety-2")
    other = new_epoch()
    standing.stop(other)
    eventually(lambda: standing.reports)
    assert {each["estop_id"] for each in standing.reports} == {other}


def test_flood_of_stops_is_followed_within_bounds(standing: Standing) -> None:
    for n in range(20_000):
        standing.stop(new_epoch(), f"desk-{n}")
    assert len(standing.roster._pending) <= standing_roster.PENDING_MAX
    eventually(lambda: standing.reports)
    assert len(standing.roster._followed) <= standing_roster.SOURCES_MAX


def test_made_up_sources_hold_only_half_of_the_places(standing: Standing) -> None:
    roster = standing.roster
    roster._names = frozenset({"desk-1"})
    for n in range(40):
        standing.stop(new_epoch(), f"made-up-{n}")
    true = new_epoch()
    standing.stop(true)
    eventually(lambda: "desk-1" in roster._followed or (true in {each["estop_id"] for each in standing.reports}))
    assert sum(not each.known for each in tuple(roster._followed.values())) <= standing_roster.SOURCES_MAX // 2
    for n in range(40):
        standing.stop(new_epoch(), f"another-{n}")
    eventually(lambda: true in {each["estop_id"] for each in standing.reports})


def test_forged_stops_are_checked_within_a_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", ed25519.encode(ed25519.public_half(key)))
    standing, checked = Standing("arm-1"), list[str]()
    try:
        real = standing.roster._rules.signature_refusal

        def counted(source: str, *rest: Any) -> str | None:
            checked.append(source)
            return real(source, *rest)

        monkeypatch.setattr(standing.roster._rules, "signature_refusal", counted)
        standing.roster._failures = EventBudget(2, 3)
        for n in range(40):
            standing.stop(new_epoch(), f"made-up-{n}")
        eventually(lambda: len(checked) == 3 and not standing.roster._pending)
        standing.roster._signers["desk-1"] = None
        fields = {"estop_id": new_epoch(), "nonce": new_epoch(), "t": 1.0}
        stop = signed_stop(key, Purpose.EMERGENCY_STOP, "desk-1", fields)
        standing.roster.hear(ESTOP, "desk-1", notification(ESTOP, stop))
        eventually(lambda: standing.reports)
        assert standing.reports[0]["estop_id"] == fields["estop_id"]
    finally:
        standing.roster.close()


def test_report_is_bounded_and_the_surest_come_first() -> None:
    rows = [RosterRow(f"heard-{n}", Known.HEARD, order=n) for n in range(10_000)]
    fields = report_fields("e" * 32, [*rows, RosterRow("arm-1", Known.ENROLLED)])
    assert fields["missing"][0] == {"name": "arm-1", "how": "enrolled"}
    assert (len(fields["missing"]), fields["more"]) == (64, 9937)
    longest = [RosterRow("a" * 128, Known.ENROLLED, cell="c" * 64) for _ in range(64)]
    message = notification(STOP_ROSTER, signed(None, Purpose.STOP_ROSTER, "safety-2", report_fields("e" * 32, longest)))
    assert len(message) <= REPORT_MAX_BYTES


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"estop_id": "e" * 32},
        {"estop_id": "e" * 32, "missing": "arm-1"},
        {"estop_id": 5, "missing": []},
        {"estop_id": ["e"], "missing": []},
    ],
)
def test_message_that_is_no_report_is_none(fields: dict[str, Any]) -> None:
    assert read_report("x", fields, ()) is None


def test_hostile_rows_are_left_out() -> None:
    bad = [5, None, [], {"name": 5}, {"name": "a/b"}, {"name": "x" * 1000}, {"name": "arm-1", "how": 5, "cell": "\x00"}]
    report = read_report("x", {"estop_id": "e" * 32, "missing": bad, "more": True}, ())
    assert report is not None
    assert report.rows == (RosterRow("arm-1", Known.HEARD),)
    assert (report.more, report.trusted) == (0, False)


def test_inbox_takes_trusted_reports_through_a_flood_of_strangers() -> None:
    inbox, got = RosterInbox(), list[RosterReport]()
    estop_id = new_epoch()
    inbox.open(estop_id, got.append)
    identity = console_key().load_or_make()
    own = notification(
        STOP_ROSTER,
        signed(identity, Purpose.STOP_ROSTER, "safety-2", report_fields(estop_id, [RosterRow("a", Known.HEARD)])),
    )
    many = json.dumps(
        {"params": {"estop_id": estop_id, "missing": [{"name": f"g{n}"} for n in range(10_000)], "more": 0}}
    )
    inbox.put("stranger", 8 * 2**20)
    inbox.put("stranger", many.encode())
    for n in range(5000):
        inbox.put(f"s{n}", notification(STOP_ROSTER, report_fields(estop_id, [RosterRow("ghost", Known.ENROLLED)])))
        if n % 100 == 0:
            inbox.put("safety-2", own)
    eventually(lambda: any(each.trusted for each in got))
    assert all(each.source != "stranger" for each in got), "a long message is not read"
    inbox.close(estop_id)
    inbox.end()
