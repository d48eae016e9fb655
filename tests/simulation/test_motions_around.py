"""Motions go around the objects that are seen, or are refused by the object's name."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from strands_robots.kinematics import moves
from strands_robots.kinematics.moves import Start
from strands_robots.kinematics.objects import ContactCheck, beside
from strands_robots.simulation import Simulation

SIDE = (0.22, -0.12, 0.05)
OTHER_SIDE = (0.22, 0.12, 0.05)


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bound the searches by their tries, for the time that they take depends on the machine."""
    monkeypatch.setattr("strands_robots.arm_mixin.PLAN_S", 600.0)
    monkeypatch.setattr("strands_robots.kinematics.planner.TRIES_MAX", 300)


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    assert simulation.add_robot("arm", "so101")["status"] == "success"
    assert simulation.move_to(*SIDE, speed=1.0)["status"] == "success"
    yield simulation
    simulation.cleanup()


def post(world: Simulation) -> None:
    world.add_object("post", "box", (0.02, 0.02, 0.06), (0.25, 0.0, 0.06))


def test_motion_goes_around_an_object_in_its_way(world: Simulation) -> None:
    post(world)
    answer = world.move_to(*OTHER_SIDE, speed=1.0)
    assert answer["why"] == "it is done"
    assert answer["moved"] == {}
    assert world.tip_position("arm") == pytest.approx(OTHER_SIDE, abs=5e-3)


def test_around_false_is_the_straight_way_through_it(world: Simulation) -> None:
    post(world)
    assert world.move_to(*OTHER_SIDE, speed=1.0, around=False)["moved"]["post"] > 20


def test_motion_without_a_way_is_refused_by_the_objects_name_and_nothing_moves(world: Simulation) -> None:
    world.add_object("wall", "box", (0.4, 0.01, 0.4), (0.2, 0.05, 0.4), fixed=True)
    before = world.body("arm").targets
    assert "touches the wall" in world.move_to(*OTHER_SIDE)["reason"]
    assert "touches the wall" in world.move_joints({"shoulder_pan": -60.0})["reason"]
    assert "touches the wall" in world.move_by(dy=0.2)["reason"]
    assert world.body("arm").targets == before


def test_free_way_is_straight_and_searches_nothing(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.kinematics.planner.path_around", lambda *_: pytest.fail("no search is needed"))
    world.add_object("cube", "box", (0.0125,) * 3, (0.3, 0.15, 0.0125))
    assert world.move_to(*OTHER_SIDE, speed=1.0)["status"] == "success"


def test_stop_ends_a_motion_that_is_still_planned(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    post(world)
    searching, answers = threading.Event(), []

    def endless(start: object, goal: object, limits: object, clear: object, going: Callable[[], bool]) -> None:
        searching.set()
        while going():
            pass

    monkeypatch.setattr("strands_robots.kinematics.planner._RETREAT_M", ())
    monkeypatch.setattr("strands_robots.kinematics.planner.path_around", endless)
    before = world.body("arm").targets
    moving = threading.Thread(target=lambda: answers.append(world.move_to(*OTHER_SIDE)))
    moving.start()
    assert searching.wait(10.0)
    assert world.halt("test").stopped
    moving.join(5.0)
    assert not moving.is_alive()
    ended: dict[str, Any] = dict(answers[0])
    assert ended["status"] == "error"
    assert "task_id" not in ended
    assert world.body("arm").targets == pytest.approx(before, abs=0.05)


def test_carried_object_goes_around_as_well(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.2, -0.12, 0.0125))
    assert world.pick("cube", speed=1.0)["why"] == "it is done"
    world.add_object("post", "box", (0.015, 0.015, 0.05), (0.24, 0.0, 0.05))
    placed = world.place(0.2, 0.12, speed=1.0)
    assert placed["status"] == "success", placed
    assert "post" not in placed["moved"]


@pytest.mark.parametrize("distance", [0.044, 0.0425])
def test_object_within_the_clearance_is_gone_around_and_not_pushed(world: Simulation, distance: float) -> None:
    assert world.move_to(0.25, -0.1, 0.05, speed=1.0)["status"] == "success"
    x, y, _ = world.tip_position("arm")
    pan = world.arm_pose()["joints"]["shoulder_pan"]
    world.add_object("post", "box", (0.01, 0.01, 0.06), (x, y + distance, 0.06))
    answer = world.move_joints({"shoulder_pan": -pan}, speed=1.0)
    assert "touches the post" in answer.get("reason", "") or answer["moved"] == {}, answer


class Eyes(Simulation):
    """A world whose objects are those of a detector, which can hang."""

    knows_objects = False
    detector: Any = object()
    hangs = False
    asked = 0
    going_on: threading.Event

    def objects(self, robot_name: str = "") -> list[Any]:
        self.asked += 1
        if self.hangs:
            self.going_on.wait(30.0)
        return super().objects(robot_name)


@pytest.fixture
def eyes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Eyes]:
    monkeypatch.setattr("strands_robots.arm_mixin.LOOK_S", 0.3)
    simulation = Eyes()
    simulation.going_on = threading.Event()
    simulation.add_robot("arm", "so101")
    simulation.add_object("cube", "box", (0.0125,) * 3, (0.25, -0.05, 0.0125))
    yield simulation
    simulation.going_on.set()
    simulation.cleanup()


