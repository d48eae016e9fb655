"""A motion is judged by where the objects are, not only by where the tip is."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    assert simulation.add_robot("arm", "so101")["status"] == "success"
    yield simulation
    simulation.cleanup()


def test_placed_cube_is_where_the_answer_says(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.22, -0.05, 0.0125))
    picked = world.pick("cube", speed=1.0)
    assert picked["status"] == "success", picked
    assert picked["object_at"]["z"] > 0.03
    placed = world.place(0.22, 0.06, speed=1.0)
    assert placed["status"] == "success", placed
    cube = world.get_objects()["objects"]["cube"]
    assert placed["object_error_mm"] < 15
    assert [placed["object_at"][axis] for axis in "xyz"] == pytest.approx([cube[axis] for axis in "xyz"], abs=2e-3)
    assert placed["moved"] == {}


def test_ball_that_rolls_off_its_place_is_an_error_with_its_distance(world: Simulation) -> None:
    world.add_object("ball", "sphere", (0.0125,), (0.22, -0.05, 0.0125))
    if world.pick("ball", speed=1.0)["status"] == "success":
        placed = world.place(0.22, 0.06, z=0.05, speed=1.0)
        assert (placed["status"], placed["task_status"]) == ("error", "error")
        assert "ball is" in placed["why"]
        assert placed["object_error_mm"] > 15


def test_occupied_place_is_refused_and_nothing_moves(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.22, -0.05, 0.0125))
    world.add_object("other", "box", (0.0125,) * 3, (0.22, 0.06, 0.0125))
    assert world.pick("cube", speed=1.0)["status"] == "success"
    refused = world.place(0.225, 0.06)
    assert "other is at that place; put cube elsewhere, or on it by on=other" in refused["reason"]
    assert "task_id" not in refused


def test_lower_cube_of_a_stack_is_refused(world: Simulation) -> None:
    world.add_object("low", "box", (0.0125,) * 3, (0.22, 0.0, 0.0125))
    world.add_object("high", "box", (0.0125,) * 3, (0.22, 0.0, 0.0375))
    assert "high stands on low; pick high up first" in world.pick("low")["reason"]


def test_pushed_object_is_named_with_its_millimetres(world: Simulation) -> None:
    world.move_to(0.24, -0.08, 0.02, speed=1.0)
    world.add_object("glass", "box", (0.0125, 0.0125, 0.03), (0.24, 0.0, 0.03))
    before = world.get_objects()["objects"]["glass"]
    answer = world.move_joints({"shoulder_pan": -25.0}, speed=1.0, around=False)
    after = world.get_objects()["objects"]["glass"]
    distance = 1000 * ((after["x"] - before["x"]) ** 2 + (after["y"] - before["y"]) ** 2) ** 0.5
    assert answer["moved"]["glass"] == pytest.approx(distance, abs=8)
    assert "glass was moved by" in answer["why"]
