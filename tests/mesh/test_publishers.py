"""What a peer publishes by itself: state, sensors, camera, stream; and the scheduler that paces it."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

import numpy as np
import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Clock, Fleet

from strands_robots.mesh.core import Mesh
from strands_robots.mesh.scheduler import Scheduler
from strands_robots.mesh.sensors import frame_message, health, pose
from strands_robots.mesh.state import StateReader
from strands_robots.mesh.stream import numbers
from strands_robots.mesh.throttle import RateLimiter
from strands_robots.utils import ValidationError


def heard(peers: Fleet, key: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber(key, lambda sample: found.append(json.loads(sample.payload)))
    return found


def test_joints_task_and_simulated_time_are_published(peers: Fleet) -> None:
    states = heard(peers, "strands/*/state")
    peers.join(Arm(), "arm-1")
    peers.join(World("left"), "sim-1", "sim")
    eventually(lambda: {body["peer_id"] for body in states} == {"arm-1", "sim-1"})
    arm = next(body for body in states if body["peer_id"] == "arm-1")
    sim = next(body for body in states if body["peer_id"] == "sim-1")
    assert arm["joints"] == {"shoulder": 1.5}
    assert arm["task"]["status"] == "idle"
    assert sim["joints"]["joint"]["position"] == 0.5
    eventually(lambda: {"joint": {"position": 0.5, "velocity": 0.0}} in [body["joints"] for body in states])
    assert sim["sim_time"] == 1.25
    assert sim["robots"] == {"left": False}


def test_a_robot_that_cannot_be_read_says_so_and_stays_seen() -> None:
    class Broken(Arm):
        def get_state(self) -> dict[str, Any]:
            raise OSError("bus timeout " + "x" * 1000)

    reader = StateReader("arm-1", Broken())
    reader.read()
    body = reader.read()
    assert body is not None
    told = body["degraded"]["joints"]
    assert set(told) == {"reason", "detail", "failures", "seconds"}
    assert (told["reason"], told["failures"]) == ("OSError", 2)
    assert told["detail"].startswith("bus timeout")
    assert len(told["detail"]) < 200
    assert body["task"]["status"] == "idle"
    assert StateReader("console", None).read() is None


def test_a_provider_cannot_speak_for_another_peer(peers: Fleet) -> None:
    mesh, imu = peers.join(Arm(), "arm-1"), heard(peers, "strands/arm-1/imu")
    mesh.add_sensor("imu", lambda: {"peer_id": "other", "t": 0, "gyro": [1, 2, 3]}, hz=50)
    eventually(lambda: imu)
    assert imu[0]["peer_id"] == "arm-1"
    assert imu[0]["t"] > 1
    assert imu[0]["gyro"] == [1, 2, 3]
    with pytest.raises(ValidationError):
        mesh.add_sensor("radar", dict)
    with pytest.raises(ValidationError):
        mesh.add_sensor("hand/*", dict)


def test_a_robots_own_sensors_are_published_and_named_in_presence(peers: Fleet) -> None:
    class Rover(Arm):
        def get_pose(self) -> dict[str, Any]:
            return {"x": 1.0, "y": 2.0, "z": 0.0, "theta": 0.5, "quat": [-2.0, 0.0, 0.0, 0.0], "frame": "map"}

    poses, hosts = heard(peers, "strands/rover/pose"), heard(peers, "strands/rover/health")
    console = peers.join(None, "console")
    peers.join(Rover(), "rover")
    eventually(lambda: poses and hosts)
    assert poses[0]["quat"] == [1.0, 0.0, 0.0, 0.0]
    assert {"cpu_load", "mem_pct", "disk_free_gb", "uptime_s", "battery_pct"} <= set(hosts[0])
    eventually(lambda: "pose" in (console.get_peer("rover") or {}).get("topics", []))


def test_a_quaternion_is_normalised_or_not_published() -> None:
    found = pose({"quat": [-0.1, 0.0, 0.0, 0.1]})
    assert found is not None
    assert found["quat"][0] > 0
    assert sum(value * value for value in found["quat"]) == pytest.approx(1)
    assert pose({"quat": [0, 0, 0, 0]}) is None
    assert pose({"quat": [float("nan"), 0, 0, 0]}) is None
    assert health(lambda: {"battery_pct": 55.0})["battery_pct"] == 55.0


def test_frames_are_jpeg_and_the_privacy_switch_is_read_before_one_is_built(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[int] = []

    class Seeing(Arm):
        def camera_frames(self) -> dict[str, Any]:
            built.append(1)
            return {"wrist": np.full((24, 32, 3), 200, dtype=np.uint8)}

    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "50")
    monkeypatch.setenv("STRANDS_MESH_CAMERA_DISABLED", "perhaps")
    frames = heard(peers, "strands/*/camera/*")
    peers.join(Seeing(), "arm-1")
    time.sleep(0.1)
    assert not built
    monkeypatch.setenv("STRANDS_MESH_CAMERA_DISABLED", "false")
    eventually(lambda: frames)
    body = frames[0]
    assert (body["cam"], body["shape"], body["dtype"], body["encoding"]) == ("wrist", [24, 32, 3], "uint8", "jpeg")
    assert body["data"].startswith("/9j/")
    with pytest.raises(ValidationError):
        frame_message("arm-1", "wrist", 0.0, np.zeros((2, 2), dtype=np.uint8))


def test_policy_steps_carry_numbers_and_are_thinned_out(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_STREAM_HZ", "0.005")
    # One in 200 s, and a second one after half of that at the soonest: no machine is slow enough for two.
    one, two = peers.join(Arm(), "arm-1"), peers.join(None, "console")
    steps: list[dict[str, Any]] = []
    two.on_stream("arm-1", lambda key, data: steps.append(data))
    observation = {"j": 1.5, "image": np.zeros((4, 4)), "near": np.arange(3.0), "far": [0.0] * 100, "nan": float("nan")}
    for number in range(50):
        one.publish_step(number, observation, {"j": 2}, "wave", "mock")
    eventually(lambda: steps)
    assert steps[0]["observation"] == {"j": 1.5, "near": [0.0, 1.0, 2.0]}
    assert steps[0]["instruction"] == "wave"
    assert len(steps) == 1


def test_a_limiter_keeps_a_steady_source_whole() -> None:
    clock = Clock()
    limiter = RateLimiter(50, clock)
    admitted = 0
    for number in range(500):
        clock.pass_(0.02 + (0.004 if number % 2 else -0.004))
        admitted += limiter.admit()
    assert admitted >= 495
    assert RateLimiter(0, clock).admit() is False
    assert numbers({"a": True, "b": "x", "c": None, 3: 1}) == {"a": True, "3": 1}


def test_missed_deadlines_are_dropped_not_caught_up() -> None:
    clock, runs = Clock(), []
    scheduler = Scheduler("test", clock)
    scheduler.every("job", 10, lambda: runs.append(clock()), quick=True)
    scheduler.run_due(clock())
    clock.pass_(1.05)
    scheduler.run_due(clock())
    scheduler.run_due(clock())
    assert len(runs) == 2
    clock.pass_(0.1)
    scheduler.run_due(clock())
    assert len(runs) == 3


def test_a_wedged_read_does_not_hold_up_presence_and_stop_names_it() -> None:
    release, beats = threading.Event(), []
    scheduler = Scheduler("wedged")
    scheduler.every("bus", 100, lambda: release.wait(20) and None)
    scheduler.every("presence", 100, lambda: beats.append(1), quick=True)
    scheduler.start()
    eventually(lambda: len(beats) > 5)
    assert "wedged-sampler" in scheduler.stop(0.05)
    eventually(lambda: "wedged-timer" not in [thread.name for thread in threading.enumerate()])
    release.set()


def test_a_failing_job_goes_on() -> None:
    scheduler, runs = Scheduler("failing"), []

    def fail() -> None:
        runs.append(1)
        raise RuntimeError("no")

    scheduler.every("job", 200, fail)
    scheduler.start()
    eventually(lambda: len(runs) >= 3)
    assert scheduler.stop(20) == []


def test_stopping_leaves_no_thread_of_ours(peers: Fleet) -> None:
    mesh: Mesh = peers.join(World("left"), "leaver", "sim")
    console = peers.join(None, "console")
    console.ping("leaver")

    def ours() -> list[str]:
        return [each.name for each in threading.enumerate() if "leaver" in each.name and "halt" not in each.name]

    assert ours()
    mesh.stop()
    eventually(lambda: not ours())
