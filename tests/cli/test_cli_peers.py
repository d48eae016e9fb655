from __future__ import annotations

import io
import json
import re
import time
from base64 import b64encode
from dataclasses import replace

import pytest
from rich.console import Console
from tests.cli.conftest import FakeFleet, Run, connect

from strands_robots.cli.network import Network
from strands_robots.cli.output import Screen
from strands_robots.cli.peers import peers
from strands_robots.device_connect.client import CallRefusedError, DeviceTimeoutError, NoSuchDeviceError
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, error, success


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
        (error("seconds is missing", refused="arguments"), 2),
        (CallRefusedError("Invalid params", -32602), 2),
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


def test_a_robot_of_many_functions_takes_one_line_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    names = tuple({"name": f"functionNumber{n}"} for n in range(40))
    found = [Peer(f"so101-arm-{n}", "strands_sim", "so101", {"availability": "idle"}, names) for n in range(5)]
    drawn = on_80_columns(monkeypatch, found)
    assert all(len(line) <= 80 for line in drawn)
    assert sum("strands_sim" in line for line in drawn) == 5
    assert len([line for line in drawn if line.strip()]) == 2 + 5 + 1


def test_long_names_are_whole_on_two_lines_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    long = Peer("reachy-mini-kitchen-ab12cd34", "strands_reachy_mini", "reachy_mini", {"availability": "unavailable"})
    drawn = on_80_columns(monkeypatch, [long])
    body = drawn[next(n for n, line in enumerate(drawn) if "───" in line) + 1 :]
    assert len([line for line in body if line.strip() and "DEVICE" not in line]) == 2
    assert "".join(line.split(" ")[1] for line in body[:2]) == long.id


def on_80_columns(monkeypatch: pytest.MonkeyPatch, found: list[Peer]) -> list[str]:
    """Return the lines of ``peers`` on a terminal of 80 columns."""
    fake, drawn = FakeFleet(), io.StringIO()
    fake.found = found
    connect(monkeypatch, fake)
    peers(Screen(console=Console(file=drawn, width=80, force_terminal=True, color_system=None)), Network())
    return drawn.getvalue().splitlines()


def test_signatures_and_encoded_bytes_are_for_programs_alone(run: Run, fleet: FakeFleet) -> None:
    signature, picture = f"{b64encode(bytes(range(64))).decode()}", b64encode(bytes(range(256)) * 40).decode()
    fleet.answer = success(
        f"Locked; signed {signature}.",
        statement={"key": "k", "sig": signature},
        shots=[{"jpeg": picture, "camera": "front", "proof": {"sig": signature}}],
        path="a/long/path/of_a_file_whose_name_is_no_signature_though_it_is_long",
    )
    said = run("call", "arm-1", "getStatus").stdout
    assert (
        signature not in said
        and picture[:60] not in said
        and "sig" not in said.replace("signed", "").replace("signature", "")
    )
    assert f"<{len(picture)} characters, shown by --json>" in said
    assert "of_a_file_whose_name_is_no_signature_though_it_is_long" in said
    assert json.loads(run("call", "arm-1", "getStatus", "--json").stdout) == fleet.answer


BREW = {
    "name": "brewCoffee",
    "description": "Brew coffee.",
    "parameters": {
        "properties": {
            "cups": {"type": "integer", "minimum": 1, "maximum": 8, "unit": "cups"},
            "label": {"type": "string"},
            "strength": {"enum": ["mild", "strong"]},
            "recipe": {"type": "object"},
            "lease_id": {"type": "string"},
        },
        "required": ["cups"],
    },
    "labels": {"direction": "write", "own": "true", "lasts_s": "90"},
}


def barista() -> Peer:
    return Peer(
        "bar-1",
        "strands_robot",
        functions=(BREW, {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}}),
    )


def test_call_sends_what_the_description_says_and_waits_as_long_as_the_verb_lasts(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [barista()]
    given = ("cups=5", "label=5", "strength=mild", 'recipe={"milk": 1}', "lease_id=12")
    assert run("call", "bar-1", "brewCoffee", *given).exit_code == 0
    sent = {"cups": 5, "label": "5", "strength": "mild", "recipe": {"milk": 1}, "lease_id": "12"}
    assert fleet.called == [("bar-1", "brewCoffee", sent, 100.0)]


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("cups=nine", "cups must be an integer from 1 to 8, not 'nine'."),
        ("cups=9", "cups must be an integer from 1 to 8, not 9."),
        ("strength=weak", "mild, strong"),
        ("recipe=[1]", "recipe must be an object as JSON"),
        ("sugar=1", "its arguments: cups, label, strength, recipe"),
    ],
)
def test_argument_that_does_not_fit_the_description_is_exit_2(
    run: Run, fleet: FakeFleet, argument: str, said: str
) -> None:
    fleet.found = [barista()]
    result = run("call", "bar-1", "brewCoffee", argument)
    assert result.exit_code == 2
    assert said in result.stderr
    assert fleet.called == []


