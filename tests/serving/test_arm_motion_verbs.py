"""Domains of the arm's verbs, and robots that have no arm."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot

from strands_robots.adapted import adapt
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, WORLD_MOTION_VERBS
from strands_robots.serving.verbs import Kind
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "0.1", 3.01])
def test_coordinate_outside_its_domain_is_refused_by_name(value: Any) -> None:
    with pytest.raises(ValidationError, match="z must be a finite number from -3 to 3"):
        ARM_MOTION_VERBS["moveTo"].checked({"x": 0.2, "y": 0.0, "z": value})


@pytest.mark.parametrize("joints", [{}, [1.0], {"elbow_flex": math.nan}, {"elbow_flex": False}, {"elbow_flex": 1e9}])
def test_joints_must_be_degrees_by_name(joints: Any) -> None:
    with pytest.raises(ValidationError, match="joints"):
        ARM_MOTION_VERBS["moveJoints"].checked({"joints": joints})


def test_approach_may_be_left_out_and_the_other_options_have_defaults() -> None:
    checked = ARM_MOTION_VERBS["moveTo"].checked({"x": 0, "y": 0, "z": 0.1})
    options = {"approach": None, "speed": 0.5, "wait": True, "picture": "", "around": True}
    options |= {"lease_id": "", "lease_ttl_s": 0.0}
    assert checked == {"x": 0.0, "y": 0.0, "z": 0.1, **options}


def test_a_world_names_the_robot_besides() -> None:
    for name, verb in WORLD_MOTION_VERBS.items():
        assert list(verb.by_name) == [*ARM_MOTION_VERBS[name].by_name, "robot_name"]


def test_reads_need_no_leave_to_move() -> None:
    reads = {name for name, verb in ARM_MOTION_VERBS.items() if verb.kind is Kind.READ}
    assert reads == {"getPose", "getObjects", "wait"}


def test_robot_without_an_arm_says_so() -> None:
    verb = ARM_MOTION_VERBS["getPose"]
    answer: Any = verb.call(adapt(ToyRobot()), {})()
    assert answer["reason"] == "This robot has no arm whose motions can be planned here."


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    assert simulation.add_robot("arm", "so100")["status"] == "success"
    yield simulation
    simulation.cleanup()


def run(world: Simulation, name: str, **arguments: Any) -> dict[str, Any]:
    verb = WORLD_MOTION_VERBS[name]
    checked = verb.checked(arguments)
    answer = verb.call(world, {key: value for key, value in checked.items() if not key.startswith("lease_")})()
    assert isinstance(answer, dict)
    return answer


@pytest.mark.parametrize("camera", ["wrist", "arm/wrist", "table"])
def test_answer_of_a_motion_brings_the_picture_that_was_asked_for(world: Simulation, camera: str) -> None:
    answer = run(world, "moveJoints", joints={"shoulder_pan": 5.0}, speed=1.0, picture=camera)
    assert answer["task_status"] == "completed"
    picture = answer["picture"]
    assert picture["camera"].endswith(camera)
    assert (picture["width"], picture["height"], picture["format"]) == (640, 480, "jpeg")
    assert base64.b64decode(picture["jpeg"])[:2] == b"\xff\xd8"
    assert "picture" not in run(world, "wait")


def test_unknown_camera_is_refused_before_the_motion(world: Simulation) -> None:
    before = world.body("arm").targets
    answer = run(world, "moveJoints", joints={"shoulder_pan": 5.0}, picture="ceiling")
    assert "camera must be one of front" in answer["reason"]
    assert world.body("arm").targets == before


def test_camera_that_fails_takes_nothing_from_the_result(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(camera: str, width: int, height: int) -> None:
        raise OSError("unplugged")

    monkeypatch.setattr(world, "camera_picture", broken)
    answer = run(world, "moveJoints", joints={"shoulder_pan": 5.0}, speed=1.0, picture="front")
    assert (answer["status"], answer["task_status"]) == ("success", "completed")
    assert "unplugged" in answer["picture_error"]
