"""State messages and presence: what cannot be read leaves the rest."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.envelope import Envelope, error, success
from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.state import Description, StateReader


def read(robot: Any) -> dict[str, Any]:
    body = StateReader("arm-1", robot).read()
    assert body is not None
    return body


def test_joints_are_published_while_the_task_cannot_be_read() -> None:
    class Mute(Arm):
        def get_task_status(self) -> Envelope:
            raise RuntimeError("no status")

    body = read(Mute())
    assert body["joints"] == {"shoulder": 1.5}
    assert "task" not in body
    assert set(body["degraded"]) == {"task"}
    assert body["degraded"]["task"]["detail"] == "no status"


def test_refused_read_is_reported_as_degraded() -> None:
    class Refusing(Arm):
        def get_state(self) -> Envelope:
            return error("the bus is gone")

    body = read(Refusing())
    assert "joints" not in body
    assert (body["degraded"]["joints"]["reason"], body["degraded"]["joints"]["detail"]) == (
        "refused",
        "the bus is gone",
    )


def test_joint_that_is_no_number_leaves_the_others() -> None:
    class Odd(Arm):
        def get_state(self) -> Envelope:
            return success("state", joints={"pan": 1.0, "lift": float("nan"), "grip": None, "name": "x"})

    body = read(Odd())
    assert body["joints"] == {"pan": 1.0}
    assert body["degraded"]["joints"]["detail"] == "lift, grip, name"


def test_stale_joints_are_published_for_one_second() -> None:
    class Stale(Arm):
        age = 0.3

        def get_state(self) -> Envelope:
            return success("state", joints={"pan": 1.0}, joints_age_s=self.age, joints_error="The bus was busy.")

    robot = Stale()
    assert read(robot)["joints"] == {"pan": 1.0}
    robot.age = 1.5
    body = read(robot)
    assert "joints" not in body
    assert body["degraded"]["joints"]["reason"] == "stale"


def test_degraded_section_recovers_with_the_first_good_read() -> None:
    class Shaky(Arm):
        broken = True

        def get_state(self) -> Envelope:
            if self.broken:
                raise OSError("bus")
            return super().get_state()

    robot = Shaky()
    reader = StateReader("arm-1", robot)
    assert "degraded" in (reader.read() or {})
    robot.broken = False
    assert "degraded" not in (reader.read() or {})


def test_world_lists_its_robots_while_its_state_cannot_be_read() -> None:
    class Lost(World):
        def get_state(self) -> Envelope:
            raise OSError("no physics")

    world = Lost("left", "right")
    world.start_policy("right", "wave")
    body = read(world)
    assert body["robots"] == {"left": False, "right": True}
    assert body["task"]["instruction"] == "wave"
    assert set(body["degraded"]) == {"joints", "sim_time"}


def test_presence_loses_only_the_field_that_cannot_be_read(caplog: pytest.LogCaptureFixture) -> None:
    class Mute(Arm):
        def get_task_status(self) -> Envelope:
            raise RuntimeError("no status")

    description = Description("arm-1", Mute())
    with caplog.at_level(logging.WARNING):
        facts = [description.read() for _ in range(3)][-1]
    assert facts == {"tool_name": "arm", "robot_kind": "robot", "action_keys": ["shoulder.pos"]}
    assert len([record for record in caplog.records if record.name.startswith("strands_robots.mesh")]) == 1


def test_presence_names_the_hardware_its_cameras_and_whether_it_is_connected() -> None:
    class Seeing(RecordingDevice):
        @property
        def observation_features(self) -> dict[str, Any]:
            return {**super().observation_features, "wrist": (480, 640, 3)}

    robot = HardwareRobot(Seeing(), "arm")
    facts = Description("arm-1", robot).read()
    assert (facts["hw"], facts["cameras"], facts["connected"]) == ("recorder", ["wrist"], False)
    assert facts["action_keys"] == ["grip.pos", "lift.pos", "pan.pos"]


def test_presence_of_a_simulation_names_cameras_and_action_keys() -> None:
    class Featured(World):
        def get_features(self) -> Envelope:
            robots = {name: {"action_features": ["elbow"]} for name in self.names}
            return success("features", robots=robots, cameras=["overview", "left/wrist"])

    two = Description("sim-1", Featured("left", "right")).read()
    assert two["action_keys"] == ["left/elbow", "right/elbow"]
    assert two["cameras"] == ["overview", "left.wrist"]
    assert Description("sim-1", Featured("left")).read()["action_keys"] == ["elbow"]
    assert Description("console", None).read() == {}


def test_joints_task_and_simulated_time_are_published(peers: Fleet) -> None:
    states = received(peers, "strands/*/state")
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


def test_unreadable_robot_is_degraded_and_still_published() -> None:
    class Broken(Arm):
        def get_state(self) -> dict[str, Any]:
            raise OSError("bus timeout " + "x" * 1000)

    reader = StateReader("arm-1", Broken())
    reader.read()
    body = reader.read()
    assert body is not None
    degraded = body["degraded"]["joints"]
    assert set(degraded) == {"reason", "detail", "failures", "seconds"}
    assert (degraded["reason"], degraded["failures"]) == ("OSError", 2)
    assert degraded["detail"].startswith("bus timeout")
    assert len(degraded["detail"]) < 200
    assert body["task"]["status"] == "idle"
    assert StateReader("console", None).read() is None