def test_stopped_motion_is_over_at_once_and_is_not_looked_at(eyes: Eyes) -> None:
    started = eyes.pick("cube", speed=0.2, wait=False)
    eyes.hangs, asked = True, eyes.asked
    assert eyes.halt("test").stopped
    assert eyes.wait_for(started["task_id"], 5.0)["task_status"] == "stopped"
    assert eyes.asked == asked


def test_end_that_a_detector_does_not_answer_for_is_told_after_its_deadline(eyes: Eyes) -> None:
    started = eyes.pick("cube", speed=1.0, wait=False)
    eyes.hangs = True
    assert eyes.wait_for(started["task_id"], 20.0)["task_status"] == "completed"


def test_detector_that_hangs_refuses_a_motion_and_names_the_way_without_it(eyes: Eyes) -> None:
    eyes.hangs = True
    for _ in range(2):
        assert "the detector gave no answer" in (reason := eyes.move_by(dz=0.01)["reason"])
        assert "around=false" in reason
    assert eyes.move_by(dz=0.01, around=False, speed=1.0)["status"] == "success"


@pytest.mark.parametrize("hover", [0.01, 0.07])
def test_pick_goes_around_its_own_target_on_the_way_to_it(
    world: Simulation, monkeypatch: pytest.MonkeyPatch, hover: float
) -> None:
    # The lower one is still between the jaws.
    monkeypatch.setattr(moves, "HOVER_M", (hover,))
    body = world.body("arm")
    world.add_object("bottle", "box", (0.012, 0.012, 0.03), (0.22, 0.0, 0.03))
    seen = world.objects("arm")
    start = Start(body.arm, body.arm.state(body.get_joints()), 50, 1.0, seen)
    motion, _ = moves.pick(start, seen[0], None)
    transit = next(segment for segment in motion.segments if segment.name == "hover")
    path = np.array([body.arm.setpoints(frame) for frame in transit.frames])
    assert ContactCheck(beside(body.arm.chain, seen), body.arm.jaw_radians(1.0)).along(path, {}) == ""


def test_jaws_that_open_push_nothing_that_stands_beside_the_place(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.2, -0.12, 0.0125))
    assert world.pick("cube", speed=1.0)["why"] == "it is done"
    for index, (x, y) in enumerate(((0.2, 0.17), (0.25, 0.12))):
        world.add_object(f"glass {index}", "box", (0.0125, 0.0125, 0.03), (x, y, 0.03), mass=0.02)
    answer = world.place(0.2, 0.12, speed=1.0)
    assert answer["status"] == "error" or answer["moved"] == {}, answer
