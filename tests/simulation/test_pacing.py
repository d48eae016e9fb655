"""Real time, locks and halts of a simulated world."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from fixtures.waiting import eventually

from strands_robots.safety.gate import MotionGate, PermitVoidError
from strands_robots.simulation import Simulation
from strands_robots.simulation.model import compile_scene
from strands_robots.simulation.physics import Physics, WorldClock
from strands_robots.simulation.scene import Scene, SceneRobot, find


def pacers() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("simulation")]


pytestmark = pytest.mark.usefixtures("patient_halts")


@pytest.fixture
def physics() -> Physics:
    return Physics(compile_scene(Scene(robots=(SceneRobot("arm", find("so100")),))))


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    simulation.add_robot("arm", "so100")
    yield simulation
    simulation.cleanup()


def test_idle_world_has_no_thread(world: Simulation) -> None:
    assert pacers() == []
    assert world.get_state()["step_count"] == 0


def test_command_is_followed_in_real_time_and_then_the_thread_ends(world: Simulation) -> None:
    began = time.monotonic()
    world.send_action({"shoulder_pan": 0.5})
    eventually(lambda: abs(world.get_observation()["shoulder_pan"] - 0.5) < 0.02, what="arm follows")
    assert world.get_state()["sim_time"] <= time.monotonic() - began + 0.05
    eventually(lambda: not pacers(), what="pacer ends")


def test_command_after_a_step_by_hand_starts_no_clock(world: Simulation) -> None:
    world.step(10)
    world.send_action({"shoulder_pan": 0.5})
    assert pacers() == []
    assert world.get_state()["step_count"] == 10


def test_simulated_time_follows_real_time(physics: Physics) -> None:
    clock = WorldClock(physics)
    began = time.monotonic()
    with clock.running():
        for passed in (0.05, 0.55):
            eventually(lambda passed=passed: physics.snapshot.time > passed)
            # Never ahead of real time; the delay depends on the machine.
            assert physics.snapshot.time <= time.monotonic() - began + 0.05
    clock.close()
    assert pacers() == []


def test_many_worlds_share_one_thread() -> None:
    worlds = [Simulation() for _ in range(6)]
    for simulation in worlds:
        simulation.add_robot("arm", "so100")
        simulation.send_action({"gripper": 1.0})
    assert len(pacers()) == 1
    eventually(lambda: all(w.get_state()["step_count"] > 20 for w in worlds), what="all advance")
    for simulation in worlds:
        simulation.cleanup()
    assert pacers() == []


def test_reads_and_commands_do_not_wait_for_a_step(physics: Physics, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, let_go = threading.Event(), threading.Event()

    def slow_step(*_: object, **__: object) -> None:
        inside.set()
        let_go.wait(60)

    def read() -> None:
        for _ in range(50):
            physics.snapshot.joints(physics.compiled.robots["arm"])
            physics.command("arm", {"gripper": 0.1})

    monkeypatch.setattr("mujoco.mj_step", slow_step)
    stepping = threading.Thread(target=physics.advance, args=(1,), daemon=True)
    reading = threading.Thread(target=read, daemon=True)
    stepping.start()
    try:
        assert inside.wait(20)
        reading.start()
        reading.join(20)
        assert not reading.is_alive()
    finally:
        let_go.set()
        stepping.join(20)


def test_snapshot_is_never_half_a_step(physics: Physics) -> None:
    torn: list[object] = []
    stop = threading.Event()

    def reader() -> None:
        while not stop.is_set():
            seen = physics.snapshot
            before = seen.qpos.copy()
            if seen.steps != round(seen.time / 0.002) or not np.array_equal(before, seen.qpos):
                torn.append(seen)

    thread = threading.Thread(target=reader)
    thread.start()
    for _ in range(400):
        physics.advance(3)
    stop.set()
    thread.join()
    assert torn == []


def test_command_with_a_void_permit_is_not_written(physics: Physics) -> None:
    gate = MotionGate()
    permit = gate.permit("send_action")
    gate.revoke()
    before = physics.setpoints
    with pytest.raises(PermitVoidError):
        physics.command("arm", {"gripper": 1.0}, permit)
    assert np.array_equal(before, physics.setpoints)


def test_halt_freezes_a_moving_arm(world: Simulation) -> None:
    world.send_action({"shoulder_pan": 2.0})
    eventually(lambda: world.get_observation()["shoulder_pan"] > 0.3, what="arm moves")
    verdict = world.halt("test")
    where = world.get_observation()["shoulder_pan"]
    assert verdict.stopped is True
    steps = world.get_state()["step_count"]
    eventually(lambda: world.get_state()["step_count"] > steps + 300, what="physics continues")
    # It runs out its speed within a few degrees and stays, instead of going on to 2.0.
    assert abs(world.get_observation()["shoulder_pan"] - where) < 0.35


def test_halt_stops_the_rover() -> None:
    simulation = Simulation(realtime=False)
    simulation.add_robot("rover")
    simulation.send_action({"linear_velocity": 0.5})
    simulation.step(500)
    simulation.halt("test")
    simulation.step(250)
    before = simulation.get_observation()["base_x"]
    simulation.step(500)
    assert simulation.get_observation()["base_x"] == pytest.approx(before, abs=0.002)
    simulation.cleanup()


def test_late_world_catches_up_one_second_and_drops_the_rest(physics: Physics) -> None:
    clock = WorldClock(physics)
    now = time.monotonic()
    clock.tick(now)
    for _ in range(200):
        clock.tick(now + 0.6)
    assert physics.snapshot.time == pytest.approx(0.6, abs=0.003)
    assert clock.real_time_factor == 1.0
    for _ in range(400):
        clock.tick(now + 5.6)
    assert physics.snapshot.time == pytest.approx(1.6, abs=0.005)
    assert clock.slipped_s == pytest.approx(4.0, abs=0.01)
    assert clock.real_time_factor == pytest.approx(1.6 / 5.6, abs=0.01)
