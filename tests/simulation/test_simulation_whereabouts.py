"""Where the bases of simulated robots are, how they move, and in what units they are commanded."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    simulation.create_world()
    yield simulation
    simulation.cleanup()


def test_an_arm_stands_where_it_was_put_and_has_no_odometry(world: Simulation) -> None:
    world.add_robot("so100", position=(0.5, -0.25, 0.1), yaw=math.pi)
    pose = world.get_pose()
    assert (pose["x"], pose["y"], pose["z"]) == (0.5, -0.25, 0.1)
    assert pose["theta"] == pytest.approx(math.pi)
    assert pose["quat"] == pytest.approx([0, 0, 0, 1])
    assert (pose["source"], pose["frame"]) == ("simulation", "world")
    assert "does not move about" in world.get_odom()["reason"]


def test_a_rover_is_where_it_drove_and_its_velocity_is_along_its_own_axes(world: Simulation) -> None:
    world.add_robot("rover", yaw=math.pi / 2)
    assert world.get_pose()["theta"] == pytest.approx(math.pi / 2, abs=1e-3)
    keys = world.get_features()["robots"]["rover"]["action_features"]
    assert world.send_action({keys[0]: 0.3})["status"] == "success"
    fastest = 0.0
    for _ in range(40):
        world.step(50)
        fastest = max(fastest, world.get_odom()["linear"][0])
    pose, odometry = world.get_pose(), world.get_odom()
    observed = world.get_observation("rover")
    assert pose["y"] > 0.1
    assert abs(pose["x"]) < 0.02
    assert (pose["x"], pose["y"]) == pytest.approx((observed["base_x"], observed["base_y"]))
    assert pose["theta"] == pytest.approx(observed["base_yaw"])
    assert fastest > 0.05
    assert {"x", "quat", "linear", "angular", "source", "frame"} <= set(odometry)


def test_of_several_robots_one_is_named(world: Simulation) -> None:
    assert world.get_pose()["status"] == "error"
    world.add_robot("left", "so100")
    world.add_robot("right", "so100", position=(0.0, 1.0, 0.0))
    assert "robot_name must be one of ['left', 'right']" in world.get_pose()["reason"]
    assert world.get_pose("right")["y"] == 1.0
    assert world.get_pose("middle")["status"] == "error"


def test_servos_are_commanded_in_radians_and_a_rovers_tendons_in_neither(world: Simulation) -> None:
    assert world.joint_units == {}
    world.add_robot("so100")
    assert world.joint_units == dict.fromkeys(world.get_features()["robots"]["so100"]["action_features"], "radians")
    world.remove_robot("so100")
    world.add_robot("rover")
    assert world.joint_units == {}
