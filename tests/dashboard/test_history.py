"""The history of the fleet: states, samples, and their bounds."""

from __future__ import annotations

import json
from typing import Any

import pytest

from strands_robots.dashboard import history
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.history import CHANGES_MAX, SAMPLE_S, SAMPLES, WINDOW_S, States
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.safety.lockout import Lockout

START = 1000.0
EPOCH = "e" * 32


class Fleet:
    """A model at a time of its own, which the sampler visits as in the server."""

    def __init__(self, *names: str) -> None:
        self.now = START
        self.model = FleetModel(lambda: self.now)
        for name in names or ("arm-1",):
            self.model.update("dc", name, kind="strands_robot")
            self.model.sign_of_life("dc", name)

    def sample(self) -> None:
        self.model.sample(self.model.begin_sample())

    def wait(self, seconds: float, *heard: str) -> None:
        """Let time pass; some robots are heard twice a second."""
        end = self.now + seconds
        while self.now < end:
            self.now += 0.5
            for name in heard:
                self.model.sign_of_life("dc", name)
            if self.now % SAMPLE_S == 0:
                self.sample()

    def lock(self, locked: bool, name: str = "arm-1") -> None:
        lockouts = (Lockout(EPOCH, "safety-1", "a hand", self.now),) if locked else ()
        self.model.report("dc", LockoutReport(name, lockouts, facts={"locked": locked}, at=self.now))

    def states(self, name: str = "arm-1", number: int = 0, at: float = 0.0) -> list[tuple[float, str]]:
        """The seconds from the start, and the states that began then."""
        found = [json.loads(line) for line in self.model.states([f"dc:{name}"], number, at)]
        return [(start - START, state) for each in found for start, state in zip(each["at"], each["as"], strict=True)]

    def series(self, name: str = "arm-1", after: float = 0.0) -> dict[str, Any]:
        lines = self.model.series(f"dc:{name}", after)
        assert lines is not None
        head, *rest = (json.loads(line) for line in lines)
        return {"times": head["times"], "units": head["units"], **{each["name"]: each["values"] for each in rest}}


def test_robot_that_moves_stands_and_is_locked_has_an_interval_for_each() -> None:
    fleet = Fleet()
    fleet.wait(5, "arm-1")
    fleet.model.task("dc", "arm-1", state="running", instruction="wave", step=1)
    fleet.wait(5, "arm-1")
    fleet.model.task("dc", "arm-1", state="running", instruction="wave", step=90)
    fleet.lock(True)
    fleet.wait(1, "arm-1")
    fleet.model.task("dc", "arm-1", state="idle")
    fleet.wait(9, "arm-1")
    fleet.lock(False)
    assert fleet.states() == [(0, "s"), (5, "m"), (10, "x"), (11, "l"), (20, "s")]


def test_silence_begins_at_the_last_sign_of_life_and_ends_at_the_next() -> None:
    fleet = Fleet()
    fleet.wait(10, "arm-1")
    fleet.wait(20)
    assert fleet.states() == [(0, "s"), (10, "q")]
    fleet.model.task("dc", "arm-1", state="running")
    assert fleet.states()[-1] == (10, "q"), "a robot that nobody hears shows nothing new"
    fleet.model.sign_of_life("dc", "arm-1")
    assert fleet.states() == [(0, "s"), (10, "q"), (30, "m")]


def test_silence_between_two_samples_is_noticed_by_the_message_that_ends_it() -> None:
    fleet = Fleet()
    fleet.now += 4.0
    fleet.model.sign_of_life("dc", "arm-1")
    fleet.now += 2.9
    fleet.model.sign_of_life("dc", "arm-1")
    assert fleet.states() == [(0, "q"), (4, "s")]


def test_robot_that_was_never_heard_is_silent() -> None:
    fleet = Fleet()
    fleet.model.update("dc", "arm-2", kind="strands_robot")
    fleet.sample()
    assert fleet.states("arm-2") == [(0, "q")]


def test_unknown_lockout_is_not_shown_as_one() -> None:
    fleet = Fleet()
    fleet.model.update("dc", "arm-1", locked=None, doubt="its answer is only claimed")
    assert fleet.states() == [(0, "s")]


def test_page_asks_again_only_for_what_changed_with_the_state_in_force() -> None:
    fleet = Fleet("arm-1", "arm-2")
    fleet.wait(100, "arm-1", "arm-2")
    number, at = fleet.model.history.number, fleet.now
    assert fleet.states("arm-1", number, at) == []
    fleet.model.task("dc", "arm-1", state="running")
    assert fleet.states("arm-1", number, at) == [(0, "s"), (100, "m")]
    assert fleet.states("arm-2", number, at) == []
    fleet.wait(100, "arm-1", "arm-2")
    fleet.model.task("dc", "arm-1", state="idle")
    assert fleet.states("arm-1", number + 1, fleet.now) == [(100, "m"), (200, "s")]


def test_changes_are_kept_for_an_hour_with_the_state_in_force_at_its_start() -> None:
    states = States()
    for minute in range(90):
        states.enter("ms"[minute % 2], minute * 60.0)
    starts, letters = states.since(0.0)
    assert starts[0] == 89 * 60 - WINDOW_S
    assert len(starts) == len(letters) == 61


def test_robot_that_changes_all_the_time_keeps_the_newest_changes() -> None:
    states = States()
    for tick in range(5 * CHANGES_MAX):
        states.enter("ms"[tick % 2], tick * 0.01)
    starts, letters = states.since(0.0)
    assert len(starts) == len(letters) == CHANGES_MAX
    assert starts[-1] == (5 * CHANGES_MAX - 1) * 0.01


