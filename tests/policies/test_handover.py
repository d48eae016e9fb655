"""A leader elsewhere and a policy in turns: who drives, what is refused, and no jump between them."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy

from strands_robots.policies.base import PolicyError
from strands_robots.policies.handover import LOST_S, Lead, LeaderCommand, LedPolicy

RANGES = {"pan": (-1.0, 1.0), "lift": (-2.0, 2.0)}
PERIOD = 0.02
STEP = 2.0 * 2.0 * PERIOD
"""What ``pan`` may move in a beat: two of its ranges a second."""


class Seat:
    """An operator's place: a leader, its link without a delay, and a robot that is where it was told to be."""

    def __init__(self, policy: Any = None, **how: Any) -> None:
        self.at = 100.0
        self.lead = Lead("hand", policy=policy is not None, now=lambda: self.at)
        self.policy = LedPolicy(self.lead, policy, max_speed=2.0, period=PERIOD, **how)
        self.policy.reset("wave", RANGES)
        self.joints = {"pan": 0.0, "lift": 0.0}
        self.seq = 0

    def send(self, turn: int, *, leads: bool = True, late_s: float = 0.0, **more: Any) -> None:
        action = {name: more.pop(name) for name in RANGES if name in more}
        self.seq = more.pop("seq", self.seq + 1)
        made = self.at - late_s
        self.lead.take(LeaderCommand(self.seq, turn, leads, action, made, made, **more), self.at)

    def beat(self, seconds: float = PERIOD) -> Any:
        self.at += seconds
        action = self.policy.act(self.joints)
        if isinstance(action, dict):
            self.joints |= action
            self.policy.wrote(action)
        return action

    def led(self, turn: int, count: int = 1, **joints: Any) -> Any:
        for _ in range(count):
            self.send(turn, **joints)
            action = self.beat()
        return action


def test_robot_holds_until_its_leader_takes_over() -> None:
    seat = Seat()
    assert seat.beat() == []
    assert seat.led(1, pan=0.01) == {"pan": 0.01, "lift": 0.0}, "what it does not lead keeps its place"
    assert (seat.lead.state, seat.policy.led_by) == ("led", ""), "it has taken over from no policy"


def test_follower_goes_to_a_leader_that_stands_apart_without_a_jump() -> None:
    seat = Seat()
    positions = [seat.led(1, pan=0.9)["pan"] for _ in range(20)]
    steps = [after - before for before, after in zip([0.0, *positions], positions, strict=False)]
    assert max(steps) <= STEP + 1e-9
    assert positions[-1] == pytest.approx(0.9)


def test_differences_begin_where_the_robot_is() -> None:
    seat = Seat(guide="differences")
    seat.joints["pan"] = 0.3
    assert seat.led(1, pan=-0.8)["pan"] == pytest.approx(0.3)
    assert seat.led(1, pan=-0.75)["pan"] == pytest.approx(0.35)


def test_leader_that_runs_beyond_the_range_turns_around_at_once() -> None:
    seat = Seat(guide="differences")
    seat.joints["pan"] = 0.98
    seat.led(1, pan=0.0)
    assert seat.led(1, pan=0.07)["pan"] == 1.0
    assert seat.led(1, pan=0.06)["pan"] == pytest.approx(0.99)


@pytest.mark.parametrize("guide", ["positions", "differences"])
def test_joint_beyond_its_range_is_held_there_and_comes_back_without_a_jump(guide: str) -> None:
    seat = Seat(guide=guide)
    seat.joints["pan"] = 1.5
    seat.led(1, count=3, pan=1.5, lift=0.0)
    assert seat.joints["pan"] == 1.5, "a grip does not move it"
    seat.beat(0.5)
    assert (seat.lead.state, seat.joints["pan"]) == ("held", 1.5), "nor does a hold"
    seat.led(1, pan=1.6)
    seat.led(2, pan=1.6)
    assert seat.led(2, pan=1.9)["pan"] == 1.5, "no leader leads it further out"
    back = [seat.led(2, pan=1.9 - 0.05 * beat)["pan"] for beat in range(1, 30)]
    assert max(abs(after - before) for before, after in zip([1.5, *back], back, strict=False)) <= STEP + 1e-9
    assert seat.led(2, pan=1.9)["pan"] <= 1.0, "and not out again"


