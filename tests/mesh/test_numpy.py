"""Robots and sensors that speak numpy, on the mesh: their numbers are numbers, and their arrays lists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.envelope import Envelope, success
from strands_robots.mesh import wire
from strands_robots.mesh.security import validate_command, validate_input_frame
from strands_robots.utils import ValidationError

READING: dict[str, Any] = {
    "speed": np.float32(0.5),
    "count": np.int64(3),
    "ready": np.bool_(True),
    "pose": np.array([1.0, 2.0, np.nan]),
    "grid": np.arange(4, dtype=np.uint8).reshape(2, 2),
    "by_motor": {np.int64(1): np.float64(0.25)},
    "wide": np.longdouble(2.0),
}
SENT = {
    "speed": 0.5,
    "count": 3,
    "ready": True,
    "pose": [1.0, 2.0, None],
    "grid": [[0, 1], [2, 3]],
    "by_motor": {"1": 0.25},
    "wide": 2.0,
}


class Counting(Arm):
    """A robot whose answers hold values of numpy."""

    def start_task(self, *task: Any, **options: Any) -> Envelope:
        return {**super().start_task(*task, **options), **READING}

    def get_task_status(self) -> Envelope:
        return {**super().get_task_status(), **READING}

    def get_features(self) -> Envelope:
        return {**super().get_features(), **READING}

    def get_state(self) -> Envelope:
        joints = {
            "shoulder": np.float32(1.5),
            "flag": np.bool_(True),
            "elbow": np.array([0.5]),
            "lost": np.float32("nan"),
        }
        return {**super().get_state(), "joints": joints, **READING}

    def get_imu(self) -> dict[str, Any]:
        return READING

    def get_pose(self) -> dict[str, Any]:
        return {"x": np.float32(1.0), "quat": np.array([2.0, 0.0, 0.0, 0.0], dtype=np.float32)}


@pytest.mark.parametrize("action", ["start", "status", "features", "state"])
def test_answer_with_values_of_numpy_arrives_as_json(
    peers: Fleet, action: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    peers.join(Counting(), "arm-1", "sim")
    console = peers.join(None, "console")
    command = {"action": action, **({"instruction": "wave", "policy_provider": "mock"} if action == "start" else {})}
    reply = console.send("arm-1", command, timeout=20)
    assert reply["type"] == "response", reply
    assert {name: reply["result"][name] for name in SENT} == SENT


def test_value_that_json_cannot_carry_costs_that_value_alone(peers: Fleet) -> None:
    class Odd(Arm):
        def start_task(self, *task: Any, **options: Any) -> Envelope:
            return {**super().start_task(*task, **options), "handle": object(), "names": {"a"}}

    odd = Odd()
    peers.join(odd, "arm-1", "sim")
    console = peers.join(None, "console")
    reply = console.send("arm-1", {"action": "start", "instruction": "wave", "policy_provider": "mock"}, timeout=20)
    assert odd.started == ["wave"]
    assert reply["result"]["status"] == "success"
    assert reply["result"]["names"] == ["a"]


def test_sensor_and_state_with_values_of_numpy_are_published(peers: Fleet) -> None:
    topics = [received(peers, f"strands/arm-1/{each}") for each in ("imu", "pose", "state")]
    peers.join(Counting(), "arm-1", "sim")
    imu, pose, state = (eventually(lambda each=each: each and each[0], what="a message") for each in topics)
    assert {name: imu[name] for name in SENT} == SENT
    assert (pose["x"], pose["quat"]) == (1.0, [1.0, 0.0, 0.0, 0.0])
    assert state["joints"] == {"shoulder": 1.5, "elbow": 0.5}
    assert state["degraded"]["joints"]["detail"] == "flag, lost"


def test_numbers_of_numpy_are_arguments_and_its_booleans_are_none() -> None:
    command = {"action": "start", "policy_provider": "mock", "duration": np.float32(2.0), "n_steps": np.int64(3)}
    checked = validate_command({**command, "target_velocity": np.array([0.5, 0.0, 0.0])})
    assert (checked["duration"], checked["n_steps"], checked["target_velocity"]) == (2.0, 3, [0.5, 0.0, 0.0])
    assert type(checked["duration"]) is float
    assert type(checked["n_steps"]) is int
    for name, value in {
        "duration": np.float32("nan"),
        "n_steps": np.bool_(True),
        "target_velocity": np.zeros(0),
    }.items():
        with pytest.raises(ValidationError, match=name):
            validate_command({**command, name: value})


def test_frame_with_numbers_of_numpy_is_applied_and_one_without_is_not() -> None:
    assert validate_input_frame({"pan.pos": np.float32(0.5), "grip.pos": np.int16(1)}) == {
        "pan.pos": 0.5,
        "grip.pos": 1,
    }
    for value in (np.float64("inf"), np.bool_(True), np.array([1.0, 2.0])):
        with pytest.raises(ValidationError, match="pan"):
            validate_input_frame({"pan.pos": value})


def test_message_keys_and_numbers_of_numpy_are_encoded_and_a_foreign_object_is_not() -> None:
    assert wire.decode(wire.encode({"reading": READING}, 4096), 4096) == {"reading": SENT}
    assert wire.finite(np.float32(0.5)) == 0.5
    assert wire.finite(np.bool_(True)) is None
    with pytest.raises(wire.WireError, match="object"):
        wire.encode({"handle": object()}, 4096)


def test_picture_among_the_joints_is_left_out_and_not_unpacked(peers: Fleet) -> None:
    class Picture:
        size, ndim = 900_000, 3
        unpacked = 0

        def tolist(self) -> list[float]:
            self.unpacked += 1
            return [0.0]

    picture = Picture()

    class Seeing(Arm):
        def get_state(self) -> Envelope:
            return success("1 joint.", joints={"pan": np.float32(0.5), "front": picture})

    topic = received(peers, "strands/arm-1/state")
    peers.join(Seeing(), "arm-1", "sim")
    state = eventually(lambda: topic and topic[0], what="a state")
    assert (state["joints"], picture.unpacked) == ({"pan": 0.5}, 0)