def test_state_without_duration_is_replaced_by_the_one_that_follows() -> None:
    states = States()
    for state, at in (("s", 0.0), ("m", 5.0), ("l", 5.0), ("s", 4.0), ("m", 9.0)):
        states.enter(state, at)
    assert states.since(0.0) == ([0.0, 9.0], "sm")


def test_samples_have_the_longest_silence_the_messages_and_the_joints() -> None:
    fleet = Fleet()
    fleet.sample()
    for pause in (0.25, 1.25, 0.25):
        fleet.now += pause
        fleet.model.sign_of_life("dc", "arm-1", 7.5)
    fleet.model.observe("dc", "arm-1", {"pan": 0.5})
    fleet.now += 0.25
    fleet.sample()
    found = fleet.series()
    assert found["times"] == [START, START + 2.0]
    assert found["lag"] == [0.0, 1250.0]
    assert found["rate"] == [None, 1.5]
    assert found["answer"] == [None, 7.5]
    assert found["load"] == [None, None], "nobody has told a load"
    assert found["joint:/pan"] == [None, 0.5]
    assert fleet.series(after=START)["lag"] == [1250.0]


def test_sample_is_sent_once_whatever_the_digits_of_its_time() -> None:
    fleet = Fleet()
    for _ in range(20):
        fleet.now += 2.0004567
        fleet.sample()
        last = fleet.series()["times"][-1]
        assert fleet.series(after=last)["times"] == []
    assert len(fleet.series(after=fleet.series()["times"][0])["times"]) == 19


def test_silent_robot_has_no_joints_and_its_lag_grows() -> None:
    fleet = Fleet()
    fleet.model.observe("dc", "arm-1", {"pan": 0.5})
    fleet.model.load("dc", "arm-1", 0.25)
    fleet.sample()
    fleet.now += 10.0
    fleet.sample()
    found = fleet.series()
    assert found["lag"] == [0.0, 10_000.0]
    assert (found["joint:/pan"], found["load"]) == ([0.5, None], [0.25, None])


def test_joints_that_were_told_long_ago_are_not_those_of_now() -> None:
    fleet = Fleet()
    fleet.model.observe("dc", "arm-1", {"pan": 0.5})
    fleet.sample()
    fleet.wait(20, "arm-1")
    assert fleet.series()["joint:/pan"][0] == 0.5
    assert fleet.series()["joint:/pan"][-1] is None


def test_robot_that_came_later_has_no_values_of_before() -> None:
    fleet = Fleet()
    fleet.sample()
    fleet.model.update("dc", "arm-2", kind="strands_robot")
    fleet.model.sign_of_life("dc", "arm-2")
    assert fleet.model.series("dc:arm-2", 0.0) is None
    fleet.now += 2.0
    fleet.sample()
    assert fleet.series("arm-2")["lag"] == [None, 2000.0]


def test_forgotten_robot_has_no_history_and_gives_its_joints_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "JOINTS_MAX", 1)
    fleet = Fleet("arm-1", "arm-2")
    fleet.model.observe("dc", "arm-1", {"pan": 0.5})
    fleet.sample()
    assert fleet.model.forget("dc:arm-1", 0.0)
    assert list(fleet.model.states(["dc:arm-1"], 0, 0.0)) == []
    assert fleet.model.series("dc:arm-1", 0.0) is None
    fleet.model.observe("dc", "arm-2", {"pan": 0.5})
    fleet.now += 2.0
    fleet.sample()
    assert "joint:/pan" in fleet.series("arm-2")


def test_joints_are_bounded_per_robot() -> None:
    fleet = Fleet()
    fleet.model.observe("dc", "arm-1", {f"j{number}": 1e300 for number in range(60)})
    fleet.sample()
    joints = [name for name in fleet.series() if name.startswith("joint:")]
    assert len(joints) == history.ROBOT_JOINTS_MAX
    assert fleet.series()["joint:/j0"] == [None]


def test_four_hundred_robots_at_ten_hertz_use_bounded_memory() -> None:
    # The clock is the test's own, so nothing waits. A robot's samples have their room from the first one on.
    names = [f"arm-{number}" for number in range(400)]
    fleet = Fleet(*names)
    for name in names:
        fleet.model.observe("dc", name, {f"j{number}": 0.5 for number in range(20)})
    fleet.sample()
    full = fleet.model.history.size_bytes
    # Ten changes a second of each robot, until their bound is reached and beyond it.
    for tick in range(CHANGES_MAX + 100):
        fleet.now += 0.1
        for name in names:
            fleet.model.task("dc", name, state="running" if tick % 2 else "idle")
            if tick % 20 == 0:
                fleet.model.sign_of_life("dc", name)
        if tick % 20 == 0:
            fleet.sample()
    assert fleet.model.history.size_bytes == full + 400 * 9 * (CHANGES_MAX - 1)
    assert fleet.model.history.size_bytes < 20 * 2**20


def test_samples_are_kept_for_a_quarter_of_an_hour() -> None:
    fleet = Fleet()
    fleet.sample()
    size = fleet.model.history.size_bytes
    fleet.wait(2 * SAMPLES * SAMPLE_S, "arm-1")
    times = fleet.series()["times"]
    assert len(times) == SAMPLES and times[-1] - times[0] == 900 - SAMPLE_S
    assert fleet.model.history.size_bytes == size