def test_leader_takes_over_from_a_policy_and_its_plan_is_dropped() -> None:
    policy = ScriptedPolicy([[{"pan": 0.1}, {"pan": 0.2}, {"pan": 0.3}], {"pan": -0.1}])
    seat = Seat(policy)
    seat.send(0, leads=False)
    assert seat.beat() == {"pan": 0.1}
    assert seat.led(1, lift=0.01) == {"lift": 0.01, "pan": 0.1}
    assert seat.policy.led_by == "hand"
    seat.send(2, leads=False)
    assert seat.beat() == {"pan": -0.1}, "nothing of the chunk from before is played"
    assert policy.instructions == ["wave", "wave"], "it begins anew from what is"
    assert seat.policy.led_by == ""


def test_silence_holds_within_a_beat_and_only_a_new_turn_goes_on() -> None:
    seat = Seat()
    seat.led(1, count=20, pan=0.5)
    held = next(action for action in iter(seat.beat, None) if seat.lead.state == "held")
    assert held == seat.joints
    assert "no fresh command of hand" in seat.lead.why
    assert seat.led(1, pan=-0.5) == held, "the turn is over, and the place is kept"
    assert seat.lead.counts.unled == 1
    assert seat.led(2, pan=0.49)["pan"] == pytest.approx(0.5 - 0.01, abs=STEP)


@pytest.mark.parametrize("wrong", [-0.9, 0.9])
@pytest.mark.parametrize("when", ["at the hold", "before it"])
def test_one_wrong_reading_moves_neither_a_held_robot_nor_one_that_is_taken_over(wrong: float, when: str) -> None:
    seat = Seat()
    seat.led(1, count=5, pan=0.2)
    seat.joints["pan"] = wrong
    if when == "before it":
        assert seat.led(1, pan=0.2)["pan"] == 0.2
    assert seat.beat(0.5)["pan"] == 0.2
    seat.joints["pan"] = wrong
    assert seat.led(2, pan=0.2)["pan"] == 0.2, "its first action goes from where it is"


def test_what_comes_late_again_or_in_the_wrong_order_moves_nothing() -> None:
    seat = Seat()
    seat.led(1, count=5, pan=0.1)
    before = dict(seat.joints)
    seat.send(1, pan=-1.0, late_s=0.2)
    seat.send(1, pan=-1.0, seq=6)
    seat.send(1, pan=-1.0, seq=2)
    seat.beat()
    assert seat.joints == before
    assert (seat.lead.counts.disordered, seat.lead.counts.stale) == (2, 1)


def test_old_picture_holds_and_a_new_turn_with_a_fresh_one_goes_on() -> None:
    seat = Seat()
    seat.led(1, pan=0.1, picture_age_s=0.1)
    seat.led(1, pan=0.2, picture_age_s=0.4)
    assert (seat.lead.state, seat.lead.why) == ("held", "the newest picture of hand is 400 ms old")
    seat.led(1, pan=0.2, picture_age_s=0.1)
    assert seat.lead.state == "held"
    seat.led(2, pan=0.2, picture_age_s=0.1)
    assert seat.lead.state == "led"
    seat.send(3, pan=0.2, picture_age_s=9.0)
    seat.send(3, pan=0.2, picture_age_s=0.0)
    assert seat.lead.state == "held", "a turn that began with an old picture is over"


