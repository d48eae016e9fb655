"""The loop of a trained policy on a fake clock: prefetch, underrun, stop, hung inference, real-time chunking."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from fixtures.bodies import RecordingBody, StepClock
from fixtures.waiting import eventually

from strands_robots.contract import RolloutEvent
from strands_robots.policies.base import PolicyError, Ranges
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.policies.rollout import Rollout, RolloutObservers
from strands_robots.safety.gate import MotionGate

HZ = 30.0


class Counting:
    """Answers each request with a chunk that begins at 100 times its number."""

    uses_cameras = False

    def __init__(self, steps: int = 10) -> None:
        self.steps = steps
        self.asked: list[Mapping[str, Any]] = []
        self.closed = threading.Event()
        self.interrupted = threading.Event()

    def reset(self, instruction: str, ranges: Ranges) -> None: ...

    def act(self, observation: Mapping[str, Any]) -> Sequence[Mapping[str, float]] | None:
        self.asked.append(observation)
        first = 100 * (len(self.asked) - 1)
        return [{"a": (first + step) / 1000} for step in range(self.steps)]

    def interrupt(self) -> None:
        self.interrupted.set()

    def close(self) -> None:
        self.closed.set()


class Continuing(Counting):
    """Notes what it is told for real-time chunking."""

    continues = True

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[int, int]] = []

    def act_on(self, observation: Mapping[str, Any], *, played: int, delay: int) -> Any:
        self.told.append((played, delay))
        return super().act(observation)


class Hung(Counting):
    """Answers its first request, and hangs in the second until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.let_go = threading.Event()
        self.hangs = threading.Event()

    def act(self, observation: Mapping[str, Any]) -> Any:
        if self.asked:
            self.hangs.set()
            assert self.let_go.wait(60)
        return super().act(observation)


def made(inner: Any, clock: StepClock | None = None, *, latency_s: float = 0.0, **changed: Any) -> ProfiledPolicy:
    entries = {"url": "ws://localhost", "rate": HZ, "max_speed": None, "confirmed": frozenset({"units"})} | changed
    profile = Profile("pick", "remote", ("a",), ("a",), **entries)
    policy = ProfiledPolicy(profile, inner)
    if clock is not None:
        policy.compute_inline(clock.now, latency_s)
    policy.fit(RobotFacts("body", {"a": 0.0}, ["a"], rate=HZ))
    return policy


def run(policy: ProfiledPolicy, clock: StepClock, **more: Any) -> tuple[Rollout, list[int]]:
    """Run a rollout; the values written, in thousandths."""
    body = RecordingBody()
    one = Rollout(body, policy, permit=MotionGate().permit("test"), hz=HZ, clock=clock, **more)
    one.run()
    return one, [round(1000 * action["a"]) for _, action in body.writes]


def test_the_next_chunk_is_asked_for_while_one_plays_and_no_step_is_empty() -> None:
    clock = StepClock()
    policy = made(Counting(), clock, latency_s=0.1)
    one, written = run(policy, clock, steps=30)
    # Asked at step 6, there at step 9: steps 6 to 8 of the answer are stale, so it goes on with its fourth.
    assert written[:12] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 103, 104, 105]
    assert len(written) == 30
    counts = one.counts
    assert (counts["underruns"], counts["stale_actions"] % 3) == (0, 0)
    assert counts["latency_max_ms"] == pytest.approx(100)
    assert counts["chunk_age_max_s"] < 0.4


def test_the_first_inference_is_outside_the_duration() -> None:
    clock = StepClock()
    policy = made(Counting(), clock, latency_s=0.5)
    _, written = run(policy, clock, duration=1.0)
    assert clock.time - 100.0 == pytest.approx(1.5, abs=0.1)
    assert len(written) == pytest.approx(15, abs=1), "a chunk of ten, half a second without, and half a chunk"


def test_on_underrun_the_robot_keeps_its_place_and_it_is_counted_and_said(caplog: pytest.LogCaptureFixture) -> None:
    clock, body = StepClock(), RecordingBody()
    policy = made(Counting(steps=3), clock, latency_s=0.2)
    events: list[RolloutEvent] = []
    observers = RolloutObservers()
    observers.subscribe(events.append)
    one = Rollout(body, policy, permit=MotionGate().permit("test"), hz=HZ, clock=clock, duration=1.0)
    one._observers = observers
    one.run()
    assert one.state == "completed"
    counts = events[-1].loop
    assert counts["underruns"] >= 2
    assert counts["underrun_steps"] + one.step_count == pytest.approx(30, abs=1)
    assert "no action in time" in caplog.text
    assert all(0 <= 1000 * action["a"] % 100 < 3 for _, action in body.writes), "nothing but actions of chunks"


