"""Observations of simulated robots have pictures, which cost nothing where none is read."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from fixtures.waiting import eventually

from strands_robots.policies.base import Action, Ranges, numbers
from strands_robots.policies.rollout import Rollout
from strands_robots.recording.cameras import camera_list, chosen_frames, frames_of, take_picture
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    assert simulation.add_robot("arm", "so100")["status"] == "success"
    yield simulation
    simulation.cleanup()


class Drawn:
    """Counts the pictures that a world draws."""

    def __init__(self, world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cameras: list[str] = []
        renderer = world._renderer
        render = renderer.render

        def counted(snapshot: Any, camera: str, *size: Any, **options: Any) -> Any:
            self.cameras.append(camera)
            return render(snapshot, camera, *size, **options)

        monkeypatch.setattr(renderer, "render", counted)


@pytest.fixture
def drawn(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> Drawn:
    return Drawn(world, monkeypatch)


class Looking:
    """A policy that reads some cameras of each observation."""

    follows_instruction = True

    def __init__(self, *cameras: str, uses_cameras: bool = True) -> None:
        self.uses_cameras = uses_cameras
        self.cameras = cameras
        self.seen: list[Mapping[str, Any]] = []
        self.looked = threading.Event()

    def reset(self, instruction: str, ranges: Ranges) -> None: ...

    def act(self, observation: Mapping[str, Any]) -> Action | None:
        self.seen.append({name: observation[name] for name in self.cameras})
        self.looked.set()
        return {"shoulder_pan": 0.1}

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


def run(world: Simulation, policy: Looking) -> None:
    permit = world.gate.permit("test")
    Rollout(world.body("arm"), policy, permit=permit, steps=3).run()


def test_policy_sees_the_cameras_that_it_reads_and_no_other_is_drawn(world: Simulation, drawn: Drawn) -> None:
    policy = Looking("wrist", "table")
    run(world, policy)
    for seen in policy.seen:
        for picture in seen.values():
            assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)
            assert picture.std() > 0
    assert drawn.cameras == ["arm/wrist", "table"] * 3


@pytest.mark.parametrize("uses_cameras", [True, False])
def test_loop_that_reads_no_camera_draws_nothing(world: Simulation, drawn: Drawn, uses_cameras: bool) -> None:
    run(world, Looking(uses_cameras=uses_cameras))
    world.get_observation("arm")
    assert numbers(world.body("arm").get_observation()) == world.body("arm").get_joints()
    assert drawn.cameras == []


def test_observation_has_the_pictures_of_its_own_moment(world: Simulation) -> None:
    observation = world.body("arm").get_observation()
    before = world.body("arm").get_observation()["table"]
    world.step(1)
    world.move_joints({"shoulder_pan": 60.0}, speed=1.0)
    assert np.array_equal(observation["table"], before)
    assert observation["table"] is observation["table"]
    assert not np.array_equal(world.body("arm").get_observation()["table"], before)


def test_features_and_facts_of_a_policy_name_the_cameras_and_their_size(world: Simulation) -> None:
    features = world.body("arm").observation_features
    assert {name for name, feature in features.items() if isinstance(feature, tuple)} == {"front", "table", "wrist"}
    assert world.policy_facts("arm").cameras == dict.fromkeys(("front", "table", "wrist"), (480, 640, 3))
    assert set(features) == set(world.body("arm").get_observation())


def test_observation_takes_cameras_by_name_and_refuses_others(world: Simulation) -> None:
    observation = world.get_observation("arm", cameras=["wrist"])
    assert observation["wrist"].shape == (480, 640, 3)
    assert "front" not in observation
    with pytest.raises(ValidationError, match="cameras must be one of front, table, wrist"):
        world.get_observation("arm", cameras=["ceiling"])


def test_table_camera_spans_half_a_metre_of_the_work_area(world: Simulation) -> None:
    view = world.view("table")
    corners = view.pixels([(0.24 + dx, dy, 0.0) for dx in (-0.24, 0.24) for dy in (-0.24, 0.24)], 640, 480)
    assert (corners[:, 0] > 0).all() and (corners[:, 0] < 640).all()
    assert (corners[:, 1] > 0).all() and (corners[:, 1] < 480).all()
    metre = view.pixels([(0.24, 0.0, 0.0), (0.34, 0.0, 0.0)], 640, 480)
    assert 480 / (10 * abs(metre[1][1] - metre[0][1])) == pytest.approx(0.5, abs=0.02)


def test_recordings_networks_and_agents_draw_by_one_path(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int, int]] = []
    draw = world.camera_picture

    def counted(camera: str, width: int, height: int) -> Any:
        asked.append((camera, width, height))
        return draw(camera, width, height)

    monkeypatch.setattr(world, "camera_picture", counted)
    recorded, streamed = chosen_frames(world, ["front"]), frames_of(world)
    assert recorded is not None and streamed is not None
    assert recorded()["front"].shape == streamed()["arm.wrist"].shape == (240, 320, 3)
    assert take_picture(world, "wrist", 640, 480)[1].shape == (480, 640, 3)
    assert asked == [("front", 320, 240), ("arm/wrist", 320, 240), ("arm/wrist", 640, 480)]
    assert camera_list(world)[0] == "front"


def test_rollout_of_a_policy_that_waits_for_pictures_goes_on_while_they_are_drawn(world: Simulation) -> None:
    policy = Looking("front")
    rollout = Rollout(world.body("arm"), policy, permit=world.gate.permit("test"), duration=20.0)
    rollout.start()
    eventually(lambda: rollout.step_count > 5, what="steps")
    assert world.halt("test").stopped
    assert rollout.join(20.0)
