"""``strands-robots serve`` as a process on a free loopback port, and the other commands as processes beside it."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.command_line import WITHIN_S, Machine
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    made = Machine(tmp_path_factory.mktemp("state"))
    # Here each command makes its own imports, as it does for a user.
    made.forked = False
    return made


@pytest.fixture(scope="module")
def arm(machine: Machine) -> Iterator[dict[str, Any]]:
    """A served arm; the event with which it was ready."""
    with machine.serving("arm-1") as (_, ready):
        yield ready


def running(machine: Machine) -> Any:
    return machine.json("call", "arm-1", "getStatus")[1]["running_policies"]


def test_serve_prints_its_id_and_functions(arm: dict[str, Any]) -> None:
    assert arm["peer_id"] == "arm-1"
    assert "127.0.0.1" in arm["network"]
    assert {"execute", "stop", "getStatus"} <= set(arm["functions"])


def test_panel_of_a_robot_on_this_machine_comes_without_a_warning(machine: Machine) -> None:
    served = machine.start("serve", "so100", "--peer-id", "quiet-1")
    assert served.stdout is not None and served.stderr is not None
    shown = [served.stdout.readline()]
    while shown[-1] and "Ctrl-C stops the robot" not in shown[-1]:
        shown.append(served.stdout.readline())
    served.terminate()
    _, warned = served.communicate(timeout=WITHIN_S)
    assert "Every program of this machine can drive" in "".join(shown)
    assert warned == ""


@pytest.mark.parametrize("network", [(), ("--mesh",)], ids=["device-connect", "mesh"])
def test_start_with_settings_of_the_older_package_names_each_once(machine: Machine, network: tuple[str, ...]) -> None:
    older = {"STRANDS_MESH_OVERRIDE_CODE": "1234", "DASHBOARD_AUTH_TOKEN": "t", "DEVICE_CONNECT_RPC_ALLOW": "agent-*"}
    older["STRANDS_MESH_LOCAL_DEV"] = "1"
    served = machine.start("serve", "so100", "--peer-id", "older-1", "--json", *network, **older)
    assert served.stdout is not None
    assert json.loads(served.stdout.readline())["event"] == "serving"
    served.terminate()
    _, warned = served.communicate(timeout=WITHIN_S)
    for said in (
        "STRANDS_MESH_OVERRIDE_CODE is set and not read here. No shared code ends a lockout;",
        "DASHBOARD_AUTH_TOKEN is set and not read here. The page is on 127.0.0.1 alone;",
        "DEVICE_CONNECT_RPC_ALLOW is set and DEVICE_CONNECT_ESTOP_ALLOW is not: every named source may stop",
    ):
        assert warned.count(said) == 1, warned
    assert "1234" not in warned


def test_foreign_model_is_served_with_its_tip_named(machine: Machine, tmp_path: Path) -> None:
    model = tmp_path / "crane.xml"
    model.write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body><joint name='pan' axis='0 0 1' range='-2 2' damping='1'/>"
        "<geom type='capsule' fromto='0 0 0 .2 0 0' size='.02'/><site name='nozzle' pos='.23 0 0'/></body></worldbody>"
        "<actuator><position joint='pan' kp='50' ctrlrange='-2 2'/></actuator></mujoco>"
    )
    refused = machine.run("serve", str(model), "--set", "tip=hook")
    assert refused.returncode == 2 and "tip must be a site or a body of the model (nozzle" in refused.stderr
    served = machine.start("serve", str(model), "--peer-id", "crane-1", "--set", "tip=nozzle", "--json")
    try:
        assert served.stdout is not None and json.loads(served.stdout.readline())["event"] == "serving"
        assert machine.json("call", "crane-1", "getPose")[1]["x"] == pytest.approx(0.23, abs=0.005)
    finally:
        served.terminate()
        served.communicate(timeout=WITHIN_S)


def test_peers_lists_the_arm_and_its_functions(machine: Machine, arm: dict[str, Any]) -> None:
    code, said = machine.json("peers", "--timeout", "20")
    assert code == 0
    assert [peer["id"] for peer in said["peers"]] == ["arm-1"]
    output = machine.run("peers", "arm-1", "--timeout", "20")
    assert "instruction" in output.stdout
    assert machine.json("peers", "arm-2")[0] == 3


def test_motion_is_called_watched_and_stopped(machine: Machine, arm: dict[str, Any]) -> None:
    code, said = machine.json("call", "arm-1", "execute", "instruction=wave hello", "duration=600")
    assert (code, said["status"]) == (0, "success")
    assert eventually(lambda: running(machine))
    watched = machine.run("watch", "arm-1", "--for", "4")
    assert watched.returncode == 0
    assert "wave hello" in watched.stdout
    code, said = machine.json("stop", "arm-1")
    assert (code, said["devices"]["arm-1"]["stopped"]) == (0, True)
    assert not running(machine)
    assert machine.json("stop", "--all")[0] == 0


def test_refusals_and_silence_have_their_own_exit_codes(machine: Machine, arm: dict[str, Any]) -> None:
    assert machine.json("call", "arm-1", "execute", "instruction=wave", "duration=-1")[0] == 2
    assert machine.json("call", "arm-1", "execute", "instruction=wave", "speed=9")[0] == 2
    assert machine.json("call", "arm-1", "execute", "instruction=wave", "duration=long")[0] == 2
    assert machine.json("call", "arm-1", "fly")[0] == 1
    assert machine.json("call", "arm-9", "getStatus")[0] == 3
    assert machine.json("stop", "arm-9")[0] == 3
    assert machine.json("peers", "--tenant", "elsewhere", "--timeout", "0.6")[0] == 3


def test_second_robot_of_the_same_id_is_refused(machine: Machine, arm: dict[str, Any]) -> None:
    code, said = machine.json("serve", "so100", "--peer-id", "arm-1")
    assert code == 1
    assert "arm-1" in said["reason"]


def test_watch_prints_the_present_state_then_events_as_one_json_value_a_line(
    machine: Machine, arm: dict[str, Any]
) -> None:
    assert machine.run("call", "arm-1", "execute", "instruction=wave", "duration=60").returncode == 0
    result = machine.run("watch", "arm-1", "--for", "4", "--json")
    assert machine.run("stop", "arm-1").returncode == 0
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0
    assert lines[0]["event"] in {"getState", "getStatus"}
    assert "observationUpdate" in {line["event"] for line in lines}


def test_watched_robot_that_is_killed_is_silent_and_exit_3(machine: Machine) -> None:
    with machine.serving("arm-9") as (served, _):
        watching = machine.start("watch", "arm-9", "--json")
        assert watching.stdout is not None
        assert json.loads(watching.stdout.readline())["device"] == "arm-9"
        served.kill()
        said, _ = watching.communicate(timeout=WITHIN_S)
    assert watching.returncode == 3
    assert "arm-9 is silent" in json.loads(said.splitlines()[-1])["reason"]


def test_ctrl_c_ends_watch_with_130(machine: Machine, arm: dict[str, Any]) -> None:
    watching = machine.start("watch", "arm-1", "--json")
    assert watching.stdout is not None
    assert json.loads(watching.stdout.readline())["device"] == "arm-1"
    watching.send_signal(signal.SIGINT)
    _, complaints = watching.communicate(timeout=WITHIN_S)
    assert watching.returncode == 130
    assert "Traceback" not in complaints


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)], ids=["Ctrl-C", "SIGTERM"])
def test_signal_stops_the_robot_before_it_departs(machine: Machine, number: signal.Signals, code: int) -> None:
    with machine.serving("arm-2") as (served, _):
        assert machine.json("call", "arm-2", "execute", "instruction=wave", "duration=600")[0] == 0
        served.send_signal(number)
        rest, _ = served.communicate(timeout=WITHIN_S)
    events = [json.loads(line) for line in rest.splitlines()]
    assert [event["event"] for event in events] == ["stopped", "departed"]
    assert events[0]["stopped"] is True
    assert served.returncode == code
    assert machine.json("peers", "arm-2", "--timeout", "0.6")[0] == 3


def test_serve_ends_when_its_stdin_closes(machine: Machine) -> None:
    with machine.serving("arm-3", "--until-stdin-closes") as (served, _):
        assert served.stdin is not None
        served.stdin.close()
        served.stdin = None
        assert served.wait(WITHIN_S) == 0


def test_caller_not_on_the_allowlist_cannot_move_the_robot(machine: Machine) -> None:
    with machine.serving("arm-4", "--rpc-allow", "trusted-*"):
        wave = ("call", "arm-4", "execute", "instruction=wave", "duration=1")
        code, said = machine.json(*wave)
        assert code == 1
        assert "DEVICE_CONNECT_RPC_ALLOW" in said["reason"]
        assert machine.json("stop", "arm-4")[0] == 0
        assert machine.json(*wave, "--as", "trusted-1")[0] == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("serve", "no-such-robot"),
        ("serve", "so100", "--peer-id", "a.b"),
        ("serve", "so100", "--listen", "tcp/0.0.0.0:0"),
        ("serve",),
        ("call",),
        ("fly",),
    ],
)
def test_wrong_usage_is_exit_2_without_a_traceback(machine: Machine, arguments: tuple[str, ...]) -> None:
    result = machine.run(*arguments)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_absent_broker_is_exit_3_without_a_traceback(machine: Machine) -> None:
    result = machine.run("peers", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert result.returncode == 3
    assert "Traceback" not in result.stderr


def test_doctor_renders_in_a_process_of_its_own(machine: Machine) -> None:
    code, said = machine.json("doctor")
    found = {each["name"]: each for each in said["checks"]}
    assert code == 0
    assert found["rendering"]["mark"] == "ok" or found["rendering"]["remedy"]


def test_arm_is_served_and_stopped_over_a_broker(machine: Machine) -> None:
    with NatsServer() as server:
        network = ("--nats", server.url)
        with machine.serving("arm-5", *network):
            assert [peer["id"] for peer in machine.json("peers", "--timeout", "20", *network)[1]["peers"]] == ["arm-5"]
            assert machine.json("call", "arm-5", "execute", "instruction=wave", *network)[0] == 0
            assert machine.json("stop", "--all", *network)[0] == 0


def test_certificates_admit_an_operator_and_refuse_a_stranger(machine: Machine, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    arm, operator = authority.issue("arm"), authority.issue("operator")
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with machine.serving("arm-6", "--listen", endpoint, *tls(arm)) as (_, ready):
        assert "both sides are authenticated" in ready.get("network", ""), ready
        assert machine.json("stop", "arm-6", "--connect", endpoint, *tls(operator))[0] == 0
        stranger = Authority(tmp_path, "stranger").issue("stranger")
        assert machine.json("peers", "--connect", endpoint, *tls(stranger))[0] == 3


def tls(who: Identity) -> tuple[str, ...]:
    return ("--tls-ca", str(who.ca), "--tls-cert", str(who.cert), "--tls-key", str(who.key))