@pytest.mark.parametrize(
    ("function", "given", "sent", "seconds"),
    [
        ("getStatus", (), {}, 10.0),
        ("listCameras", (), {}, 10.0),
        ("stop", (), {}, 10.0),
        ("stopMotion", (), {}, 10.0),
        ("moveTo", ("x=0.2", "wait=true", "lease_id=12"), {"x": 0.2, "wait": True, "lease_id": "12"}, 35.0),
        ("moveJoints", ('joints={"pan": 1}', "wait=false"), {"joints": {"pan": 1}, "wait": False}, 35.0),
        ("execute", ("instruction=wave", 'robot_name="5"'), {"instruction": "wave", "robot_name": "5"}, 10.0),
    ],
)
def test_plain_call_of_a_known_verb_asks_for_no_description(
    run: Run,
    fleet: FakeFleet,
    function: str,
    given: tuple[str, ...],
    sent: dict[str, object],
    seconds: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(FakeFleet, "describe")
    assert run("call", "arm-1", function, *given).exit_code == 0
    assert fleet.called == [("arm-1", function, sent, seconds)]


def test_number_for_a_text_of_a_known_verb_is_sent_as_it_was_typed(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [arm()]
    assert run("call", "arm-1", "execute", "instruction=1.50").exit_code == 0
    assert fleet.called[0][2] == {"instruction": "1.50"}


@pytest.mark.parametrize("name", ["getCoffee", "listAll", "stopwatch"])
def test_own_verb_is_waited_for_whatever_its_name_begins_with(run: Run, fleet: FakeFleet, name: str) -> None:
    fleet.found = [Peer("bar-1", functions=({**BREW, "name": name, "parameters": {}},))]
    assert run("call", "bar-1", name).exit_code == 0
    assert fleet.called == [("bar-1", name, {}, 100.0)]


@pytest.mark.parametrize("function", ["brewCoffee", "moveTo", "wait"])
def test_ctrl_c_of_a_motion_says_that_it_goes_on_and_how_to_stop_it(run: Run, fleet: FakeFleet, function: str) -> None:
    fleet.found, fleet.answer = [barista()], KeyboardInterrupt()
    result = run("call", "bar-1", function, "--tenant", "lab")
    assert result.exit_code == 130
    assert "The robot may still move. Stop it: strands-robots stop bar-1 --tenant lab" in result.stderr
    said = json.loads(run("call", "bar-1", function, "--json").stdout)
    assert (said["exit"], said["stop"]) == (130, "strands-robots stop bar-1")


def test_ctrl_c_of_a_read_says_nothing(run: Run, fleet: FakeFleet) -> None:
    read = {"name": "beansLeft", "labels": {"direction": "read", "own": "true"}}
    fleet.found, fleet.answer = [Peer("bar-1", functions=(read,))], KeyboardInterrupt()
    for function in ("getStatus", "beansLeft"):
        result = run("call", "bar-1", function)
        assert (result.exit_code, result.output) == (130, "")


def test_call_without_a_function_lists_them_with_their_domains(run: Run, fleet: FakeFleet) -> None:
    fleet.found = [barista(), Peer("echo-1", functions=({"name": "echo"}, {"name": "\x1b[2J", "parameters": 5}))]
    said = run("call", "bar-1").stdout
    assert "brewCoffee (its own)" in said
    assert "cups: integer, 1 to 8 cups; [label: string]; [strength: mild | strong]" in said
    assert "lease_id" not in said
    bare = run("peers", "echo-1").stdout
    assert "This device has no lockout, no lease and no stop." in bare
    assert "\x1b" not in bare


def test_call_that_was_sent_and_got_no_answer_says_that_it_may_still_be_carried_out(run: Run, fleet: FakeFleet) -> None:
    fleet.answer = DeviceTimeoutError("arm-1 got the call and gave no answer: it may have left the network.")
    result = run("call", "arm-1", "execute")
    assert result.exit_code == 3
    assert "It may still carry the call out." in result.stderr
