"""A simulated arm is moved to points, and told the truth about what it reached."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    assert simulation.add_robot("arm", "so100")["status"] == "success"
    yield simulation
    simulation.cleanup()


def pose(world: Simulation, name: str = "") -> dict[str, Any]:
    return world.arm_pose(name)


def test_pose_is_that_of_the_tip_in_the_frame_of_the_base(world: Simulation) -> None:
    world.add_robot("turned", "so100", position=(1.0, 0.5, 0.0), yaw=1.5707963)
    here, there = pose(world, "arm"), pose(world, "turned")
    assert (here["x"], here["y"], here["z"]) == pytest.approx((0.299, 0.0, 0.116), abs=2e-3)
    assert (there["x"], there["y"], there["z"]) == pytest.approx((here["x"], here["y"], here["z"]), abs=2e-3)
    assert here["approach"] == pytest.approx(51.6, abs=0.5)
    assert set(here["joints"]) == {"shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"}
    assert here["gripper"] == pytest.approx(0.227, abs=0.01)


def test_tip_moves_to_a_point_and_the_answer_has_its_error(world: Simulation) -> None:
    answer = world.move_to(0.25, 0.1, 0.06, speed=1.0)
    assert answer["status"] == "success"
    assert answer["task_status"] == "completed"
    assert answer["asked"] == {"x": 0.25, "y": 0.1, "z": 0.06, "approach": 90.0}
    assert answer["error_mm"] < 3.0
    tip = world.tip_position("arm")
    assert tip == pytest.approx((0.25, 0.1, 0.06), abs=3e-3)
    assert tip == pytest.approx([answer["reached"][axis] for axis in "xyz"], abs=1e-3)


def test_refused_goals_name_the_reason_and_nothing_moves(world: Simulation) -> None:
    before = world.body("arm").targets
    assert "out of reach; the nearest reachable point is" in world.move_to(0.9, 0.0, 0.1)["reason"]
    assert "touches the table" in world.move_to(0.25, 0.0, -0.05)["reason"]
    assert "elbow_flex must be from 0.0 to 180.0 degrees" in world.move_joints({"elbow_flex": -20.0})["reason"]
    assert "there is no knee" in world.move_joints({"knee": 1.0})["reason"]
    assert "place must be one of home" in world.go_to("nowhere")["reason"]
    assert "moveBy needs" in world.move_by()["reason"]
    assert world.body("arm").targets == before


def test_robot_without_an_arm_is_refused_by_reason() -> None:
    world = Simulation()
    world.add_robot("rover")
    assert "rover has no" in world.move_to(0.2, 0.0, 0.1)["reason"]
    world.cleanup()


def test_saved_place_is_gone_to(world: Simulation) -> None:
    world.move_joints({"shoulder_pan": 20.0}, speed=1.0)
    assert world.save_place("there")["places"] == ["home", "there"]
    world.go_to("home", speed=1.0)
    assert world.go_to("there", speed=1.0)["asked"] == {"place": "there"}
    assert pose(world)["joints"]["shoulder_pan"] == pytest.approx(20.0, abs=1.0)


def test_line_goes_up_by_its_distance(world: Simulation) -> None:
    before = pose(world)
    assert world.move_by(direction="up", distance=0.04, speed=1.0)["error_mm"] < 3.0
    assert pose(world)["z"] == pytest.approx(before["z"] + 0.04, abs=3e-3)


def test_running_motion_is_told_by_its_task_and_waited_for(world: Simulation) -> None:
    started = world.move_to(0.25, 0.1, 0.06, wait=False)
    assert started["task_status"] == "running"
    assert "is driven by" in world.move_to(0.2, 0.0, 0.1)["reason"]
    assert world.wait_for(started["task_id"], 0.0)["task_status"] == "running"
    assert world.wait_for(started["task_id"])["task_status"] == "completed"
    assert world.outcomes()["arm"]["task_id"] == started["task_id"]


def test_status_has_the_outcome_of_the_last_motion_until_the_next_one(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert world.get_state()["outcomes"] == {}
    world.move_to(0.25, 0.1, 0.06, speed=1.0)
    monkeypatch.setattr(world.body("arm"), "get_joints", lambda: pytest.fail("a status reads no joints"))
    outcome = world.get_state()["outcomes"]["arm"]
    assert (outcome["task_status"], outcome["why"]) == ("completed", "it is done")
    assert outcome["error_mm"] < 3.0
    monkeypatch.undo()
    world.start_policy("arm", "wave", "mock", 30.0)
    assert world.get_state()["outcomes"] == {}
    world.stop_policy("arm")
    outcome = world.get_state()["outcomes"]["arm"]
    assert (outcome["task_status"], outcome["instruction"], outcome["why"]) == ("stopped", "wave", "it was stopped")


def test_stop_ends_a_motion_in_its_middle_and_the_answer_says_so(world: Simulation) -> None:
    started = world.move_to(0.25, 0.15, 0.06, speed=0.3, wait=False)
    eventually(lambda: world.list_policies_running()[0]["step"] > 5)
    assert world.stop_policy("arm")["stopped"]
    ended = world.wait_for(started["task_id"])
    assert ended["status"] == "error"
    assert (ended["task_status"], ended["why"]) == ("stopped", "it was stopped")
    assert ended["error_mm"] > 10
    still = world.body("arm").targets
    assert world.move_by(direction="up", distance=0.01, wait=False)["status"] == "success"
    assert world.halt("test").stopped
    assert world.body("arm").targets != still


def test_jaws_without_an_object_are_empty(world: Simulation) -> None:
    assert world.set_gripper(1.0)["holding"] is False
    closed = world.set_gripper(0.0)
    assert closed["holding"] is False
    assert closed["reached"]["gripper"] == pytest.approx(0.0, abs=0.01)


def test_jaws_around_an_object_hold_it_and_a_stop_makes_that_unknown(world: Simulation) -> None:
    world.set_gripper(1.0)
    world.add_object("bar", "box", (0.05, 0.012, 0.012), world.tip_position("arm"), fixed=True)
    assert world.set_gripper(0.0)["holding"] is True
    assert pose(world)["holding"] is True
    world.halt("test")
    assert pose(world)["holding"] is None


def test_objects_are_told_in_the_frame_of_each_base(world: Simulation) -> None:
    world.add_robot("turned", "so100", position=(1.0, 0.5, 0.0), yaw=1.5707963)
    world.add_object("cube", "box", (0.0125, 0.01, 0.015), (0.25, 0.1, 0.015))
    cube = world.get_objects("arm")["objects"]["cube"]
    assert [cube[axis] for axis in "xyz"] == pytest.approx([0.25, 0.1, 0.015], abs=1e-3)
    assert cube["size"] == pytest.approx([0.025, 0.02, 0.03])
    turned = world.get_objects("turned")["objects"]["cube"]
    assert [turned[axis] for axis in "xyz"] == pytest.approx([-0.4, 0.75, 0.015], abs=1e-3)
    assert turned["yaw"] == pytest.approx(-90.0, abs=0.5)


def test_object_may_be_turned(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.25, 0.05, 0.0125), yaw=0.5)
    assert world.get_objects()["objects"]["cube"]["yaw"] == pytest.approx(28.6, abs=0.5)
    refused = world.add_object("other", "box", (0.0125,) * 3, (0.1, 0.1, 0.0125), yaw=float("nan"))
    assert "yaw must be a finite number" in refused["reason"]


def test_cube_is_picked_up_and_put_on_the_plate(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.25, 0.05, 0.0125))
    world.add_object("plate", "cylinder", (0.05, 0.004), (0.24, -0.12, 0.004), fixed=True)
    picked = world.pick("cube", speed=1.0)
    assert (picked["task_status"], picked["holding"]) == ("completed", True), picked
    assert world.get_objects()["objects"]["cube"]["z"] > 0.05
    placed = world.place(on="plate", speed=1.0)
    assert (placed["task_status"], placed["holding"]) == ("completed", False), placed
    cube = world.get_objects()["objects"]["cube"]
    assert [cube["x"], cube["y"]] == pytest.approx([0.24, -0.12], abs=0.012)
    assert cube["z"] == pytest.approx(0.0205, abs=2e-3)
    assert "holds nothing" in world.place(on="plate")["reason"]


def test_jaws_that_close_on_nothing_are_an_error(world: Simulation) -> None:
    answer = world.pick(x=0.25, y=0.0, z=0.0125, speed=1.0)
    assert (answer["status"], answer["holding"], answer["why"]) == ("error", False, "the jaws closed on nothing")


def test_objects_that_cannot_be_picked_up_are_refused_by_reason(world: Simulation) -> None:
    world.add_object("wide", "box", (0.04, 0.04, 0.02), (0.25, 0.0, 0.02))
    world.add_object("far", "box", (0.01, 0.01, 0.01), (0.7, 0.0, 0.01))
    world.add_object("plate", "cylinder", (0.02, 0.004), (0.24, -0.12, 0.004), fixed=True)
    assert re.search(r"wide is 80 mm wide, and the gripper opens \d\d mm", world.pick("wide")["reason"])
    assert "out of reach; the nearest reachable point is" in world.pick("far")["reason"]
    assert "plate is fixed" in world.pick("plate")["reason"]
    assert "object must be one of wide, far, plate" in world.pick("cup")["reason"]
    assert "pick needs object, or x, y and z" in world.pick()["reason"]
    assert world.list_policies_running() == []
