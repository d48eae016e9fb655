"""Two terminals without configuration, and certificates made by command."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from fixtures.command_line import COMMAND, Machine, on_a_terminal
from fixtures.waiting import eventually
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.mesh.resume_authority import keygen
from strands_robots.safety.identity import EnrolledKeys, robot_identity
from strands_robots.safety.persistence import LockoutStore


@pytest.fixture
def machine(tmp_path: Path, port: int) -> Machine:
    (tmp_path / "state").mkdir(mode=0o700)
    return Machine(tmp_path / "state", STRANDS_MESH_PORT=str(port))


def lockouts(store: LockoutStore) -> dict[str, bool]:
    """Whether each robot by name is stored as locked."""
    return {each.name: each.state.locked for each in store.load_all().values()}


def test_served_arm_is_listed_from_another_terminal_and_stopped_by_ctrl_c(machine: Machine) -> None:
    with machine.serving("arm-1", "--mesh") as (serving, _):
        code, seen = machine.json("peers", "--mesh", "--timeout", "5")
        [row] = seen["peers"]
        assert (code, row["peer_id"], row["type"], row["sim_robots"]) == (0, "arm-1", "sim", ["so100"])
        serving.send_signal(signal.SIGINT)
        rest = serving.communicate(timeout=60)[0]
        assert json.loads(rest.splitlines()[0])["stopped"] is True


def test_served_arm_is_stopped_locked_and_cleared_from_another_terminal(tmp_path: Path, machine: Machine) -> None:
    with machine.serving("arm-1", "--mesh"):
        assert machine.json("stop", "arm-1", "--mesh")[1]["stopped"] is True
        code, answer = machine.json("estop", "--mesh")
        assert (code, answer["stopped"], list(answer["robots"])) == (0, True, ["arm-1"])
        # It is locked at once and stored a moment later, because no disk may delay a halt.
        store = LockoutStore(tmp_path / "state")
        eventually(lambda: lockouts(store) == {"arm-1": True})
        assert machine.json("resume", "--local", "arm-1")[0] == 0
        assert lockouts(store) == {"arm-1": False}


def test_enrolled_arm_of_the_mesh_stops_green_by_its_own_key_alone(tmp_path: Path, machine: Machine) -> None:
    with machine.serving("arm-1", "--mesh"):
        code, answer = machine.json("enroll", "--mesh")
        assert (code, answer["devices"]["arm-1"]["outcome"]) == (0, "enrolled")
        assert machine.json("estop", "--mesh")[0] == 0
        other = robot_identity("arm-2")
        assert other is not None
        EnrolledKeys(tmp_path / "state").enroll({"arm-1": other.public}, replace=True)
        code, answer = machine.json("estop", "--mesh")
        assert (code, answer["not_stopped"]) == (1, ["arm-1"])
        assert "ALARM" in answer["robots"]["arm-1"]
        assert machine.json("enroll", "--mesh")[0] == 1


def test_served_arm_is_called_by_any_action_of_the_mesh(machine: Machine) -> None:
    with machine.serving("arm-1", "--mesh"):
        code, answer = machine.json("call", "--mesh", "arm-1", "status")
        assert (code, answer["status"]) == (0, "success")


def test_arm_of_the_mesh_is_started_stopped_and_run_to_the_end_by_call(machine: Machine) -> None:
    policy = ("instruction=wave", "policy_provider=mock")
    with machine.serving("arm-1", "--mesh"):
        code, answer = machine.json("call", "--mesh", "arm-1", "start", *policy, "duration=60")
        assert (code, answer["status"]) == (0, "success")
        assert machine.json("call", "--mesh", "arm-1", "status")[1]["task_status"] == "running"
        assert machine.json("stop", "arm-1", "--mesh")[1]["stopped"] is True
        code, answer = machine.json("call", "--mesh", "arm-1", "execute", *policy, "duration=0.5", "--timeout", "60")
        assert (code, answer["status"]) == (0, "success")
        assert machine.json("call", "--mesh", "arm-1", "status")[1]["task_status"] != "running"


def test_unanswered_stop_is_no_success(machine: Machine) -> None:
    code, answer = machine.json("estop", "--mesh")
    assert (code, answer["stopped"]) == (3, None)


@pytest.mark.parametrize("command", [["serve", "so100"], ["peers"], ["stop", "--all"], ["estop"]])
def test_network_flag_that_the_mesh_does_not_take_is_refused(command: list[str]) -> None:
    ended = CliRunner().invoke(build(), [*command, "--mesh", "--nats", "nats://127.0.0.1:4222"])
    assert ended.exit_code == 2
    assert "--mesh takes no network flag but --fleet and --port" in ended.output


def test_keys_are_made_issued_and_named_for_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str]:
        ended = CliRunner().invoke(build(), ["mesh", "keys", *arguments])
        return ended.exit_code, ended.stdout

    assert run("init")[0] == 0
    assert run("init")[0] == 1
    code, said = run("issue", "arm-1", "10.0.0.5", "--json")
    assert code == 0
    named = json.loads(said)
    assert Path(named["STRANDS_MESH_TLS_KEY"]).stat().st_mode & 0o777 == 0o600
    assert run("acl", "--robot", "arm-1", "--operator", "console")[0] == 0
    assert json.loads(Path("mesh-acl.json5").read_text())["default_permission"] == "deny"
    assert run("acl")[0] == 1


def test_lockout_set_by_a_console_that_is_gone_is_listed_and_resumed_from_another_terminal(
    tmp_path: Path, machine: Machine
) -> None:
    key, secret = tmp_path / "operator.pem", tmp_path / "passphrase"
    secret.write_text("Correct-Horse-7-Battery\n")
    public = keygen(key, "Correct-Horse-7-Battery")
    machine.environment["STRANDS_MESH_RESUME_PUBLIC_KEY"] = public
    signed = ("resume", "--mesh", "--key", str(key), "--passphrase-file", str(secret))
    with machine.serving("arm-1", "--mesh"):
        epoch = machine.json("estop", "--mesh")[1]["estop_id"]
        listed = machine.json("lockout", "--mesh")[1]["live"]["arm-1"]
        assert (listed["locked"], epoch in [each["epoch"] for each in listed["holds"]]) == (True, True)
        code, answer = machine.json(*signed)
        assert (code, answer["devices"]) == (0, {"arm-1": {"free": True, "said": "free to move when told to"}})
        assert machine.json("lockout", "--mesh")[1]["live"] == {"arm-1": {"locked": False, "holds": []}}


def test_resume_of_a_silent_peer_of_the_mesh_is_no_success(tmp_path: Path, machine: Machine) -> None:
    key, secret = tmp_path / "operator.pem", tmp_path / "passphrase"
    secret.write_text("Correct-Horse-7-Battery\n")
    keygen(key, "Correct-Horse-7-Battery")
    signed = ("resume", "--mesh", "--key", str(key), "--passphrase-file", str(secret))
    assert machine.json(*signed)[0] == 3
    with machine.serving("arm-1", "--mesh"):
        code, answer = machine.json(*signed, "--targets", "arm-9", "--timeout", "0.5")
        assert (code, answer["devices"]["arm-9"]["free"]) == (1, False)


def test_space_bar_stops_the_mesh_and_its_check_in_keeps_a_robot_free(machine: Machine) -> None:
    line = [*COMMAND, "safety-controller", "--mesh", "--id", "desk-1", "--check-in", "0.2"]
    with on_a_terminal(line, machine.environment) as terminal:
        # It is never the hub: until a robot is there no mesh answers.
        eventually(lambda: "the stop link is DOWN; checks in every 0.2 s" in terminal.drawn, within=60)
        eventually(lambda: "mesh: no mesh answers on tcp/127.0.0.1" in terminal.drawn, within=60)
        with machine.serving("arm-1", "--mesh", STRANDS_CHECKIN_TIMEOUT_S="30"):
            eventually(lambda: "the stop link is up; checks in every 0.2 s" in terminal.drawn, within=60)
            eventually(lambda: "s left" in terminal.drawn, within=60)
            assert "LOCKED" not in terminal.drawn
            terminal.press(" ")
            eventually(lambda: "1 stopped, in" in terminal.drawn and "LOCKED" in terminal.drawn, within=60)
            terminal.press("q")
            assert terminal.process.wait(60) == 0
    assert "Traceback" not in terminal.drawn
