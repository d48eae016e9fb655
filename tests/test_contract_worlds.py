"""A world is a collection of robots, and every robot answers the same questions about what it holds."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot, ToyWorld

from strands_robots.adapted import adapt, behind_contract
from strands_robots.contract import holds_robots, robots_in, task_runs
from strands_robots.envelope import Envelope, success
from strands_robots.serving.robot_verbs import takes_tasks
from strands_robots.serving.stops import OneRobot
from strands_robots.simulation import Simulation


class Foreign:
    """No more than the four verbs, and a method of the name that a world has."""

    status = "idle"

    def start_task(self, instruction: str, **options: Any) -> Envelope:
        return success("Started.")

    def stop_task(self) -> Envelope:
        return success("Stopped.", stopped=True)

    def get_task_status(self) -> Envelope:
        return success("Here.", task_status=self.status)

    def get_features(self) -> Envelope:
        return success("None.")

    def list_robots(self) -> list[str]:
        raise ConnectionError("the fleet manager is away")


class ListingToy(ToyRobot):
    """A robot that fits, with a method of the name that a world has."""

    def list_robots(self) -> list[str]:
        raise ConnectionError("the fleet manager is away")


class EqualWorld(ToyWorld):
    """Equal to everything, and without a hash."""

    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        return True


class WatchedWorld(ToyWorld):
    """Counts how often it is asked for anything."""

    asked = 0

    def __getattribute__(self, name: str) -> Any:
        WatchedWorld.asked += 1
        return super().__getattribute__(name)


@pytest.mark.parametrize(
    ("world", "names"),
    [
        (ToyWorld(), ["left", "right"]),
        (ToyWorld(robots=()), []),
        (EqualWorld(), ["left", "right"]),
        (OneRobot(ToyWorld(), "left"), ["left"]),
    ],
    ids=["two", "none", "equal to everything", "one of two"],
)
def test_a_world_says_which_robots_it_holds(world: Any, names: list[str]) -> None:
    assert behind_contract(world) is world
    assert holds_robots(world)
    assert robots_in(world) == names


@pytest.mark.parametrize(
    "robot",
    [ToyRobot(), ListingToy(), adapt(Foreign()), Foreign(), None],
    ids=["ours", "one that lists others", "adapted", "foreign", "none"],
)
def test_a_robot_by_itself_holds_none(robot: Any) -> None:
    assert not holds_robots(robot)
    assert robots_in(robot) == []


@pytest.mark.parametrize("robot", [ListingToy(), Foreign()], ids=["ours", "foreign"])
def test_a_robot_that_lists_others_is_served_as_the_one_that_it_is(robot: Any) -> None:
    assert takes_tasks(behind_contract(robot))


def test_robots_that_come_and_go_are_listed_as_they_are_now() -> None:
    world = Simulation()
    try:
        assert holds_robots(world)
        assert robots_in(world) == []
        for name in ("left", "right"):
            assert world.add_robot(name, "so100")["status"] == "success"
        assert robots_in(world) == ["left", "right"]
        assert world.remove_robot("left")["status"] == "success"
        assert robots_in(world) == ["right"]
    finally:
        world.cleanup()


def test_the_whole_contract_of_a_world_is_checked_once() -> None:
    world = WatchedWorld()
    assert holds_robots(world)
    WatchedWorld.asked = 0
    assert holds_robots(world)
    assert WatchedWorld.asked == 1


@pytest.mark.parametrize(("status", "runs"), [("idle", False), ("running", True), ("error", False), ("dancing", None)])
def test_a_robot_says_whether_its_task_runs(status: str, runs: bool | None) -> None:
    robot = Foreign()
    robot.status = status
    assert task_runs(adapt(robot)) is runs


def test_a_world_says_of_each_robot_whether_its_task_runs(patient_halts: None) -> None:
    world = ToyWorld()
    try:
        assert world.start_policy("left", "wave")["status"] == "success"
        assert task_runs(world, "left") is True
        assert task_runs(world, "right") is False
    finally:
        world.close()
