"""Every guard of an input stream between processes, seen at the servos of a follower: the refused moves nothing."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from fixtures.arm_pair import SERVO, ArmPair
from fixtures.arm_peer import NUMBERED
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually

pytestmark = pytest.mark.system

LIFETIME = "STRANDS_MESH_INPUT_STREAM_TTL_S"
TOPIC = "strands/lead/input/leader"
QUIET_S = 0.3
"""Fifteen periods at 50 Hz: what was on its way has arrived."""


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArmPair]:
    with ArmPair(tmp_path_factory.mktemp("pair")) as made:
        yield made


@pytest.fixture
def pair(two: ArmPair) -> Iterator[ArmPair]:
    """The pair with a stream just opened; whatever the test before left is cleared away."""
    two.follow()
    two.following.forget()
    yield two
    two.leader.ask("rest")
    two.follower.ask("leave")
    for side in (two.leader, two.follower):
        side.ask("clear")


class Frames:
    """Frames by hand, from the leader's own session."""

    def __init__(self, pair: ArmPair) -> None:
        self._pair = pair
        self._numbers = count()

    def made(self, degrees: float = 0.0, **fields: Any) -> dict[str, Any]:
        frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": time.time(), "seq": next(self._numbers)}
        return {**frame, "action": {NUMBERED: degrees}, "events": None, **fields}

    def send(self, degrees: float = 0.0, **fields: Any) -> None:
        self._pair.leader.ask("frame", TOPIC, self.made(degrees, **fields))


@pytest.fixture
def frames(pair: ArmPair) -> Frames:
    made = Frames(pair)

    def heard() -> int:
        # What is sent before the subscription has reached the leader's session was sent to nobody.
        made.send()
        # Another one is sent once this one cannot come any more: the tests count what reached the servo.
        with contextlib.suppress(AssertionError):
            return eventually(stat(pair, "frames_received"), within=3.0)
        return 0

    eventually(heard, what="the first frame")
    return made


def stat(pair: ArmPair, name: str) -> Callable[[], int]:
    return lambda: int(pair.follower.ask("stats")[name])


def reached(pair: ArmPair, goals: int) -> None:
    """So many targets have reached the servo, and no other but that of a follower that holds its position."""

    def written() -> int:
        # The servos answer a read after they took every target that was sent before it.
        pair.follower.ask("state")
        return len(pair.following.written_after(servo=SERVO))

    eventually(lambda: written() >= goals, what=f"{goals} targets at the servo")
    count = written()
    assert goals <= count <= goals + pair.follower.ask("stats")["holding"]


def leading(pair: ArmPair) -> None:
    pair.leader.ask("lead")
    eventually(lambda: stat(pair, "frames_received")() >= 25, what="half a second of frames")


def quiet(pair: ArmPair) -> bool:
    """True when no servo was told anything meanwhile."""
    pair.follower.ask("state")
    began = time.monotonic()
    time.sleep(QUIET_S)
    return pair.following.last_write() <= began


def nothing_more(pair: ArmPair) -> None:
    """From now on no servo is told anything."""
    assert quiet(pair)


@pytest.mark.parametrize("age_s", [120.0, -30.0])
def test_a_frame_of_another_time_moves_nothing(pair: ArmPair, frames: Frames, age_s: float) -> None:
    frames.send(5.0, t=time.time() - age_s)
    eventually(lambda: stat(pair, "rejected_freshness")() == 1)
    reached(pair, 1)


def test_a_frame_that_was_overtaken_moves_nothing(pair: ArmPair, frames: Frames) -> None:
    frames.send(1.0, seq=50)
    frames.send(2.0, seq=50)
    frames.send(3.0, seq=49)
    eventually(lambda: stat(pair, "out_of_order")() == 2)
    reached(pair, 2)


def test_a_joint_that_is_asked_to_move_too_fast_does_not(pair: ArmPair, frames: Frames) -> None:
    frames.send(1.0)
    frames.send(700.0)
    eventually(lambda: stat(pair, "slew_rejected")() == 1)
    reached(pair, 2)


def test_a_value_outside_every_bound_moves_nothing(pair: ArmPair, frames: Frames) -> None:
    for bad in (1e5, "fast", None, True):
        frames.send(action={NUMBERED: bad})
    eventually(lambda: stat(pair, "rejected_invalid")() == 4)
    reached(pair, 1)


def test_an_unknown_joint_is_an_error_and_moves_nothing(pair: ArmPair, frames: Frames) -> None:
    frames.send(action={"tail.pos": 1.0})
    eventually(lambda: stat(pair, "errors")() == 1)
    reached(pair, 1)


def test_a_second_leader_of_the_same_name_moves_nothing(pair: ArmPair, frames: Frames, tmp_path: Path) -> None:
    state = tmp_path / "other"
    state.mkdir(mode=0o700)
    with MeshPeer("other", "none", {**pair.settings["lead"], "STRANDS_STATE_DIR": str(state)}) as other:
        other.sees("follow")
        other.ask("frame", TOPIC, frames.made(5.0))
        eventually(lambda: stat(pair, "rejected_source")() == 1)
    reached(pair, 1)
    frames.send(2.0)
    eventually(lambda: stat(pair, "frames_received")() == 2, what="the first leader's next frame")


def test_a_stream_ends_with_its_lifetime_and_the_arm_stays_held(pair: ArmPair) -> None:
    leading(pair)
    pair.follower.ask("setting", LIFETIME, "1")
    try:
        eventually(lambda: stat(pair, "rejected_expired")() == 1)
        assert pair.follower.ask("stats")["running"] is False
        nothing_more(pair)
        assert pair.following.ask("torque") == [True] * 6
    finally:
        pair.follower.ask("setting", LIFETIME, "900")


def test_a_lockout_in_mid_stream_ends_it_until_it_is_lifted(pair: ArmPair) -> None:
    leading(pair)
    pair.follower.ask("estop")
    began = time.monotonic()
    eventually(stat(pair, "rejected_lockout"), what="a frame after the stop")
    assert pair.following.last_write() <= began
    assert pair.follower.ask("stats")["running"] is False
    nothing_more(pair)
    assert "locked" in str(pair.follower.ask("follow", "lead"))
    nothing_more(pair)
    pair.follower.ask("clear")
    pair.follow()


def test_a_halt_in_mid_stream_ends_it_and_locks_nothing(pair: ArmPair) -> None:
    leading(pair)
    assert pair.follower.ask("halt") is True
    began = time.monotonic()
    nothing_more(pair)
    assert pair.following.last_write() <= began
    assert pair.follower.ask("stats")["running"] is False
    assert pair.follower.ask("epoch") is None


def test_a_lost_leader_leaves_the_arm_where_it_led_it_and_its_successor_is_not_taken_for_it(pair: ArmPair) -> None:
    leading(pair)
    pair.replace_leader()
    eventually(stat(pair, "holding"), what="the follower holds its position")
    eventually(lambda: quiet(pair), what="the end of the hold's own write")
    nothing_more(pair)
    assert pair.following.ask("torque") == [True] * 6
    assert pair.follower.ask("state")
    received = stat(pair, "frames_received")()
    pair.leader.ask("lead")
    eventually(stat(pair, "rejected_source"), what="a frame of the new leader's session")
    assert stat(pair, "frames_received")() == received
    nothing_more(pair)

    def followed_anew() -> int:
        pair.follow()
        time.sleep(QUIET_S)
        return stat(pair, "frames_received")()

    eventually(followed_anew, what="the name, passed on to the new leader's session")
