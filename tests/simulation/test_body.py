"""Pose and velocity of simulated bases, and the units of commands."""

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


def test_arm_has_the_pose_of_its_base_and_no_odometry(world: Simulation) -> None:
    world.add_robot("so100", position=(0.5, -0.25, 0.1), yaw=math.pi)
    pose = world.get_pose()
    assert (pose["x"], pose["y"], pose["z"]) == (0.5, -0.25, 0.1)
    assert pose["theta"] == pytest.approx(math.pi)
    assert pose["quat"] == pytest.approx([0, 0, 0, 1])
    assert (pose["source"], pose["frame"]) == ("simulation", "world")
    assert "does not move about" in world.get_odom()["reason"]


def test_rover_has_pose_and_velocity_along_its_own_axes(world: Simulation) -> None:
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


def test_get_pose_needs_a_name_with_several_robots(world: Simulation) -> None:
    assert world.get_pose()["status"] == "error"
    world.add_robot("left", "so100")
    world.add_robot("right", "so100", position=(0.0, 1.0, 0.0))
    assert "robot_name must be one of ['left', 'right']" in world.get_pose()["reason"]
    assert world.get_pose("right")["y"] == 1.0
    assert world.get_pose("middle")["status"] == "error"


def test_joint_units_are_radians_for_servos_and_absent_for_tendons(world: Simulation) -> None:
    assert world.joint_units == {}
    world.add_robot("so100")
    assert world.joint_units == dict.fromkeys(world.get_features()["robots"]["so100"]["action_features"], "radians")
    world.remove_robot("so100")
    world.add_robot("rover")
    assert world.joint_units == {}