def test_policy_whose_leader_is_silent_holds_too() -> None:
    seat = Seat(ScriptedPolicy([], always={"pan": 0.1}))
    seat.send(0, leads=False)
    seat.beat()
    seat.beat(0.2)
    assert seat.lead.state == "held"
    seat.send(0, leads=False)
    assert seat.beat() == {"pan": 0.1, "lift": 0.0}, "it keeps its place"
    seat.send(1, leads=False)
    assert seat.beat() == {"pan": 0.1}


def test_leader_that_stays_silent_is_given_up() -> None:
    seat = Seat()
    seat.led(1, pan=0.1)
    seat.beat(1.0)
    with pytest.raises(PolicyError, match="hand has been silent for 10 s"):
        seat.beat(LOST_S)


def test_leader_that_ends_it_completes_the_rollout() -> None:
    seat = Seat()
    seat.led(1, pan=0.1)
    seat.lead.end("")
    assert seat.beat() is None


def test_unknown_joint_holds_the_robot_and_is_named() -> None:
    seat = Seat()
    seat.led(1, pan=0.1)
    seat.send(1, pan=0.1)
    seat.lead.take(LeaderCommand(9, 1, True, {"neck": 1.0}, seat.at, seat.at), seat.at)
    seat.beat()
    assert seat.lead.state == "held"
    assert "action has no key 'neck'" in seat.lead.why


def test_stationary_policy_without_a_leader_waits_for_its_first_command() -> None:
    seat = Seat(ScriptedPolicy([], always={"pan": 0.1}))
    assert seat.beat() == {"pan": 0.1}
    seat.beat(2.5)
    assert seat.lead.state == "held"


def test_turn_that_was_begun_in_the_silence_is_no_answer_to_the_hold() -> None:
    seat = Seat()
    seat.led(1, pan=0.1)
    seat.at += 5.0
    seat.send(2, pan=0.9)
    assert seat.beat() == seat.joints
    assert seat.lead.state == "held", "it was gripped before anybody could know of the hold"
    assert "has come for 50" in seat.lead.why
    seat.led(3, pan=0.9)
    assert seat.lead.state == "led"


def test_policy_is_not_given_the_robot_by_somebody_who_was_cut_off() -> None:
    seat = Seat(ScriptedPolicy([], always={"pan": 0.5}))
    seat.send(0, leads=False)
    seat.beat()
    seat.led(1, pan=0.5)
    seat.at += 1.0
    seat.send(2, leads=False)
    seat.beat()
    assert seat.lead.state == "held"


def test_answer_of_a_policy_that_took_longer_than_its_leader_waited_moves_nothing() -> None:
    def late() -> dict[str, float]:
        seat.send(1, pan=0.05)
        return {"pan": 0.9}

    seat = Seat(ScriptedPolicy([late, None]))
    assert seat.beat() == []
    assert seat.beat() == {"pan": 0.05, "lift": 0.0}

    def silent() -> None:
        seat.at += 5.0

    seat = Seat(ScriptedPolicy([{"pan": 0.1}, silent]))
    seat.send(0, leads=False)
    seat.beat()
    assert seat.beat() == [], "the end of a policy whose leader is gone is no completed task"
    assert seat.lead.state == "held"


def test_joint_that_the_robot_does_not_tell_is_bounded_from_where_it_was_sent() -> None:
    seat = Seat()
    seat.led(1, pan=0.0)
    seat.policy.wrote({"pan": 0.0, "lift": 0.0})
    del seat.joints["pan"]
    seat.policy.lead.hold("test")
    assert seat.beat() == {"lift": 0.0}
    assert seat.led(2, pan=0.9)["pan"] == pytest.approx(STEP)


def test_lead_that_is_over_keeps_no_policy() -> None:
    inner = ScriptedPolicy([], always={"pan": 0.1})
    seat = Seat(inner)
    before = sys.getrefcount(inner)
    seat.policy.close()
    assert inner.closed == 1
    assert sys.getrefcount(inner) < before
    seat.policy.close()
    assert inner.closed == 1
