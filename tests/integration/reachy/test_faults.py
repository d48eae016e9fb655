"""Faults of a daemon, switched on in the stand-in."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually, free_port
from zeroconf import ServiceInfo, Zeroconf

from strands_robots.drivers import reachy as package
from strands_robots.drivers.reachy import SERVICE, ReachyDriver, discover, make_reachy
from strands_robots.drivers.reachy.rest import DaemonUnreachableError
from strands_robots.drivers.reachy.target import FRAME_STEP, HeadPose, Target
from strands_robots.safety.gate import MotionRefused
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.timeout(90)


@pytest.fixture(scope="module")
def shared() -> Iterator[Daemon]:
    with Daemon(Kind("1.13.0")) as daemon:
        yield daemon


def test_stop_on_a_slow_daemon_ends_frames_and_does_not_claim_that_moves_stopped(
    daemon: Daemon, reachy: ReachyDriver
) -> None:
    daemon.control(slow_s=2.0)
    reachy.gesture("shake")
    eventually(lambda: reachy.motions.frames_sent > 3, what="frames")
    verdict = reachy.halt("test")
    assert "shake" in verdict.halted
    assert verdict.stopped is not True, "the daemon did not list its moves in time"
    sent = reachy.motions.frames_sent
    time.sleep(0.1)
    assert reachy.motions.frames_sent == sent


def test_hub_that_never_answers_makes_the_robot_unavailable(daemon: Daemon, reachy: ReachyDriver) -> None:
    daemon.control(hub="frozen")
    asked = threading.Thread(target=lambda: reachy.catalogue.names("dances"))
    asked.start()
    try:
        eventually(lambda: not reachy.is_connected, what="silence is noticed")
        with pytest.raises(MotionRefused, match=r"no joint data|did not answer"):
            reachy.gesture("nod")
        assert reachy.halt("test").stopped is not True
    finally:
        asked.join(20)
    eventually(lambda: reachy.is_connected, what="it answers again")


def test_nan_in_the_stream_makes_joints_stale_and_keeps_the_link(daemon: Daemon, reachy: ReachyDriver) -> None:
    daemon.control(nan=True)
    eventually(lambda: reachy.get_joints()["status"] == "error", what="no usable numbers")
    assert reachy.is_connected
    eventually(lambda: reachy.facts()["unusable_frames"] > 10, what="unusable frames are counted")
    with pytest.raises(DaemonUnreachableError, match="unusable numbers"):
        reachy.get_observation()
    reachy.go(Target(antennas=(0.0, 0.0)))
    daemon.control(nan=False)
    eventually(lambda: reachy.get_joints()["status"] == "success", what="numbers again")


def test_robot_held_by_an_application_refuses_motion(daemon: Daemon, reachy: ReachyDriver) -> None:
    daemon.control(holder="dance_party")
    eventually(lambda: reachy.facts()["app"] == "dance_party", what="the lock is seen")
    for verb in (reachy.wake_up, lambda: reachy.gesture("nod"), lambda: reachy.send_action({"head_yaw": 0.1})):
        with pytest.raises(MotionRefused, match="held by dance_party"):
            verb()
    assert reachy.halt("test").stopped is True
    daemon.control(holder="")
    eventually(lambda: not reachy.facts()["app"], what="it is free")
    reachy.gesture("nod")


def test_stopped_daemon_is_reported_and_a_started_one_is_used(daemon: Daemon, reachy: ReachyDriver) -> None:
    daemon.request("POST", "/api/daemon/stop?goto_sleep=false")
    eventually(lambda: "the daemon is stopped" in reachy.facts()["unavailable"], what="the reason")
    with pytest.raises(MotionRefused, match="stopped"):
        reachy.gesture("nod")
    daemon.request("POST", "/api/daemon/start?wake_up=false")
    eventually(lambda: reachy.is_connected, what="it is used")


def test_frames_at_the_daemon_never_jump_or_exceed_50_a_second(daemon: Daemon, reachy: ReachyDriver) -> None:
    before = len(daemon.frames())
    started = time.monotonic()
    for i in range(40):
        reachy.send_action({"antenna_left": math.sin(i), "head_yaw": 0.5 * math.cos(i)})
    elapsed = time.monotonic() - started
    assert elapsed >= 39 * 0.02 * 0.9
    yaws = [math.atan2(frame["head"][4], frame["head"][0]) for frame in daemon.frames()[before:] if frame.get("head")]
    assert max(abs(a - b) for a, b in pairwise(yaws)) <= FRAME_STEP + 1e-6


def test_bad_values_never_reach_the_wire(daemon: Daemon, reachy: ReachyDriver) -> None:
    sent = reachy.send_action({"antenna_left": 0.1})["antenna_left"]
    # Frames reach the daemon by another connection than the question for them.
    eventually(lambda: daemon.frames()[-1].get("antennas", [0, 0])[1] == sent, what="the frame")
    before = len(daemon.frames())
    bad = (math.nan, math.inf, -math.inf, True, "0", None, [0], 10**400, 4.0)
    for key in reachy.action_features:
        for value in bad:
            with pytest.raises(ValidationError, match=key):
                reachy.send_action({key: value})
    assert len(daemon.frames()) == before


def test_disconnect_leaves_no_thread_behind(daemon: Daemon, connect: Callable[..., ReachyDriver]) -> None:
    connect().disconnect()
    before, own = set(threading.enumerate()), ("reachy-", "Thread-")

    def left() -> list[str]:
        return [each.name for each in threading.enumerate() if each not in before and each.name.startswith(own)]

    for _ in range(5):
        reachy = connect()
        reachy.gesture("nod")
        reachy.wake_up()
        reachy.disconnect()
    eventually(lambda: not left(), what="the end of every thread of those drivers")


def test_connect_eagerly_never_raises_and_connects_later(daemon: Daemon) -> None:
    reachy = ReachyDriver("127.0.0.1", api_port=free_port())
    try:
        assert reachy.connect_eagerly(0.1)["status"] == "error"
        eventually(lambda: "Connection refused" in reachy.connect_eagerly(0.1)["reason"], what="the reason")
        with pytest.raises(MotionRefused, match="Connection refused"):
            reachy.go(Target(HeadPose()))
    finally:
        reachy.disconnect()
    with pytest.raises(DaemonUnreachableError, match="Connection refused"):
        ReachyDriver("127.0.0.1", api_port=free_port()).connect(within_s=3.0)


def test_announced_robot_is_discovered(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    here = ["127.0.0.1"]
    # Another run of these tests on this machine may announce its own robot.
    name = f"lab_head_{daemon.port}"
    with Zeroconf(interfaces=here) as network:
        info = ServiceInfo(
            SERVICE, f"{name}.{SERVICE}", port=daemon.port, parsed_addresses=here, server="reachy-mini.local."
        )
        network.register_service(info)
        daemons = [each for each in discover(1.5, interfaces=here) if each.name == name]
        if not daemons:
            pytest.skip("multicast does not loop back on this machine")
        assert [(each.name, each.host, each.port) for each in daemons] == [(name, "127.0.0.1", daemon.port)]
    monkeypatch.setattr(package, "discover", lambda within_s: daemons)
    assert make_reachy().connection.port == daemon.port
    monkeypatch.setattr(package, "discover", lambda within_s: daemons * 2)
    with pytest.raises(ValidationError, match=f"2 were found: {name} at"):
        make_reachy()
    monkeypatch.setattr(package, "discover", lambda within_s: [])
    with pytest.raises(ValidationError, match="none announced itself"):
        make_reachy()
