"""An arm that a local ``teleop`` leads is served as any other: found, locked, refused to others, and stopped."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND, Machine, on_a_terminal
from fixtures.led_arm import LedArm
from fixtures.waiting import eventually

pytestmark = pytest.mark.timeout(300)
MOVE = ("call", "arm-1", "execute", "instruction=wave", "duration=1")


@pytest.fixture
def arm(tmp_path: Path) -> LedArm:
    return LedArm(tmp_path, DEVICE_CONNECT_RPC_ALLOW="*", BYPASS_TOOL_CONSENT="true")


def event(process: Any, name: str) -> dict[str, Any]:
    """Return the next event of a command, which must be this one."""
    said: dict[str, Any] = json.loads(process.stdout.readline())
    assert said["event"] == name, said
    return said


def stands(arm: LedArm) -> None:
    """Nothing more is written: two readings, between which a moving arm takes dozens of actions."""
    before = arm.actions
    arm.machine.run("peers")
    assert arm.actions == before


def test_it_is_found_and_moves_for_its_leader_alone_until_it_is_stopped(arm: LedArm) -> None:
    with arm.led() as leading:
        eventually(lambda: re.search(r"arm-1 .* busy ", arm.machine.run("peers").stdout), within=60)
        twin = arm.start("teleop", "sweep", "led_arm", "--peer-id", "arm-1")
        assert "--no-network leads it without one" in twin.communicate(timeout=60)[1]
        assert twin.returncode == 1
        code, refused = arm.machine.json(*MOVE)
        assert code == 1
        assert "sweep (human) holds control" in refused["reason"]
        assert arm.machine.json("call", "arm-1", "getControl")[1]["holder"] == "sweep"

        code, said = arm.machine.json("stop", "arm-1")
        assert (code, said["devices"]["arm-1"]["stopped"]) == (0, True), said
        held = event(leading, "held")
        assert (held["stopped"], held["stopped_by"]) == (True, "stop by strands-robots.")
        stands(arm)
        # The arm is nobody's now, and stays where it can be stopped and moved.
        assert arm.machine.json(*MOVE)[0] == 0

        leading.send_signal(signal.SIGINT)
        assert event(leading, "ended")["state"] == "stopped"
        assert leading.wait(60) == 1


def test_emergency_stop_locks_it_by_name_and_the_next_lead_begins_where_it_stands(arm: LedArm) -> None:
    with arm.led() as leading:
        code, said = arm.machine.json("estop")
        assert (code, list(said["stopped"])) == (0, ["arm-1"]), said
        assert event(leading, "held")["stopped"] is True
        stands(arm)
        leading.terminate()
        assert leading.wait(60) == 1
    stood = arm.actions[-1]

    line = ("teleop", "sweep", "led_arm", "--peer-id", "arm-1", "--json")
    locked = arm.start(*line)
    try:
        held = event(locked, "held")
        assert "arm-1 is locked by the emergency stop of" in held["stopped_by"]
        assert "arm-1" in arm.machine.run("lockout").stdout
        assert arm.machine.run("resume", "--local", "arm-1").returncode == 0
        event(locked, "resumed")
        stands(arm)
    finally:
        locked.terminate()
        locked.communicate(timeout=60)
    before = len(arm.actions)
    with arm.led(LED_ARM_AT=str(stood)):
        first = arm.actions[before]
    # Two whole ranges of 180 a second, at most, in two periods of 20 ms.
    assert abs(first - stood) <= 2 * 180 * 0.04 + 1e-6


def test_it_is_stopped_over_the_mesh(arm: LedArm) -> None:
    with arm.led("--mesh") as leading:
        code, said = arm.machine.json("estop", "--mesh")
        assert code == 0, said
        assert event(leading, "held")["stopped"] is True
        stands(arm)


def test_it_is_on_both_networks_where_the_mesh_is_on(arm: LedArm) -> None:
    with arm.led(STRANDS_MESH="true") as leading:
        rows = json.loads(arm.machine.run("peers", "--json").stdout)
        assert "arm-1" in json.dumps(rows)
        assert arm.machine.json("stop", "arm-1", "--mesh")[0] == 0
        event(leading, "held")


def test_follower_of_a_leader_on_the_mesh_is_held_by_it_and_stopped_on_device_connect(arm: LedArm) -> None:
    publishing = arm.start("teleop", "sweep", "none", "--publish", "lead-1")
    try:
        eventually(lambda: "lead-1" in arm.machine.run("peers", "--mesh").stdout, within=60, what="the leader")
        with arm.led(leader="mesh:lead-1") as leading:
            code, refused = arm.machine.json(*MOVE)
            assert code == 1
            assert "lead-1 (human) holds control" in refused["reason"]
            assert arm.machine.json("estop")[0] == 0
            assert "arm-1 is locked by the emergency stop of" in event(leading, "held")["stopped_by"]
            stands(arm)
    finally:
        publishing.send_signal(signal.SIGINT)
        publishing.communicate(timeout=60)


def test_leader_that_hangs_ends_the_teleoperation(arm: LedArm) -> None:
    with arm.led(leader="stuck") as leading:
        arm.hang("stuck")
        ended = event(leading, "ended")
        assert (ended["state"], ended["stopped"]) == ("error", True)
        assert "leader has not answered for 0.5 s" in ended["error"]
        assert leading.wait(60) == 1
        stands(arm)


def test_arm_whose_read_hangs_is_reported_as_such_and_moves_no_more(arm: LedArm) -> None:
    with arm.led(STRANDS_HALT_DEADLINE_S="0.5") as leading:
        arm.hang("hangs")
        code, said = arm.machine.json("stop", "arm-1")
        assert (code, said["devices"]["arm-1"]["stopped"]) == (1, False), said
        assert event(leading, "held")["stopped"] is False
        before = len(arm.actions)
        arm.free()
        # The freeze that waited for the bus is all that still comes.
        eventually(lambda: arm.machine.json("stop", "arm-1")[0] == 0, within=60)
        assert len(set(arm.actions[before:])) <= 1


def test_without_a_network_it_is_found_by_nobody(arm: LedArm) -> None:
    process = arm.start("teleop", "sweep", "led_arm", "--no-network", "--json")
    try:
        arm.moves()
        assert json.loads(arm.machine.run("peers", "--json").stdout or "{}").get("peers") in (None, [])
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=60)
        ended = json.loads(out)
        assert (ended["state"], ended["stopped"], process.returncode) == ("stopped", True, 0)
    finally:
        process.kill()
        process.communicate()


def test_keyboard_at_a_paused_terminal_leads_no_more_after_a_stop(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")

    def pan() -> float:
        return float(machine.json("call", "arm-1", "getPose")[1]["joints"]["shoulder_pan"])

    line = [*COMMAND, "teleop", "keyboard", "so100", "--peer-id", "arm-1"]
    with on_a_terminal(line, machine.environment) as terminal:
        eventually(lambda: "q and a move" in terminal.drawn, within=60, what="the keys")
        terminal.press("q" * 5)
        eventually(lambda: pan() > 5.0, within=60, what="an arm that follows the keys")
        terminal.press("\x13")
        assert machine.json("stop", "arm-1")[0] == 0
        stood = pan()
        terminal.press("a" * 20)
        assert pan() == pytest.approx(stood, abs=0.5)
        terminal.press("\x11")
        eventually(lambda: "Stopped from the network: stop by strands-robots." in terminal.drawn, what="who stopped it")
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.process.wait(60) == 1
