"""Sensor messages and camera frames: a failing sensor delays no other."""

from __future__ import annotations

import logging
import math
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.envelope import Envelope, error, success
from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.sensors import NoReadingError, frame_message, from_ros, health, plain, pose
from strands_robots.utils import ValidationError

GREY = np.full((24, 32, 3), 128, dtype=np.uint8)

ODOMETRY = {
    "header": {"frame_id": "odom"},
    "child_frame_id": "base_link",
    "pose": {
        "pose": {
            "position": {"x": 1.0, "y": 2.0, "z": 0.1},
            "orientation": {"x": 0.0, "y": 0.0, "z": -math.sin(0.25), "w": -math.cos(0.25)},
        },
        "covariance": [0.0] * 36,
    },
}


def test_refused_reading_is_not_published_and_logged_once(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    class Deaf(Arm):
        reads = 0

        def get_imu(self) -> Envelope:
            self.reads += 1
            return error(f"IMU data is stale: {self.reads}.0 s old.")

    robot, imus = Deaf(), received(peers, "strands/arm-1/imu")
    with caplog.at_level(logging.INFO):
        mesh = peers.join(robot, "arm-1")
        console = peers.join(None, "console")
        eventually(lambda: robot.reads > 5)
    assert imus == []
    assert len([record for record in caplog.records if "IMU data is stale" in record.getMessage()]) == 1
    mesh.announce()
    assert "imu" not in (console.get_peer("arm-1") or {}).get("topics", [])


def test_an_answer_is_published_without_its_envelope(peers: Fleet) -> None:
    class Feeling(Arm):
        def get_imu(self) -> Envelope:
            return success("A sample.", gyroscope=[0.0, 0.0, 1.0], temperature=31.5)

    imus = received(peers, "strands/arm-1/imu")
    peers.join(Feeling(), "arm-1")
    eventually(lambda: imus)
    assert set(imus[0]) == {"peer_id", "t", "gyroscope", "temperature"}


def test_a_ros_base_publishes_its_pose_in_the_fields_of_the_wire(peers: Fleet) -> None:
    class Base(Arm):
        def get_pose(self, timeout: float = 5.0) -> Envelope:
            return success("One message.", topic="/odom", message=ODOMETRY)

    poses = received(peers, "strands/base/pose")
    peers.join(Base(), "base")
    eventually(lambda: poses)
    body = poses[0]
    assert set(body) == {"peer_id", "t", "x", "y", "z", "theta", "quat", "source", "frame"}
    assert (body["x"], body["y"], body["z"]) == (1.0, 2.0, 0.1)
    assert body["theta"] == pytest.approx(0.5)
    assert body["quat"] == pytest.approx([math.cos(0.25), 0, 0, math.sin(0.25)])
    assert (body["source"], body["frame"]) == ("/odom", "odom")


def test_a_turtle_has_a_pose_and_a_twist_has_none() -> None:
    turtle = from_ros({"x": 5.5, "y": 5.5, "theta": math.pi / 2, "linear_velocity": 0.0, "angular_velocity": 0.0})
    assert turtle["quat"] == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    assert turtle["frame"] is None
    others: tuple[dict[str, Any], ...] = (
        {"pose": 1},
        {"twist": {}},
        {"x": 1, "theta": 0},
        {"x": float("nan"), "y": 0, "theta": 0},
    )
    for message in others:
        with pytest.raises(NoReadingError):
            from_ros(message, "/odom")


def test_status_field_of_a_provider_is_published() -> None:
    assert plain({"status": "mapping", "cells": 4}) == {"status": "mapping", "cells": 4}
    assert plain(success("ok")) is None
    with pytest.raises(NoReadingError):
        plain([1])


def test_waiting_sensor_delays_neither_state_nor_other_sensors(peers: Fleet) -> None:
    release = threading.Event()

    class Waiting(Arm):
        def get_pose(self) -> Envelope:
            release.wait(60)
            return error("Nothing arrived.")

        def get_imu(self) -> dict[str, Any]:
            return {"gyro": [0]}

    try:
        states, imus = received(peers, "strands/arm-1/state"), received(peers, "strands/arm-1/imu")
        peers.join(Waiting(), "arm-1")
        eventually(lambda: len(states) > 5 and len(imus) > 5)
    finally:
        release.set()


def test_an_added_pose_is_normalised_and_one_that_is_no_rotation_is_left_out(peers: Fleet) -> None:
    mesh, poses = peers.join(Arm(), "arm-1"), received(peers, "strands/arm-1/pose")
    turns = [[0.0, 0.0, 0.0, 0.0], [-2.0, 0.0, 0.0, 0.0]]
    mesh.add_sensor("pose", lambda: {"x": 1.0, "quat": turns[0] if len(turns) < 2 else turns.pop()}, hz=50)
    eventually(lambda: poses)
    assert poses[0]["quat"] == [1.0, 0.0, 0.0, 0.0]
    mesh.add_sensor("pose", lambda: {"x": 1.0, "quat": [0.0, 0.0, 0.0, 0.0]}, hz=50)
    logged = len(poses)
    mesh.add_sensor("odom", lambda: {"x": 1.0}, hz=50)
    odometry = received(peers, "strands/arm-1/odom")
    eventually(lambda: len(odometry) > 5)
    assert len(poses) <= logged + 1


def test_host_health_is_published_when_the_robots_cannot_be_read(peers: Fleet) -> None:
    class Silent(Arm):
        def get_health(self) -> dict[str, Any]:
            raise OSError("bus timeout")

    hosts = received(peers, "strands/arm-1/health")
    peers.join(Silent(), "arm-1")
    eventually(lambda: hosts)
    assert hosts[0]["battery_pct"] is None
    assert hosts[0]["uptime_s"] >= 0


def test_presence_names_the_sensors_that_are_published(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_HEALTH_HZ", "0")
    mesh, console = peers.join(Arm(), "arm-1"), peers.join(None, "console")
    mesh.add_sensor("imu", lambda: {"gyro": [0]}, hz=50)
    mesh.add_sensor("hand/left", lambda: {"grip": 1.0}, hz=50)
    mesh.add_sensor("odom", lambda: None, hz=50)
    eventually(lambda: (console.get_peer("arm-1") or {}).get("topics") == ["hand/left/state", "imu"])
    mesh.add_sensor("imu", lambda: {"gyro": [0]}, hz=0)
    eventually(lambda: (console.get_peer("arm-1") or {}).get("topics") == ["hand/left/state"])


def test_a_provider_cannot_speak_for_another_peer(peers: Fleet) -> None:
    mesh, imu = peers.join(Arm(), "arm-1"), received(peers, "strands/arm-1/imu")
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

    poses, hosts = received(peers, "strands/rover/pose"), received(peers, "strands/rover/health")
    console = peers.join(None, "console")
    peers.join(Rover(), "rover")
    eventually(lambda: poses and hosts)
    assert poses[0]["quat"] == [1.0, 0.0, 0.0, 0.0]
    assert {"cpu_load", "mem_pct", "disk_free_gb", "uptime_s", "battery_pct"} <= set(hosts[0])
    eventually(lambda: "pose" in (console.get_peer("rover") or {}).get("topics", []))


def test_a_quaternion_is_normalised_or_not_published() -> None:
    normalised = pose({"quat": [-0.1, 0.0, 0.0, 0.1]})
    assert normalised is not None
    assert normalised["quat"][0] > 0
    assert sum(value * value for value in normalised["quat"]) == pytest.approx(1)
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
    frames = received(peers, "strands/*/camera/*")
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


def noise() -> Any:
    """A image that JPEG cannot make smaller than a frame may be."""
    return np.random.default_rng(1).integers(0, 256, (1200, 1600, 3), dtype=np.uint8)


def test_frames_that_cannot_be_published_leave_the_other_cameras(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    huge = noise()

    class Seeing(Arm):
        def camera_frames(self) -> dict[str, Any]:
            return {"huge": huge, "a name": GREY, "flat": np.zeros((4, 4), dtype=np.uint8), "wrist": GREY}

    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "20")
    frames = received(peers, "strands/*/camera/*")
    with caplog.at_level(logging.WARNING):
        peers.join(Seeing(), "arm-1")
        eventually(lambda: len(frames) >= 3)
    assert {body["cam"] for body in frames} == {"wrist"}
    logged = [record.getMessage() for record in caplog.records if "publishes nothing of" in record.getMessage()]
    assert len(logged) == 3
    assert any("'huge': TooLargeError" in line for line in logged)


def test_failing_camera_leaves_the_others_of_its_robot(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    def dead() -> Any:
        raise TimeoutError("no picture")

    device = RecordingDevice()
    device.cameras = {  # type: ignore[attr-defined]  # LeRobot's devices have them
        "front": SimpleNamespace(read_latest=dead),
        "wrist": SimpleNamespace(read_latest=lambda: GREY),
    }
    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "20")
    frames = received(peers, "strands/*/camera/*")
    robot = HardwareRobot(device, "arm")
    peers.join(robot, "arm-1")
    eventually(lambda: frames)
    assert {body["cam"] for body in frames} == {"wrist"}
    with pytest.raises(TimeoutError):
        robot.camera_frames()["front"]


def test_robot_whose_cameras_cannot_be_read_is_logged_once(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Blind(Arm):
        reads = 0

        def camera_frames(self) -> dict[str, Any]:
            self.reads += 1
            raise OSError("no cameras")

    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "50")
    robot = Blind()
    with caplog.at_level(logging.WARNING):
        peers.join(robot, "arm-1")
        eventually(lambda: robot.reads > 3)
    assert len([record for record in caplog.records if "no cameras" in record.getMessage()]) == 1
