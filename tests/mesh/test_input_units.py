"""The largest value of a frame for each joint, by the follower's units."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, signed

from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.input import InputReceiver
from strands_robots.mesh.input_receiver import joint_limits
from strands_robots.simulation import Simulation


class Arm(RecordingDevice):
    """A device whose motors have LeRobot's modes."""

    def __init__(self) -> None:
        super().__init__()
        modes = {"pan": "RANGE_M100_100", "lift": "DEGREES", "grip": "RANGE_0_100"}
        motors = {name: SimpleNamespace(norm_mode=SimpleNamespace(name=mode)) for name, mode in modes.items()}
        self.bus = SimpleNamespace(motors=motors)


@pytest.fixture
def arm() -> Iterator[HardwareRobot]:
    robot = HardwareRobot(Arm(), "arm")
    robot.connect()
    yield robot
    robot.cleanup()


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    world = Simulation(realtime=False)
    world.create_world()
    world.add_robot("so100")
    yield world
    world.cleanup()


def test_the_limit_is_twice_full_scale_in_the_followers_units(arm: HardwareRobot, simulation: Simulation) -> None:
    assert joint_limits(arm) == {"pan.pos": 200.0, "lift.pos": 720.0, "grip.pos": 200.0}
    assert all(limit == pytest.approx(4 * math.pi) for limit in joint_limits(simulation).values())
    assert len(joint_limits(simulation)) == 6
    assert joint_limits(object()) == {}


def test_the_first_frame_of_a_simulation_is_bounded_from_where_its_robot_stands(
    simulation: Simulation, peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_MESH_INPUT_SLEW_ABS", "10")
    (joints,) = simulation.get_state()["robots"].values()
    joint = simulation.get_features()["robots"]["so100"]["action_features"][0]
    follower, leader = peers.join(simulation, "follower", "sim"), peers.stranger()
    leader.put("strands/lead/presence", {"robot_id": "lead", "timestamp": peers.clock()})
    receiver = InputReceiver(follower, simulation, "lead")
    receiver.start()
    frame: dict[str, Any] = {"peer_id": "lead", "device": "leader", "method": "arm", "events": None}
    try:
        for sequence, ahead in enumerate((1.0, 0.05)):
            action = {joint: joints[joint] + ahead}
            leader.put(
                "strands/lead/input/leader",
                signed(peers, {**frame, "t": peers.clock(), "seq": sequence, "action": action}),
            )
        eventually(lambda: receiver.stats["frames_received"] == 1)
    finally:
        receiver.stop()
    assert (receiver.stats["slew_rejected"], receiver.stats["errors"]) == (1, 0)


def test_a_value_beyond_its_joints_scale_moves_nothing(arm: HardwareRobot, peers: Fleet) -> None:
    follower, leader = peers.join(arm, "follower"), peers.stranger()
    leader.put("strands/lead/presence", {"robot_id": "lead", "timestamp": peers.clock()})
    receiver = InputReceiver(follower, arm, "lead")
    receiver.start()
    frame: dict[str, Any] = {"peer_id": "lead", "device": "leader", "method": "arm", "events": None}
    try:
        leader.put(
            "strands/lead/input/leader",
            signed(peers, {**frame, "t": peers.clock(), "seq": 1, "action": {"pan.pos": 250.0}}),
        )
        eventually(lambda: receiver.stats["rejected_invalid"] == 1)
        leader.put(
            "strands/lead/input/leader",
            signed(peers, {**frame, "t": peers.clock(), "seq": 2, "action": {"pan.pos": 15.0}}),
        )
        eventually(lambda: receiver.stats["frames_received"] == 1)
    finally:
        receiver.stop()
    assert receiver.stats["errors"] == 0
