"""A leader of this machine at a robot elsewhere: it takes over, gives back, and goes on after a hold."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.desk import desk
from fixtures.waiting import eventually

from strands_robots.cli.far_hand import Hand, HandLeader, LeadableHere
from strands_robots.cli.output import Screen
from strands_robots.errors import RobotError
from strands_robots.simulation import Simulation
from strands_robots.teleoperators import LeaderFinished, RecordedLeader
from strands_robots.utils import ValidationError


class Arm:
    """A leader that stands where a test puts it."""

    def __init__(self) -> None:
        self.at = {"shoulder_pan": 0.0, "of another arm": 1.0}
        self.gone: BaseException | None = None

    def get_action(self) -> dict[str, float]:
        if self.gone is not None:
            raise self.gone
        return dict(self.at)


class Desk:
    """A leader, and a simulated arm behind the verbs that any network carries."""

    def __init__(self, world: Simulation, *, asked: bool = True, **how: Any) -> None:
        self.world, self.arm = world, Arm()
        self.ends: list[tuple[str, bool]] = []
        self.told: list[str] = []
        self.lead = LeadableHere(world).lead("hand", **how)
        self.hand = Hand(
            self.lead,
            self.arm,
            moved=0.04,
            ended=lambda why, halted: self.ends.append((why, halted)),
            told=lambda state, why: self.told.append(state),
            asked=asked,
        )

    def pan(self) -> float:
        return self.lead.state.joints["shoulder_pan"]

    def until(self, state: str) -> None:
        eventually(lambda: self.told[-1:] == [state], what=f"{state}, after {self.told}")


@pytest.fixture
def world() -> Iterator[Simulation]:
    with desk() as made:
        yield made


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine is no silent leader here."""
    monkeypatch.setattr("strands_robots.cli.far_hand.GIVE_UP_S", 10.0)


POLICY = {"policy_provider": "mock", "instruction": "wave", "guide": "differences"}


def test_arm_follows_its_leader_and_only_the_joints_that_it_has(world: Simulation) -> None:
    desk = Desk(world)
    desk.until("led")
    desk.arm.at["shoulder_pan"] = 0.2
    eventually(lambda: desk.pan() == pytest.approx(0.2, abs=0.01))
    desk.hand.close()
    eventually(lambda: not world.teleoperating())
    assert desk.ends == []


def test_motion_of_the_leader_takes_over_from_the_policy_and_a_key_gives_back(world: Simulation) -> None:
    turns: list[tuple[str, str]] = []
    world.subscribe(lambda event: turns.append((event.state, event.led_by)) if event.kind == "turn" else None)
    desk = Desk(world, **POLICY)
    desk.until("policy")
    desk.arm.at["shoulder_pan"] = 0.05
    eventually(lambda: desk.lead.state.written)
    assert desk.told == ["policy"], "a leader that is touched has not taken over"
    desk.arm.at["shoulder_pan"] = 0.5
    desk.until("led")
    desk.hand.turn()
    desk.until("policy")
    desk.hand.turn()
    desk.until("led")
    desk.hand.close()
    assert turns == [("policy", "hand"), ("led", "hand"), ("policy", "hand"), ("led", "hand")]


def test_stop_of_others_ends_it_as_one(world: Simulation) -> None:
    desk = Desk(world)
    desk.until("led")
    world.halt("from elsewhere")
    eventually(lambda: desk.ends)
    ((why, halted),) = desk.ends
    assert halted
    assert "The lead of hand is over" in why
    desk.hand.close()


def test_lead_that_completes_at_the_robot_is_no_failure(world: Simulation) -> None:
    desk = Desk(world, duration=0.5, **POLICY)
    eventually(lambda: desk.ends)
    assert desk.ends == [("", False)]
    with pytest.raises(RobotError, match="The lead of hand is over: its policy is done, or its time"):
        eventually(lambda: desk.lead.send({}) is None)
    desk.hand.close()


def test_leader_that_ends_has_no_reason_and_one_that_fails_names_it(world: Simulation) -> None:
    for gone, why in ((LeaderFinished("over"), ""), (OSError("unplugged"), "OSError: unplugged")):
        desk = Desk(world)
        desk.until("led")
        desk.arm.gone = gone
        eventually(lambda ends=desk.ends: ends)
        assert desk.ends == [(why, False)]
        desk.hand.close()
        eventually(lambda: not world.teleoperating())


@pytest.mark.parametrize("asked", [True, False])
def test_hold_waits_for_a_person_and_a_leader_alone_goes_on(world: Simulation, asked: bool) -> None:
    desk = Desk(world, asked=asked)
    desk.until("led")

    def blind() -> bool:
        # The leader's own commands go on, and the newest wins.
        desk.lead.send({"shoulder_pan": 0.1}, picture_age_s=5.0)
        return "held" in desk.told

    eventually(blind)
    if asked:
        assert desk.told[-1] == "held"
        desk.hand.turn()
    desk.until("led")
    assert desk.ends == []
    desk.hand.close()


def test_recording_of_joints_that_the_robot_lacks_is_refused_before_it_leads(world: Simulation) -> None:
    recording = RecordedLeader([(0.0, {"shoulder_pan": 0.0}), (1.0, {"shoulder_pan": 0.2, "elbow": 0.2})])
    leader = HandLeader(Screen(), "run.csv", {}, None, recording)
    with pytest.raises(ValidationError, match="not elbow, which the leader leads"), leader.connected():
        leader.begin(LeadableHere(world), "", "wave", None, lambda why, halted: None)
    eventually(lambda: not world.teleoperating())
