"""Stops of a robot on Device Connect: answered beside everything else, and graded honestly."""

from __future__ import annotations

import asyncio
import logging
import threading
from pathlib import Path

import pytest
from fixtures.driver_bench import DriverBench, drive
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.device_connect import base_driver
from strands_robots.device_connect.command_records import EACH_PER_S, IN_ALL_PER_S
from strands_robots.mesh.resume_authority import keygen
from strands_robots.safety.ed25519 import load_signing_key
from strands_robots.safety.plane import plane
from strands_robots.safety.resume import sign
from strands_robots.serving.workers import RUNNING_MAX, WAITING_MAX


async def test_stop_ends_the_task_for_every_caller(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        for caller in ("operator", "stranger", None, {"no": "name"}):
            await bench.call("execute", instruction="wave")
            answer = await bench.call("stop", caller)
            assert answer["status"] == "success"
            assert answer["halted"] == ["toy"]
            assert answer["stopped"] is True


async def test_a_stop_that_did_not_happen_is_an_error_that_says_so(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave", duration=300)
        robot.stubborn = True
        answer = await bench.call("stop")
        assert answer["status"] == "error"
        assert answer["stopped"] is False
        assert "toy" in answer["not_stopped"]


async def test_stops_and_refused_motions_are_recorded_and_a_flood_of_them_is_counted(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        for _ in range(20):
            await bench.call("execute", "stranger", instruction="wave")
        await bench.call("stop", "stranger")
        await bench.call("getState", "stranger")
    found = [each for each in read_audit_log() if each["peer_id"] == "bench-1"]
    refused = [each["payload"] for each in found if each["event"] == "command_refused"]
    assert (len(refused), refused[0]["action"], refused[0]["about"]) == (EACH_PER_S, "execute", "stranger")
    assert "DEVICE_CONNECT_RPC_ALLOW" in refused[0]["reason"]
    stops = [each["payload"] for each in found if each["event"] == "command_executed"]
    assert stops == [{"about": "stranger", "action": "stop"}]


async def test_flood_of_motions_under_many_names_keeps_no_stop_out_of_the_records(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        for nth in range(2 * IN_ALL_PER_S):
            await bench.call("execute", f"stranger-{nth}", instruction="wave")
        await bench.call("stop", "operator")
    assert "command_executed" in [each["event"] for each in read_audit_log() if each["peer_id"] == "bench-1"]


async def test_nothing_to_stop_is_a_success(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        assert (await bench.call("stop"))["stopped"] is True


async def test_a_stop_is_answered_while_motion_and_reads_block(robot: ToyRobot) -> None:
    let_go = threading.Event()
    robot.before = {"start_task": let_go.wait, "get_state": let_go.wait}
    async with DriverBench(drive(robot)) as bench:
        each = RUNNING_MAX + WAITING_MAX + 3
        blocked = [asyncio.create_task(bench.call("execute", instruction="wave")) for _ in range(each)]
        blocked += [asyncio.create_task(bench.call("getState")) for _ in range(each)]
        # The watch of its state may hold one of the places for reads.
        beyond = len(blocked) - 2 * (RUNNING_MAX + WAITING_MAX)
        await bench.until(lambda: sum(task.done() for task in blocked) >= beyond)
        assert (await bench.call("stop"))["stopped"] is True
        let_go.set()
        answers = await asyncio.gather(*blocked)
    refused = [answer for answer in answers if "has not yet answered" in answer.get("reason", "")]
    assert len(refused) in (beyond, beyond + 1)


async def test_a_motion_that_is_not_started_in_time_is_void(robot: ToyRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base_driver, "START_S", 0.1)
    let_go = threading.Event()
    robot.before["start_task"] = let_go.wait
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", instruction="wave")
        assert "in time" in answer["reason"]
        let_go.set()
        await bench.until(lambda: len(robot.answers) == 1)
    assert "halted after it was asked for" in robot.answers[0]["reason"]
    assert robot.writes == []


async def test_a_motion_that_is_not_started_in_time_takes_nothing_else_with_it(
    robot: ToyRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(base_driver, "START_S", 0.1)
    let_go, moving = threading.Event(), robot.gate.permit("a local motion")
    robot.before["start_task"] = let_go.wait
    async with DriverBench(drive(robot)) as bench:
        assert "in time" in (await bench.call("execute", instruction="wave"))["reason"]
        assert moving.valid, "a permit that is revoked without a halt leaves a base with its last velocity"
        let_go.set()
        await bench.until(lambda: len(robot.answers) == 1)


async def test_a_stop_reaches_the_motion_that_has_not_begun_yet(robot: ToyRobot) -> None:
    let_go, entered = threading.Event(), threading.Event()

    def wait() -> None:
        entered.set()
        let_go.wait(60)

    robot.before["start_task"] = wait
    async with DriverBench(drive(robot)) as bench:
        asked = asyncio.create_task(bench.call("execute", instruction="wave"))
        await bench.until(entered.is_set)
        assert (await bench.call("stop"))["stopped"] is True
        let_go.set()
        answer = await asked
        assert answer["status"] == "error"
        assert "halted after it was asked for" in answer["reason"]
        assert robot.writes == []
        robot.before.clear()
        assert (await bench.call("execute", instruction="wave"))["status"] == "success"


async def test_a_halt_without_an_answer_is_reported_as_not_stopped(
    robot: ToyRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "1")
    let_go = threading.Event()
    robot.before["halt"] = let_go.wait
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("stop")
        assert answer["stopped"] is False
        assert "no answer in 1 s" in answer["reason"]
        let_go.set()


async def test_a_device_that_raises_an_emergency_stop_is_halted_before_the_network_is_told(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave", duration=300)
        permit = robot.gate.permit("execute")
        valid_when_told: list[bool] = []

        async def told(name: str, payload: dict[str, object]) -> None:
            if name == "emergencyStop":
                valid_when_told.append(permit.valid)

        halted = threading.Event()
        robot.before["halt"] = halted.set
        bench.driver.set_event_callback(told)
        await bench.driver.emergencyStop(reason="smoke")
        await bench.until(lambda: halted.is_set() and not robot.rollouts["toy"].running)
        assert len(valid_when_told) == 1


async def test_an_emergency_stop_of_an_allowed_source_halts(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot, DEVICE_CONNECT_ESTOP_ALLOW=("safety-*",))) as bench:
        await bench.call("execute", instruction="wave", duration=300)
        for source in ("stranger", "Safety-1", "", "bench-1"):
            await bench.driver.onEmergencyStop(source, "emergencyStop", {"reason": "test"})
        await asyncio.sleep(0.1)
        assert robot.rollouts["toy"].running, "the task lasts 300 s"
        await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {"reason": "test"})
        await bench.until(lambda: not robot.rollouts["toy"].running)


async def test_without_a_list_every_named_source_stops_whatever_the_rpc_list_says(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave")
        await bench.driver.onEmergencyStop("anybody", "emergencyStop", {})
        await bench.until(lambda: not robot.rollouts["toy"].running)


async def test_emergency_stop_locks_a_driver_that_no_plane_has(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave", duration=300)
        await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {"estop_id": "ab" * 16, "reason": "test"})
        await bench.until(lambda: not robot.rollouts["toy"].running)
        refused = await bench.call("execute", instruction="wave")
        assert (refused["status"], refused["locked"], refused["epochs"]) == ("error", True, ["ab" * 16])
        told = await bench.call("getStatus")
        assert (told["locked"], told["lockout"][0]["source"]) == (True, "safety-1")


async def test_lockout_without_a_plane_is_taken_over_by_the_first_one_and_resumed_there(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {"estop_id": "ab" * 16})
        entry = plane().register("bench-1", robot)
        try:
            assert entry.epochs == ("ab" * 16,)
            assert plane().clear_local("the test")
            assert robot.gate.refusal("execute") is None
        finally:
            entry.close()
        assert robot.gate.refusal("execute") is None
        await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {"estop_id": "cd" * 16})
        assert (await bench.call("execute", instruction="wave"))["epochs"] == ["cd" * 16], "the old one stays resumed"


async def test_resume_of_a_driver_that_no_plane_has_is_checked(
    robot: ToyRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(tmp_path / "operator.pem")
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(file, "Correct-Horse-7-Battery"))
    key = load_signing_key(file, "Correct-Horse-7-Battery")
    async with DriverBench(drive(robot)) as bench:
        await bench.driver.onEmergencyStop("safety-1", "emergencyStop", {"estop_id": "ab" * 16})
        (wrong,) = sign(key, "cd" * 16, ["bench-1"])
        assert (await bench.call("resume", assertion=wrong))["status"] == "error"
        assert robot.gate.refusal("execute") is not None
        (right,) = sign(key, "ab" * 16, ["bench-1"])
        assert (await bench.call("resume", assertion=right))["status"] == "success"
        assert robot.gate.refusal("execute") is None
    assert "bench-1" not in plane().robots


def test_a_robot_that_did_not_stop_is_named_at_critical(robot: ToyRobot, caplog: pytest.LogCaptureFixture) -> None:
    driver = drive(robot)
    robot.start_task("wave", duration=300)
    robot.stubborn = True
    with caplog.at_level(logging.CRITICAL):
        driver.stops.receive("safety-1", {"reason": "smoke"})
        eventually(lambda: "DID NOT STOP IT" in caplog.text)
    assert "toy" in caplog.text
    assert "safety-1" in caplog.text


@pytest.mark.parametrize("payload", [None, [], "x", {"reason": object()}])
def test_an_emergency_stop_counts_whatever_its_payload_is(robot: ToyRobot, payload: object) -> None:
    halting = drive(robot).stops.begin("safety-1", payload)
    assert halting is not None
    assert halting.result().stopped is True
