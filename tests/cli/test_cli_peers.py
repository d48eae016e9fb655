from __future__ import annotations

import json
import re
import time
from dataclasses import replace

import pytest
from tests.cli.conftest import FakeFleet, Run

from strands_robots.device_connect.client import CallRefusedError, DeviceTimeoutError, NoSuchDeviceError
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, error


def arm(name: str = "arm-1") -> Peer:
    execute = {
        "name": "execute",
        "description": "Start a policy.\nAnd more.",
        "parameters": {"properties": {"instruction": {"type": "string"}}},
    }
    return Peer(name, "strands_sim", "so100", {"availability": "idle"}, (execute, {"name": "stop"}), ("stateUpdate",))


def test_peers_are_listed_as_table_and_as_json(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [arm()]
    assert "arm-1" in run("peers").stdout
    assert json.loads(run("peers", "--json").stdout)["peers"][0]["id"] == "arm-1"
    output = run("peers", "arm-1").stdout
    assert "instruction: string" in output
    assert "Start a policy." in output
    assert "And more" not in output


def test_peers_show_the_age_of_the_last_sign_of_life(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [replace(arm(), heard_at=time.monotonic() - 3600.0), arm("arm-2")]
    late, listed = (line for line in run("peers").stdout.splitlines() if "arm-" in line)
    assert re.search(r" 36\d\d\.\d s ", late) and "only listed" in listed
    ages = [peer["age_s"] for peer in json.loads(run("peers", "--json").stdout)["peers"]]
    assert 3600.0 <= ages[0] < 3700.0 and ages[1] is None


def test_peer_text_cannot_control_the_terminal(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [Peer("arm-1", "[bold]\x1b]0;owned\x07", "\u202emodel", {"availability": "[red]x"})]
    output = run("peers").stdout
    assert "\x1b" not in output and "\x07" not in output and "\u202e" not in output
    assert "[bold]" in output


@pytest.mark.parametrize("arguments", [("peers",), ("peers", "arm-2"), ("stop", "--all")])
def test_no_answer_is_exit_3(run: Run, fleet: FakeFleet, arguments: tuple[str, ...]) -> None:
    assert run(*arguments).exit_code == 3
    assert json.loads(run(*arguments, "--json").stdout)["exit"] == 3


def test_call_sends_typed_values(run: Run, fleet: FakeFleet) -> None:
    result = run("call", "arm-1", "execute", "instruction=wave", "duration=2", "--timeout", "4")
    assert result.exit_code == 0
    assert fleet.called == [("arm-1", "execute", {"instruction": "wave", "duration": 2}, 4.0)]


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (error("not allowed"), 1),
        (CallRefusedError("Unknown method: x", -32601), 1),
        (NoSuchDeviceError("No device 'arm-1' in tenant 'default'."), 3),
        (DeviceTimeoutError("arm-1 is announced and did not answer within 4 s."), 3),
    ],
)
def test_failed_call_prints_the_reason_and_its_exit_code(
    run: Run, fleet: FakeFleet, answer: Envelope | Exception, code: int
) -> None:
    fleet.answer = answer
    result = run("call", "arm-1", "execute", "--json")
    assert result.exit_code == code
    said = json.loads(result.stdout)
    assert said["status"] == "error"
    assert said["reason"]
    assert run("call", "arm-1", "execute").stdout == ""


@pytest.mark.parametrize(
    "arguments", [("a=1", "a=2"), ("nothing",), ("x=NaN",), ("--timeout", "0"), ("--timeout", "nan")]
)
def test_malformed_call_is_exit_2_and_sends_nothing(run: Run, fleet: FakeFleet, arguments: tuple[str, ...]) -> None:
    assert run("call", "arm-1", "execute", *arguments).exit_code == 2
    assert fleet.called == []


def test_unknown_device_and_function_name_the_near_ones(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [arm(), arm("arm-2"), arm("rover")]
    fleet.answer = NoSuchDeviceError("No device 'amr-1' in tenant 'default'.")
    assert "Near it: arm-1, arm-2." in run("call", "amr-1", "execute").stderr
    fleet.answer = CallRefusedError("Unknown method: exceute", -32601)
    assert "exceute. Near it: execute." in run("call", "arm-1", "exceute").stderr
    fleet.answer = CallRefusedError("Unknown method: zzz", -32601)
    assert "There are: execute, stop." in run("call", "arm-1", "zzz").stderr


def test_piped_table_is_not_broken_at_80_columns(run: Run, fleet: FakeFleet) -> None:
    names = tuple({"name": f"functionNumber{n}"} for n in range(20))
    fleet.found = [Peer("arm-1", "strands_sim", "so100", {"availability": "idle"}, names)]
    [row] = [line for line in run("peers").stdout.splitlines() if "arm-1" in line]
    assert "functionNumber0" in row and "functionNumber19" in row
