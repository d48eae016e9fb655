"""What leaves a peer as sensor messages: readings alone, never refusals or envelopes, and nothing waits for them."""

from __future__ import annotations

import json
import logging
import math
import threading
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.envelope import Envelope, error, success
from strands_robots.mesh.sensors import NoReadingError, from_ros, plain

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


def heard(peers: Fleet, key: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber(key, lambda sample: found.append(json.loads(sample.payload)))
    return found


def test_a_refused_reading_is_not_published_and_told_once(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    class Deaf(Arm):
        asked = 0

        def get_imu(self) -> Envelope:
            self.asked += 1
            return error(f"IMU data is stale: {self.asked}.0 s old.")

    robot, imus = Deaf(), heard(peers, "strands/arm-1/imu")
    with caplog.at_level(logging.INFO):
        mesh = peers.join(robot, "arm-1")
        console = peers.join(None, "console")
        eventually(lambda: robot.asked > 5)
    assert imus == []
    assert len([record for record in caplog.records if "IMU data is stale" in record.getMessage()]) == 1
    mesh.announce()
    assert "imu" not in (console.get_peer("arm-1") or {}).get("topics", [])


def test_an_answer_is_published_without_its_envelope(peers: Fleet) -> None:
    class Feeling(Arm):
        def get_imu(self) -> Envelope:
            return success("A sample.", gyroscope=[0.0, 0.0, 1.0], temperature=31.5)

    imus = heard(peers, "strands/arm-1/imu")
    peers.join(Feeling(), "arm-1")
    eventually(lambda: imus)
    assert set(imus[0]) == {"peer_id", "t", "gyroscope", "temperature"}


def test_a_ros_base_publishes_its_pose_in_the_fields_of_the_wire(peers: Fleet) -> None:
    class Base(Arm):
        def get_pose(self, timeout: float = 5.0) -> Envelope:
            return success("One message.", topic="/odom", message=ODOMETRY)

    poses = heard(peers, "strands/base/pose")
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


def test_a_status_of_the_providers_own_stays() -> None:
    assert plain({"status": "mapping", "cells": 4}) == {"status": "mapping", "cells": 4}
    assert plain(success("ok")) is None
    with pytest.raises(NoReadingError):
        plain([1])


def test_a_sensor_that_waits_holds_up_neither_state_nor_the_others(peers: Fleet) -> None:
    release = threading.Event()

    class Waiting(Arm):
        def get_pose(self) -> Envelope:
            release.wait(60)
            return error("Nothing arrived.")

        def get_imu(self) -> dict[str, Any]:
            return {"gyro": [0]}

    try:
        states, imus = heard(peers, "strands/arm-1/state"), heard(peers, "strands/arm-1/imu")
        peers.join(Waiting(), "arm-1")
        eventually(lambda: len(states) > 5 and len(imus) > 5)
    finally:
        release.set()


def test_an_added_pose_is_normalised_and_one_that_is_no_rotation_is_left_out(peers: Fleet) -> None:
    mesh, poses = peers.join(Arm(), "arm-1"), heard(peers, "strands/arm-1/pose")
    turns = [[0.0, 0.0, 0.0, 0.0], [-2.0, 0.0, 0.0, 0.0]]
    mesh.add_sensor("pose", lambda: {"x": 1.0, "quat": turns[0] if len(turns) < 2 else turns.pop()}, hz=50)
    eventually(lambda: poses)
    assert poses[0]["quat"] == [1.0, 0.0, 0.0, 0.0]
    mesh.add_sensor("pose", lambda: {"x": 1.0, "quat": [0.0, 0.0, 0.0, 0.0]}, hz=50)
    told = len(poses)
    mesh.add_sensor("odom", lambda: {"x": 1.0}, hz=50)
    odometry = heard(peers, "strands/arm-1/odom")
    eventually(lambda: len(odometry) > 5)
    assert len(poses) <= told + 1


def test_the_health_of_a_host_is_told_though_its_robot_cannot_tell(peers: Fleet) -> None:
    class Silent(Arm):
        def get_health(self) -> dict[str, Any]:
            raise OSError("bus timeout")

    hosts = heard(peers, "strands/arm-1/health")
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
