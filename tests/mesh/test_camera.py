"""Frames of several cameras, one of which fails: the others are published, and the trouble is told once."""

from __future__ import annotations

import json
import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.hardware import HardwareRobot

GREY = np.full((24, 32, 3), 128, dtype=np.uint8)


def heard(peers: Fleet) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber("strands/*/camera/*", lambda sample: found.append(json.loads(sample.payload)))
    return found


def noise() -> Any:
    """A picture that JPEG cannot make smaller than a frame may be."""
    return np.random.default_rng(1).integers(0, 256, (1200, 1600, 3), dtype=np.uint8)


def test_a_frame_too_large_a_bad_name_and_a_bad_picture_spoil_no_other_camera(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    huge = noise()

    class Seeing(Arm):
        def camera_frames(self) -> dict[str, Any]:
            return {"huge": huge, "a name": GREY, "flat": np.zeros((4, 4), dtype=np.uint8), "wrist": GREY}

    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "20")
    frames = heard(peers)
    with caplog.at_level(logging.WARNING):
        peers.join(Seeing(), "arm-1")
        eventually(lambda: len(frames) >= 3)
    assert {body["cam"] for body in frames} == {"wrist"}
    told = [record.getMessage() for record in caplog.records if "publishes nothing of" in record.getMessage()]
    assert len(told) == 3
    assert any("'huge': TooLargeError" in line for line in told)


def test_a_real_camera_that_fails_leaves_the_others_of_its_robot(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    def dead() -> Any:
        raise TimeoutError("no picture")

    device = RecordingDevice()
    device.cameras = {  # type: ignore[attr-defined]  # LeRobot's devices have them
        "front": SimpleNamespace(read_latest=dead),
        "wrist": SimpleNamespace(read_latest=lambda: GREY),
    }
    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "20")
    frames = heard(peers)
    robot = HardwareRobot(device, "arm")
    peers.join(robot, "arm-1")
    eventually(lambda: frames)
    assert {body["cam"] for body in frames} == {"wrist"}
    with pytest.raises(TimeoutError):
        robot.camera_frames()["front"]


def test_a_robot_whose_cameras_cannot_be_asked_is_told_once(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Blind(Arm):
        asked = 0

        def camera_frames(self) -> dict[str, Any]:
            self.asked += 1
            raise OSError("no cameras")

    monkeypatch.setenv("STRANDS_MESH_CAMERA_HZ", "50")
    robot = Blind()
    with caplog.at_level(logging.WARNING):
        peers.join(robot, "arm-1")
        eventually(lambda: robot.asked > 3)
    assert len([record for record in caplog.records if "no cameras" in record.getMessage()]) == 1