def test_a_velocity_is_told_to_be_zero_on_underrun() -> None:
    clock = StepClock()
    profile = Profile("drive", "remote", ("x.vel",), ("x.vel",), url="ws://localhost", rate=HZ, max_speed=None)

    class Drives(Counting):
        def act(self, observation: Mapping[str, Any]) -> Any:
            return [{"x.vel": 0.5}]

    policy = ProfiledPolicy(profile, Drives())
    policy.compute_inline(clock.now, 0.2)
    policy._scale, policy._hz = {"x.vel": 1.0}, HZ
    policy.reset("drive", {"x.vel": (-1.0, 1.0)})
    written = []
    for _ in range(12):
        written.append(policy.act({"x.vel": 0.0}))
        clock.time += 1 / HZ
    assert {"x.vel": 0.5} in written
    assert written[written.index({"x.vel": 0.5}) + 1] == {"x.vel": 0.0}


def test_a_missed_control_step_skips_its_action() -> None:
    clock = StepClock()
    clock.late = {3: 2.4 / HZ}
    _, written = run(made(Counting(steps=20), clock, horizon=20), clock, steps=6)
    # The fourth step comes more than two steps late, which is noticed after it.
    assert written == [0, 1, 2, 3, 6, 7]


def test_pictures_are_read_only_for_the_step_that_asks() -> None:
    clock = StepClock()
    policy = made(Counting(), clock, latency_s=0.1)
    policy.profile = Profile(
        "pick", "remote", ("a",), ("a",), url="ws://localhost", rate=HZ, cameras=(CameraMap("front", "front"),)
    )
    numpy = pytest.importorskip("numpy")
    image = numpy.zeros((4, 4, 3), numpy.uint8)
    policy.uses_cameras = True
    policy.reset("wave", {"a": (-1.0, 1.0)})
    looked = []
    for _ in range(20):
        looked.append(policy.uses_cameras)
        policy.act({"a": 0.0, "front": image} if policy.uses_cameras else {"a": 0.0})
        clock.time += 1 / HZ
    assert len(policy._inner.asked) == sum(looked)
    assert 2 <= sum(looked) <= 4


def test_real_time_chunking_is_told_what_was_played_and_what_will_be() -> None:
    clock = StepClock()
    inner = Continuing()
    run(made(inner, clock, latency_s=0.1), clock, steps=20)
    assert inner.told[:2] == [(0, 0), (6, 3)]


def test_a_policy_that_needs_every_step_computes_in_the_loop() -> None:
    inner = Counting(steps=1)
    inner.every_tick = True
    clock = StepClock()
    policy = made(inner)
    _, written = run(policy, clock, steps=5)
    assert written == [0, 100, 200, 300, 400]
    assert policy._inference.__class__.__name__ == "InlineInference"


def test_a_policy_that_is_done_plays_its_last_chunk_to_the_end() -> None:
    class Ends(Counting):
        def act(self, observation: Mapping[str, Any]) -> Any:
            return None if self.asked else super().act(observation)

    clock = StepClock()
    one, written = run(made(Ends(), clock, latency_s=0.1), clock)
    assert (one.state, written) == ("completed", list(range(10)))


def test_a_hung_inference_delays_no_step_and_ends_the_task_by_name() -> None:
    inner, body = Hung(), RecordingBody()
    policy = made(inner, deadline_s=0.5)
    one = Rollout(body, policy, permit=MotionGate().permit("test"), hz=HZ, duration=60.0)
    one.start()
    assert one.join(30)
    assert one.state == "error"
    assert "the inference of pick has not answered for" in one.error
    assert "deadline_s is 0.5" in one.error
    assert one.missed_ticks == 0 or len(body.writes) >= 9
    assert not inner.closed.is_set()
    inner.let_go.set()
    assert inner.closed.wait(20)


def test_a_stop_while_inference_hangs_ends_the_loop_at_once_and_its_answer_is_dropped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    inner, body = Hung(), RecordingBody()
    policy = made(inner, deadline_s=50.0)
    gate = MotionGate()
    one = Rollout(body, policy, permit=gate.permit("test"), hz=HZ, duration=60.0)
    one.start()
    assert inner.hangs.wait(20)
    gate.revoke()
    one.request_stop()
    assert one.join(5), "the loop waits for no inference"
    assert one.state == "stopped"
    assert inner.interrupted.is_set()
    written = len(body.writes)
    inner.let_go.set()
    assert inner.closed.wait(20)
    assert len(body.writes) == written
    assert "The policy pick has been computing" in caplog.text


def test_what_the_inference_raises_ends_the_task_with_its_reason() -> None:
    class Fails(Counting):
        def act(self, observation: Mapping[str, Any]) -> Any:
            raise PolicyError("no GPU")

    one = Rollout(RecordingBody(), made(Fails()), permit=MotionGate().permit("test"), hz=HZ, duration=60.0)
    one.start()
    eventually(lambda: not one.running)
    assert (one.state, one.error) == ("error", "PolicyError: no GPU")
