"""A simulated world as a device, without a network."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.driver_bench import DriverBench
from fixtures.toy_robots import ToyWorld

from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.envelope import error
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError


@pytest.fixture
def world() -> Iterator[ToyWorld]:
    toy = ToyWorld()
    yield toy
    toy.close()


async def test_execute_without_a_robot_takes_the_first_and_names_it(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        answer = await bench.call("execute", None, instruction="wave")
        assert answer["status"] == "success"
        assert answer["robot_name"] == "left"
        assert world.rollouts["left"].running


async def test_execute_moves_the_robot_it_names(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        assert (await bench.call("execute", instruction="wave", robot_name="right"))["robot_name"] == "right"
        assert list(world.rollouts) == ["right"]


@pytest.mark.parametrize("name", ["middle", "Left", "x" * 129, "a\n", 1, None, True, []])
async def test_a_robot_that_is_not_there_is_refused_by_name(world: ToyWorld, name: Any) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        answer = await bench.call("execute", instruction="wave", robot_name=name)
        assert "robot_name" in answer["reason"]
        assert world.rollouts == {}


async def test_an_empty_world_has_nothing_to_execute() -> None:
    async with DriverBench(SimulationDeviceDriver(ToyWorld(robots=()))) as bench:
        assert "no robot" in (await bench.call("execute", instruction="wave"))["reason"]


@pytest.mark.parametrize("steps", [0, -1, 100_001, 1.5, True, "5", None, math.nan, 10**400])
async def test_a_number_of_steps_out_of_its_domain_is_refused(world: ToyWorld, steps: Any) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        assert "n_steps" in (await bench.call("step", n_steps=steps))["reason"]
        assert world.step_count == 0


async def test_step_and_reset_act(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        assert (await bench.call("step", n_steps=7))["status"] == "success"
        assert (await bench.call("getStatus"))["step_count"] == 7
        assert (await bench.call("reset"))["status"] == "success"
        assert (await bench.call("getStatus"))["step_count"] == 0


@pytest.mark.parametrize("verb", ["execute", "step", "reset"])
async def test_a_set_list_closes_the_simulation_too(
    world: ToyWorld, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "operator")
    params = {"instruction": "wave"} if verb == "execute" else {}
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        assert (await bench.call(verb, None, **params))["status"] == "error"
        assert (await bench.call(verb, "operator", **params))["status"] == "success"


async def test_stop_names_what_stopped(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        for name in ("left", "right"):
            await bench.call("execute", instruction="wave", robot_name=name)
        answer = await bench.call("stop")
        assert answer["status"] == "success"
        assert sorted(answer["stopped"]) == ["left", "right"]
        assert answer["not_stopped"] == []
        assert "left" in answer["content"][0]["text"]


async def test_stop_of_one_robot_leaves_the_others_moving(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        for name in ("left", "right"):
            assert (await bench.call("execute", instruction="wave", robot_name=name))["status"] == "success"
        answer = await bench.call("stop", robot_name="left")
        assert (answer["status"], answer["stopped"], answer["not_stopped"]) == ("success", ["left"], [])
        assert [row["robot"] for row in world.list_policies_running()] == ["right"]
        assert (await bench.call("stop", robot_name=""))["stopped"] == ["right"]


async def test_stop_of_a_robot_that_is_not_there_stops_nothing_and_is_no_success(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave", robot_name="left")
        answer = await bench.call("stop", robot_name="middle")
        assert answer["status"] == "error"
        assert answer["not_stopped"] == ["middle"]
        assert [row["robot"] for row in world.list_policies_running()] == ["left"]


@pytest.mark.parametrize("name", [5, True, None, "x" * 100_000, "\x00", ["left"], {"left": [[]]}])
async def test_stop_of_a_name_that_cannot_be_read_stops_the_whole_world(world: ToyWorld, name: Any) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave", robot_name="left")
        answer = await bench.call("stop", robot_name=name, reason="x" * 10_000, other=[[]])
        assert answer["status"] == "success"
        assert "2 unknown arguments" in answer["ignored"]
        assert ("robot_name is not readable" in answer["ignored"]) is (name is not None)
        assert world.list_policies_running() == []


async def test_stop_of_one_robot_voids_its_pending_command_alone(world: ToyWorld) -> None:
    async with DriverBench(driver := SimulationDeviceDriver(world)) as bench:
        pending = {name: driver.pipeline.pending.arrive(name) for name in ("left", "right")}
        await bench.call("stop", robot_name="left")
        for name, voided in (("left", True), ("right", False)):
            assert (driver.robot.gate.refusal("execute", pending[name]) is not None) is voided


async def test_stop_of_a_still_simulation_is_an_affirmative_nothing(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        answer = await bench.call("stop")
        assert (answer["status"], answer["stopped"], answer["not_stopped"]) == ("success", [], [])


async def test_stop_names_what_did_not_stop_beside_what_did(world: ToyWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    stop = world.stop_policy
    monkeypatch.setattr(world, "stop_policy", lambda name: error("its loop hangs") if name == "left" else stop(name))
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        for name in ("left", "right"):
            await bench.call("execute", instruction="wave", robot_name=name)
        answer = await bench.call("stop")
        assert answer["status"] == "error"
        assert "right" in answer["stopped"]
        assert answer["not_stopped"] == ["left"]
        assert "its loop hangs" in answer["reason"]


async def test_a_policy_that_hangs_does_not_hold_up_the_stop_of_the_others(world: ToyWorld) -> None:
    waited: list[bool] = []
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        for name in ("left", "right"):
            await bench.call("execute", instruction="wave", robot_name=name)
        permits = [rollout._permit for rollout in world.rollouts.values()]
        world.before["stop_policy"] = lambda: waited.append(any(permit.valid for permit in permits))
        assert (await bench.call("stop"))["status"] == "success"
    assert waited == [False, False], "every permit is void before anybody waits for a rollout"


async def test_halt_that_hangs_leaves_the_rollouts_their_own_stops(
    world: ToyWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    let_go = threading.Event()
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave")
        world.before["halt"] = let_go.wait
        answer = await bench.call("stop")
        assert not world.rollouts["left"].running
        assert answer["stopped"] == ["left"]
        assert "no answer" in answer["reason"]
        let_go.set()


async def test_a_world_torn_down_under_a_stop_is_an_error_and_not_an_exception(
    world: ToyWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed() -> list[dict[str, Any]]:
        raise RuntimeError("dictionary changed size during iteration")

    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave")
        monkeypatch.setattr(world, "list_policies_running", changed)
        answer = await bench.call("stop")
        assert answer["status"] == "error"
        assert not world.rollouts["left"].running


async def test_an_emergency_stop_halts_everything_and_names_what_goes_on(
    world: ToyWorld, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    verdict = StopVerdict(halted=("left",), not_stopped={"teleoperation": "its loop hangs"})
    monkeypatch.setattr(world, "halt", lambda reason="": verdict)
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        with caplog.at_level(logging.CRITICAL):
            await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {})
            await bench.until(lambda: "teleoperation" in caplog.text)


async def test_policies_are_told_from_their_start_to_their_end(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave", duration=0.4)
        await bench.until(lambda: bench.of("policyComplete"))
        started, ended = bench.of("policyStarted")[0], bench.of("policyComplete")[0]
        assert (started["robot_name"], started["instruction"], started["policy_provider"]) == ("left", "wave", "mock")
        assert (ended["robot_name"], ended["state"]) == ("left", "completed")
        assert [e["step"] for e in bench.of("streamStep")] == list(range(1, ended["steps"] + 1))


async def test_moving_robots_are_observed_ten_times_a_second_at_most(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        began = time.monotonic()
        for name in ("left", "right"):
            await bench.call("execute", instruction="wave", robot_name=name, duration=300.0)
        for name in ("left", "right"):
            await bench.until(lambda: len(bench.of("observationUpdate")) >= 16)
            seen = [e for e in bench.of("observationUpdate") if e["robot_name"] == name]
            assert len(seen) >= 8
            assert len(seen) <= (time.monotonic() - began) * 10.0 + 3
            assert set(seen[0]["joints"]) == {"pan", "lift", "elbow"}


async def test_world_at_rest_is_observed_once(world: ToyWorld) -> None:
    driver = SimulationDeviceDriver(world)
    async with DriverBench(driver) as bench:
        await bench.until(lambda: bench.of("observationUpdate"))
        looks: list[None] = []
        glance = driver.glance

        def counted() -> Any:
            looks.append(None)
            return glance()

        driver.glance = counted  # type: ignore[method-assign]
        await bench.until(lambda: len(looks) >= 2)
        assert len(bench.of("observationUpdate")) == 2
        assert len(bench.of("stateUpdate")) == 1


async def test_state_names_the_running_policies(world: ToyWorld) -> None:
    async with DriverBench(SimulationDeviceDriver(world)) as bench:
        await bench.call("execute", instruction="wave")
        await bench.until(lambda: any(e["running_policies"] for e in bench.of("stateUpdate")))
        running = next(e["running_policies"] for e in bench.of("stateUpdate") if e["running_policies"])
        assert running["left"]["instruction"] == "wave"
        assert bench.runtime.status["availability"] == "busy"


def test_plain_value_is_refused_as_a_world() -> None:
    with pytest.raises(ValidationError, match="robot must be an object"):
        SimulationDeviceDriver("scene.xml")


async def test_partial_world_joins_and_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "operator")
    driver = SimulationDeviceDriver(object())
    assert {function.name for function in driver.functions}.isdisjoint({"execute", "step", "reset", "getFeatures"})
    async with DriverBench(driver) as bench:
        assert (await bench.call("stop"))["not_stopped"] == ["simulation"]
        assert "exposes no get_state" in (await bench.call("getStatus"))["reason"]
        assert (await bench.call("step"))["status"] == "error"
