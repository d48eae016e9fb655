"""The control loop: rate, ends, events, and no write after a stop."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from typing import Any

import pytest
from fixtures.bodies import RecordingBody, ScriptedPolicy, StepClock
from fixtures.waiting import eventually

from strands_robots.contract import RolloutEvent
from strands_robots.policies.rollout import Clock, Rollout, RolloutObservers, rollout_options
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.process import SWITCH_S
from strands_robots.utils import ValidationError


def rollout(body: RecordingBody, policy: Any, gate: MotionGate | None = None, **more: Any) -> Rollout:
    more.setdefault("hz", 200.0)
    return Rollout(body, policy, permit=(gate or MotionGate()).permit("test"), instruction="wave", **more)


def run(policy: Any, **more: Any) -> tuple[Rollout, RecordingBody]:
    body = RecordingBody()
    one = rollout(body, policy, clock=more.pop("clock", StepClock()), **more)
    one.run()
    return one, body


def test_policy_that_is_done_completes_the_rollout_and_the_body_holds() -> None:
    policy = ScriptedPolicy([{"a": 0.1}, {"a": 0.2}])
    one, body = run(policy)
    assert (one.state, one.step_count, one.error) == ("completed", 2, "")
    assert [action for _, action in body.writes] == [{"a": 0.1}, {"a": 0.2}]
    assert (body.holds, policy.closed, policy.instructions) == (1, 1, ["wave"])


def test_rollout_ends_after_its_duration() -> None:
    one, body = run(ScriptedPolicy([], always={"a": 0.5}), duration=1.0, hz=10.0)
    assert (one.state, one.step_count) == ("completed", 10)
    assert one.elapsed_s == pytest.approx(1.0)
    assert body.holds == 1


def test_rollout_ends_after_its_steps() -> None:
    one, body = run(ScriptedPolicy([], always={"a": 0.5}), duration=9.0, steps=3)
    assert (one.state, one.step_count, len(body.writes), body.holds) == ("completed", 3, 3, 1)


def test_no_thread_keeps_the_interpreter_for_long_while_a_rollout_runs() -> None:
    before, during = sys.getswitchinterval(), list[float]()

    class Looking(ScriptedPolicy):
        def act(self, observation: Any) -> Any:
            during.append(sys.getswitchinterval())
            return super().act(observation)

    run(Looking([{"a": 0.1}]))
    assert max(during) <= SWITCH_S * 1.01
    assert sys.getswitchinterval() == before


def test_rollout_options_takes_rate_and_steps_out_of_the_policy_options() -> None:
    options = {"control_frequency": 20, "n_steps": 7, "policy_port": 5000}
    task = {"instruction": "wave", "duration": 3.0}
    assert rollout_options("wave", 3, options, 50.0) == {**task, "hz": 20.0, "steps": 7}
    assert options == {"policy_port": 5000}
    assert rollout_options("wave", 3, {}, 50.0) == {**task, "hz": 50.0, "steps": None}


@pytest.mark.parametrize(
    "option", [{"control_frequency": 50.1}, {"control_frequency": 0}, {"n_steps": 0}, {"n_steps": 2.0}]
)
def test_bad_rate_or_steps_are_refused(option: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(option))):
        rollout_options("wave", 3, option, 50.0)


def test_ticks_are_at_absolute_times_and_missed_ticks_are_dropped() -> None:
    clock = StepClock()
    clock.late = {3: 0.25}
    one, _ = run(ScriptedPolicy([], always={"a": 0.5}), duration=1.0, hz=10.0, clock=clock)
    assert clock.waits == pytest.approx([100.1, 100.2, 100.3, 100.6, 100.7, 100.8, 100.9, 101.0])
    assert (one.step_count, one.missed_ticks) == (8, 2)


def test_chunk_is_played_one_action_a_step_and_an_empty_chunk_skips_a_step() -> None:
    policy = ScriptedPolicy([[{"a": 0.1}, {"a": 0.2}], [], {"a": 0.3}])
    clock = StepClock()
    one, body = run(policy, clock=clock)
    assert [action["a"] for _, action in body.writes] == [0.1, 0.2, 0.3]
    assert one.step_count == 3
    assert len(policy.observations) == 4
    assert len(clock.waits) == 4


@pytest.mark.parametrize(
    "decision",
    [
        RuntimeError("no idea"),
        {"a": float("nan")},
        {"a": float("inf")},
        {"a": True},
        {"a": "0.5"},
        {"b": 0.5},
        {7: 0.5},
        [{"a": 0.1}, "nonsense"],
        5,
    ],
    ids=repr,
)
def test_failing_policy_or_bad_action_ends_in_error_and_the_body_holds(decision: Any) -> None:
    policy = ScriptedPolicy([{"a": 0.1}, decision])
    one, body = run(policy)
    assert one.state == "error"
    assert one.error
    assert body.holds == 1
    assert policy.closed == 1
    assert body.writes[0][1] == {"a": 0.1}
    assert len(body.writes) <= 2


def test_target_beyond_the_range_is_clamped() -> None:
    _, body = run(ScriptedPolicy([{"a": 7.0}]))
    assert body.writes[0][1] == {"a": 1.0}


def test_failing_reset_ends_in_error_and_closes_the_policy() -> None:
    class NoCheckpoint(ScriptedPolicy):
        def reset(self, instruction: str, ranges: Any) -> None:
            raise FileNotFoundError("no such checkpoint")

    policy = NoCheckpoint([])
    one, body = run(policy)
    assert one.state == "error"
    assert "no such checkpoint" in one.error
    assert (policy.closed, body.writes) == (1, [])


def test_failing_write_ends_in_error_and_the_body_holds() -> None:
    body = RecordingBody()

    def broken() -> None:
        raise ConnectionError("Failed to sync write")

    body.before_write = broken
    one = rollout(body, ScriptedPolicy([{"a": 0.1}]), clock=StepClock())
    one.run()
    assert one.state == "error"
    assert "Failed to sync write" in one.error
    assert body.holds == 1


def test_failing_hold_ends_in_error_that_names_it() -> None:
    class Wedged(RecordingBody):
        def hold(self, permit: Any = None) -> None:
            raise ConnectionError("dead servo 3")

    one = rollout(Wedged(), ScriptedPolicy([]), clock=StepClock())
    one.run()
    assert one.state == "error"
    assert "hold failed" in one.error


def test_observers_get_started_each_step_and_finished() -> None:
    seen: list[RolloutEvent] = []
    observers = RolloutObservers()
    observers.subscribe(seen.append)
    run(ScriptedPolicy([{"a": 0.1}, {"a": 0.2}]), observers=observers, policy_name="scripted")
    assert [event.kind for event in seen] == ["started", "step", "step", "finished"]
    assert [event.step for event in seen] == [0, 1, 2, 2]
    assert seen[1].observation == {"a": 0.25}
    assert seen[1].action == {"a": 0.1}
    assert (seen[-1].state, seen[-1].policy, seen[-1].robot) == ("completed", "scripted", "body")


def test_raising_observer_affects_neither_the_loop_nor_the_others(caplog: pytest.LogCaptureFixture) -> None:
    def broken(event: RolloutEvent) -> None:
        raise RuntimeError("observer broke")

    seen: list[RolloutEvent] = []
    observers = RolloutObservers()
    observers.subscribe(broken)
    observers.subscribe(seen.append)
    one, _ = run(ScriptedPolicy([{"a": 0.1}] * 5), observers=observers)
    assert one.state == "completed"
    assert len(seen) == 7
    assert len([record for record in caplog.records if record.name == "strands_robots.contract"]) == 1


def test_unsubscribed_observer_gets_no_events() -> None:
    seen: list[RolloutEvent] = []
    observers = RolloutObservers()
    first, second = observers.subscribe(seen.append), observers.subscribe(seen.append)
    first()
    first()
    observers.notify(RolloutEvent("started", "r", "i", "p"))
    assert len(seen) == 1
    second()
    observers.notify(RolloutEvent("started", "r", "i", "p"))
    assert len(seen) == 1


def test_stop_ends_the_loop_at_once() -> None:
    body, policy = RecordingBody(), ScriptedPolicy([], always={"a": 0.5})
    # A step in a hundred seconds: what ends sooner was woken.
    one = rollout(body, policy, hz=0.01)
    one.start()
    eventually(lambda: body.writes)
    one.request_stop()
    assert one.join(20)
    assert (one.state, one.running, body.holds) == ("stopped", False, 1)
    assert policy.interrupted.is_set()


def test_loop_that_outlives_its_stop_is_not_reported_stopped_and_writes_nothing() -> None:
    thinks, go_on = threading.Event(), threading.Event()
    body = RecordingBody()

    def thinking() -> dict[str, float]:
        thinks.set()
        go_on.wait(60)
        return {"a": 0.9}

    one = rollout(body, ScriptedPolicy([{"a": 0.1}, thinking], always={"a": 0.9}))
    one.start()
    assert thinks.wait(20)
    one.request_stop()
    assert one.ended_by(time.monotonic() + 0.05)["stopped"] is False
    assert one.running
    written = len(body.writes)
    go_on.set()
    assert one.join(20)
    assert len(body.writes) == written
    assert one.state == "stopped"


def test_nothing_is_written_after_a_halt_has_passed_the_lock() -> None:
    for _ in range(30):
        gate, body = MotionGate(), RecordingBody()
        one = rollout(body, ScriptedPolicy([], always={"a": 0.5}), gate, hz=2000.0)
        one.start()
        eventually(lambda body=body: len(body.writes) > 3)
        gate.revoke()
        with body.lock:
            verdict = time.monotonic()
        assert one.join(20)
        assert not [moment for moment, _ in body.writes if moment > verdict]
        assert one.state == "stopped"
        assert body.holds == 0, "a halt freezes the body itself"


class RecordingClock(Clock):
    """The real clock, with a record of each wait and its end."""

    def __init__(self) -> None:
        self.waits: list[tuple[float, float]] = []

    def wait(self, until: float, stop: threading.Event) -> None:
        super().wait(until, stop)
        self.waits.append((until, self.now()))


def test_rollout_keeps_its_rate_on_the_real_clock() -> None:
    body, clock = RecordingBody(), RecordingClock()
    one = rollout(body, ScriptedPolicy([], always={"a": 0.5}), hz=100.0, duration=0.5, clock=clock)
    before = clock.now()
    one.start()
    assert one.join(20)
    dues = [until for until, _ in clock.waits]
    ticks = [(due - dues[0]) * 100 for due in dues]
    assert ticks == pytest.approx([round(tick) for tick in ticks], abs=1e-3), "every tick is a multiple of the period"
    assert all(later > sooner for sooner, later in itertools.pairwise(dues)), "what was missed is not made up"
    assert all(over >= until for until, over in clock.waits)
    # However late the machine was, each tick until the last was a step or was missed.
    ticked = one.step_count + one.missed_ticks
    assert (dues[-1] - body.writes[0][0]) * 100 - 1e-3 <= ticked <= (dues[-1] - before) * 100 + 1e-3
    assert one.elapsed_s >= 0.5


def test_thread_has_the_name_of_the_robot() -> None:
    hold = threading.Event()
    one = rollout(RecordingBody(), ScriptedPolicy([lambda: hold.wait(60) and None]))
    one.start()
    assert "rollout-body" in [thread.name for thread in threading.enumerate()]
    hold.set()
    assert one.join(20)


def test_observer_may_stop_its_own_rollout() -> None:
    observers = RolloutObservers()
    body = RecordingBody()
    one = rollout(body, ScriptedPolicy([], always={"a": 0.5}), observers=observers)
    ended: list[bool] = []

    def stop(event: RolloutEvent) -> None:
        if event.kind == "step":
            one.request_stop()
            ended.append(one.join())

    observers.subscribe(stop)
    one.start()
    assert one.join(20)
    assert ended == [False]
    assert len(body.writes) == 1


def test_policy_that_raises_system_exit_ends_in_error_and_the_body_holds() -> None:
    one, body = run(ScriptedPolicy([{"a": 0.1}, SystemExit("a library gave up")]))
    assert (one.state, body.holds) == ("error", 1)
    assert "SystemExit" in one.error


class Unready(ScriptedPolicy):
    """Cannot be made ready, or only when it is interrupted."""

    def __init__(self, problem: Exception | None = None) -> None:
        super().__init__([], always={"a": 1.0})
        self._problem = problem

    def reset(self, instruction: str, ranges: Any) -> None:
        if self._problem is not None:
            raise self._problem
        assert self.interrupted.wait(20)


def test_a_policy_that_is_not_ready_in_time_is_given_up_and_nothing_starts() -> None:
    body = RecordingBody()
    slow = rollout(body, Unready(), policy_name="slow")
    slow.start()
    assert "the policy slow was not ready in 0.05 s" in slow.not_begun(0.05)
    assert slow.join(20)
    assert body.writes == []


def test_a_policy_that_fails_at_once_is_told_with_its_reason() -> None:
    bare = rollout(RecordingBody(), Unready(OSError("no weights")), policy_name="bare")
    bare.start()
    assert "the policy bare failed: OSError: no weights" in bare.not_begun(20)
    assert bare.join(20)


def limited(policy: ScriptedPolicy, **late: float) -> tuple[Rollout, RecordingBody, StepClock]:
    body, clock = RecordingBody(), StepClock()
    body.speeds = {"a": 1.0}
    clock.late = {int(wait.removeprefix("wait")): seconds for wait, seconds in late.items()}
    return rollout(body, policy, clock=clock, hz=10.0), body, clock


def test_no_step_of_a_policy_is_faster_than_the_speed_limit_of_the_body() -> None:
    one, body, _ = limited(ScriptedPolicy([{"a": 1.0}, {"a": -1.0}, {"a": 0.2}]))
    one.run()
    assert [action["a"] for _, action in body.writes] == pytest.approx([0.35, 0.25, 0.2])
    assert (one.step_count, one.clamped_steps) == (3, 2)


def test_pause_adds_up_to_no_jump_under_a_speed_limit() -> None:
    one, body, _ = limited(ScriptedPolicy([{"a": 1.0}, {"a": 1.0}]), wait1=5.0)
    one.run()
    assert [action["a"] for _, action in body.writes] == pytest.approx([0.35, 0.45])


def test_action_that_was_held_back_is_carried_on_while_the_policy_waits() -> None:
    one, body, _ = limited(ScriptedPolicy([{"a": 0.5}, (), (), ()]))
    one.run()
    assert [action["a"] for _, action in body.writes] == pytest.approx([0.35, 0.45, 0.5])
    assert (one.step_count, one.clamped_steps) == (1, 1)


def test_finished_event_counts_the_clamped_steps() -> None:
    body, observers, events = RecordingBody(), RolloutObservers(), list[RolloutEvent]()
    body.speeds = {"a": 1.0}
    observers.subscribe(events.append)
    rollout(body, ScriptedPolicy([{"a": 1.0}]), clock=StepClock(), observers=observers).run()
    assert (events[-1].kind, events[-1].clamped_steps) == ("finished", 1)
