"""Stops of one robot of a world, and of motions that have not begun yet."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.waiting import eventually

from strands_robots.envelope import error
from strands_robots.safety.gate import Permit
from strands_robots.simulation import Simulation, motion
from strands_robots.teleoperators.leader import ScriptedLeader

pytestmark = pytest.mark.usefixtures("patient_halts")


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    simulation.add_robot("left", "so100")
    simulation.add_robot("right", "so101")
    yield simulation
    simulation.cleanup()


def swinging() -> ScriptedLeader:
    return ScriptedLeader({"shoulder_pan": (0.0, 0.5, 1.0)})


def test_stopping_one_robot_stops_the_leader_that_drives_it_and_no_other(world: Simulation) -> None:
    for name in ("left", "right"):
        world.attach_teleop(swinging(), f"leader-{name}", robot_name=name)
        assert world.teleoperate(f"leader-{name}")["status"] == "success"
    answer = world.stop_policy("left")
    assert answer["stopped"] is True
    assert list(world.teleoperating()) == ["leader-right"]
    held = world.body("left").targets
    eventually(lambda: world.teleoperating()["leader-right"].step_count > 20)
    assert world.body("left").targets == held


def test_stopping_one_robot_reaches_its_policy_that_still_loads_and_no_other(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready, loading = threading.Event(), threading.Semaphore(0)

    def slow(provider: str, **options: Any) -> ScriptedPolicy:
        loading.release()
        assert ready.wait(60)
        return ScriptedPolicy([], always={"shoulder_pan": 0.5})

    monkeypatch.setattr(motion, "create_policy", slow)
    answers: dict[str, Any] = {}
    threads = [
        threading.Thread(target=lambda name=name: answers.update({name: world.start_policy(name, "wave")}))
        for name in ("left", "right")
    ]
    for thread in threads:
        thread.start()
    assert all(loading.acquire(timeout=20) for _ in threads)
    assert world.stop_policy("left")["stopped"] is True
    ready.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert answers["left"]["status"] == "error"
    assert answers["right"]["status"] == "success"
    assert [row["robot"] for row in world.list_policies_running()] == ["right"]


def test_a_reset_that_waited_for_its_turn_does_not_move_what_was_stopped_meanwhile(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.step(1)  # by hand from here on
    world.send_action({"shoulder_pan": 0.5}, "left")
    world.step(500)
    before = world.get_observation("left")
    answers: list[Any] = []
    asked: list[str] = []
    permit = world.gate.permit

    def noted(verb: str) -> Permit:
        given = permit(verb)
        asked.append(verb)
        return given

    monkeypatch.setattr(world.gate, "permit", noted)
    with world.starting:
        thread = threading.Thread(target=lambda: answers.append(world.reset()))
        thread.start()
        eventually(lambda: "reset" in asked)
        thread.join(0.1)
        assert thread.is_alive(), "it waits for whoever builds the world"
        assert world.halt("test").stopped is True
    thread.join(20)
    assert answers[0]["status"] == "error"
    assert world.get_observation("left")["shoulder_pan"] == pytest.approx(before["shoulder_pan"], abs=0.05)


def test_a_stop_in_the_middle_of_a_reset_keeps_the_world_as_it_is(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.send_action({"shoulder_pan": 0.5}, "left")
    world.step(500)
    stops = world._stops

    def meanwhile(deadline: float) -> Any:
        found = stops(deadline)
        monkeypatch.undo()
        assert world.halt("somebody else").stopped is True
        return found

    monkeypatch.setattr(world, "_stops", meanwhile)
    assert world.reset()["status"] == "error"
    assert world.get_observation("left")["shoulder_pan"] > 0.3


def test_a_locked_world_is_not_started_over(world: Simulation) -> None:
    class Locked:
        def refusal(self, verb: str) -> dict[str, Any]:
            return error(f"{verb} is locked.")

    world.gate.attach(Locked())
    assert world.create_world()["reason"] == "create_world is locked."
    assert world.list_robots() == ["left", "right"]


def test_stopping_a_robot_on_its_way_to_a_single_target_freezes_it_and_no_other(world: Simulation) -> None:
    world.step(1)  # by hand from here on, so that nobody is there before the stop
    for name in ("left", "right"):
        world.send_action({"shoulder_pan": 1.0}, name)
    world.step(50)
    answer = world.stop_policy("left")
    assert (answer["stopped"], answer["was_running"]) == (True, False)
    where = world.get_observation("left")["shoulder_pan"]
    assert world.body("left").targets["shoulder_pan"] == pytest.approx(where, abs=0.05)
    assert world.body("right").targets["shoulder_pan"] == 1.0
    world.step(1000)
    assert world.get_observation("right")["shoulder_pan"] > 0.8
    assert world.get_observation("left")["shoulder_pan"] < 0.8


def test_an_action_that_was_overtaken_by_the_stop_of_its_robot_sets_nothing(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = world._idle

    def meanwhile(name: str) -> None:
        idle(name)
        monkeypatch.undo()
        assert world.stop_policy("left")["stopped"] is True

    for robot, status in (("left", "error"), ("right", "success")):
        monkeypatch.setattr(world, "_idle", meanwhile)
        answer = world.send_action({"shoulder_pan": 1.0}, robot)
        assert answer["status"] == status
        assert (world.body(robot).targets["shoulder_pan"] == 1.0) is (status == "success")
