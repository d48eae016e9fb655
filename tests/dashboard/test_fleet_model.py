"""The fleet as the page shows it."""

from __future__ import annotations

import json
from typing import Any

import pytest

from strands_robots.dashboard import fleet_model
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.safety.lockout import Lockout

EPOCH = "0" * 31 + "1"


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def model(clock: Clock | None = None, *names: str) -> FleetModel:
    made = FleetModel(clock or Clock())
    for name in names or ("arm-1",):
        made.update("dc", name, kind="strands_robot", expected=True)
    return made


def rows(fleet: FleetModel, since: int = 0) -> list[dict[str, Any]]:
    message = fleet.changes(since, since)[1]
    found: list[dict[str, Any]] = json.loads(message)["rows"] if message else []
    return found


def locked_by(*epochs: str, at: float = 101.0) -> LockoutReport:
    lockouts = tuple(Lockout(epoch, "safety-1", "a hand", 5.0) for epoch in epochs)
    return LockoutReport("arm-1", lockouts, facts={"locked": bool(lockouts)}, at=at)


def test_page_gets_only_what_changed_since_its_last_message() -> None:
    fleet = model(None, "arm-1", "arm-2")
    number, _ = fleet.changes(0)
    assert fleet.changes(number) == (number, "")
    fleet.task("dc", "arm-2", state="running", instruction="wave")
    assert [row["id"] for row in json.loads(fleet.changes(number)[1])["rows"]] == ["arm-2"]


@pytest.mark.parametrize("left", [float("nan"), float("inf"), -float("inf"), 10**400, "soon", None])
def test_impossible_time_of_a_check_in_ends_no_message_of_the_page(left: Any) -> None:
    fleet = model()
    fleet.report("dc", LockoutReport("arm-1", facts={"check_in": {"required": True, "time_left_s": left}}))
    assert rows(fleet)[0]["check_in"] == {"left_s": 0.0}


def test_steps_and_signs_of_life_are_left_for_the_slow_turn() -> None:
    fleet = model()
    fleet.task("dc", "arm-1", state="running", step=1)
    number, _ = fleet.changes(0)
    fleet.task("dc", "arm-1", state="running", step=2)
    fleet.sign_of_life("dc", "arm-1", 3.0)
    assert fleet.changes(number)[1] == ""
    assert json.loads(fleet.changes(number, number)[1])["rows"][0]["task"]["step"] == 2


def test_unproven_lockout_state_is_unknown_and_never_free() -> None:
    fleet = model()
    fleet.report("dc", locked_by())
    assert rows(fleet)[0]["locked"] is False
    fleet.report("dc", LockoutReport("arm-1", (), "its answer is only claimed: it is not signed", {"locked": False}))
    row = rows(fleet)[0]
    assert (row["locked"], row["doubt"]) == (None, "its answer is only claimed: it is not signed")


def test_alarm_about_a_lockout_state_is_kept_as_one() -> None:
    fleet = model()
    fleet.report("dc", LockoutReport("arm-1", (), "ALARM: wrong key", {"locked": False}))
    assert rows(fleet)[0]["alarm"] is True


def test_answer_to_a_stop_counts_for_the_past_once_the_robot_is_freed() -> None:
    fleet = model()
    fleet.verdict("dc", "arm-1", {"id": EPOCH, "state": "stopped"})
    # The status was asked before the stop arrived.
    fleet.report("dc", locked_by())
    assert "freed" not in rows(fleet)[0]["stop"]
    fleet.report("dc", locked_by(EPOCH))
    fleet.report("dc", locked_by())
    assert rows(fleet)[0]["stop"]["freed"] is True


def test_a_new_stop_is_not_freed_by_the_resume_of_the_last() -> None:
    fleet = model()
    fleet.verdict("dc", "arm-1", {"id": EPOCH, "state": "stopped"})
    fleet.report("dc", locked_by(EPOCH))
    fleet.report("dc", locked_by())
    fleet.verdict("dc", "arm-1", {"id": "f" * 32, "state": "not_stopped"})
    assert rows(fleet)[0]["stop"] == {"id": "f" * 32, "state": "not_stopped"}


def test_robot_is_forgotten_only_after_it_was_silent() -> None:
    clock = Clock()
    fleet = model(clock)
    fleet.sign_of_life("dc", "arm-1")
    assert not fleet.forget("dc:arm-1", 5.0)
    clock.now += 6.0
    assert fleet.forget("dc:arm-1", 5.0)
    assert fleet.expected("dc") == ()
    assert json.loads(fleet.changes(0)[1])["gone"] == ["dc:arm-1"]


def test_invented_names_use_bounded_memory(monkeypatch: Any) -> None:
    monkeypatch.setattr(fleet_model, "ROBOTS_MAX", 3)
    fleet = model(None, *(f"arm-{number}" for number in range(10)))
    assert len(fleet.rows()) == 3


def test_text_of_a_robot_is_cut_and_holds_no_control_characters() -> None:
    fleet = model()
    fleet.task("dc", "arm-1", state="running", instruction="\x1b[2J" + "x" * 5000)
    fleet.note("dc", "arm-1", "e\n", {"a": float("nan"), "b": {"deep": [1] * 1000}})
    message = fleet.changes(0)[1]
    assert len(message) < 5000
    assert "\\u001b" not in message and "NaN" not in message.replace('"nan"', "")


def test_joints_are_kept_for_thirty_seconds_and_are_finite_numbers() -> None:
    clock = Clock()
    fleet = model(clock)
    for step in range(400):
        clock.now += 0.1
        fleet.observe("dc", "arm-1", {"pan": float(step), "bad": float("inf"), "text": "x"})
    details = fleet.details("dc:arm-1")
    assert details is not None
    assert len(details["history"]) == 300
    assert details["history"][-1][1] == {"": {"pan": 399.0}}
    assert fleet.joints("dc:arm-1", clock.now) is None


def held_by(holder: str) -> LockoutReport:
    return LockoutReport("arm-1", facts={"control": {"held": bool(holder), "holder": holder, "kind": "agent"}})


def events(fleet: FleetModel) -> list[str]:
    return [each["event"] for each in json.loads(fleet.changes(0)[1])["events"]]


def test_changes_of_control_are_events_once() -> None:
    clock = Clock()
    fleet = model(clock)
    for holder in ("", "agent-a", "agent-a", "agent-b"):
        fleet.report("dc", held_by(holder))
    assert events(fleet) == ["control acquired", "control changed"]
    fleet.note("dc", "arm-1", "controlTaken", {"holder": "desk-1"})
    fleet.report("dc", held_by("desk-1"))
    assert events(fleet)[2:] == ["controlTaken"], "the robot told it by an event"
    clock.now += 10
    fleet.report("dc", held_by(""))
    assert events(fleet)[3:] == ["control released"]


def test_report_that_says_less_of_the_same_task_takes_nothing_away() -> None:
    model = FleetModel()
    model.update("mesh", "sim-1")
    model.task("mesh", "sim-1", state="running", instruction="wave", step=3, who="left")
    changed = model.changes(0)[0]
    model.task("mesh", "sim-1", state="running", instruction="wave")
    row = model.row("mesh:sim-1")
    assert row is not None
    assert row.task == {"state": "running", "instruction": "wave", "step": 3, "who": "left"}
    assert row.changed <= changed, "nothing that the page shows at once has changed"
    model.task("mesh", "sim-1", state="idle", instruction="")
    assert row.task == {"state": "idle", "instruction": ""}
