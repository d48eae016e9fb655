"""``strands-robots serve`` as a process on a free loopback port, and the other commands as processes beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots import settings

WITHIN_S = 100.0
pytestmark = pytest.mark.timeout(600)


class Shell:
    """Runs commands with the same settings: one loopback port, an own state folder, nothing of the user's."""

    def __init__(self, state: Path) -> None:
        ours = {setting.name for setting in settings.declared()}
        self.environment = {name: value for name, value in os.environ.items() if name not in ours}
        self.environment |= {"STRANDS_DC_PORT": str(free_port()), "STRANDS_STATE_DIR": str(state)}
        self.environment["STRANDS_HALT_DEADLINE_S"] = "20"

    def start(self, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "strands_robots.cli", *words],
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "strands_robots.cli", *words]
        return subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=WITHIN_S, check=False
        )

    def json(self, *words: str) -> tuple[int, dict[str, Any]]:
        """Exit code and the one JSON value that the command printed."""
        result = self.run(*words, "--json")
        return result.returncode, json.loads(result.stdout)


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    return Shell(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="module")
def arm(shell: Shell) -> Iterator[dict[str, Any]]:
    """A served arm; what it said when it was ready."""
    served = shell.start("serve", "so100", "--peer-id", "arm-1", "--json")
    try:
        assert served.stdout is not None
        yield json.loads(served.stdout.readline())
    finally:
        served.terminate()
        served.communicate(timeout=WITHIN_S)


def running(shell: Shell) -> Any:
    return shell.json("call", "arm-1", "getStatus")[1]["running_policies"]


def test_serve_says_who_it_is_and_what_it_can_do(arm: dict[str, Any]) -> None:
    assert arm["peer_id"] == "arm-1"
    assert "127.0.0.1" in arm["network"]
    assert {"execute", "stop", "getStatus"} <= set(arm["functions"])


def test_peers_lists_the_arm_and_what_it_can_do(shell: Shell, arm: dict[str, Any]) -> None:
    code, said = shell.json("peers", "--timeout", "20")
    assert code == 0
    assert [peer["id"] for peer in said["peers"]] == ["arm-1"]
    shown = shell.run("peers", "arm-1", "--timeout", "20")
    assert "instruction" in shown.stdout
    assert shell.json("peers", "arm-2")[0] == 3


def test_a_motion_is_called_watched_and_stopped(shell: Shell, arm: dict[str, Any]) -> None:
    code, said = shell.json("call", "arm-1", "execute", "instruction=wave hello", "duration=600")
    assert (code, said["status"]) == (0, "success")
    assert eventually(lambda: running(shell))
    watched = shell.run("watch", "arm-1", "--for", "4")
    assert watched.returncode == 0
    assert "wave hello" in watched.stdout
    code, said = shell.json("stop", "arm-1")
    assert (code, said["devices"]["arm-1"]["stopped"]) == (0, True)
    assert not running(shell)
    assert shell.json("stop", "--all")[0] == 0


def test_refusals_and_silence_have_their_own_exit_codes(shell: Shell, arm: dict[str, Any]) -> None:
    assert shell.json("call", "arm-1", "execute", "instruction=3")[0] == 1
    assert shell.json("call", "arm-1", "execute", "instruction=wave", "speed=9")[0] == 1
    assert shell.json("call", "arm-1", "fly")[0] == 1
    assert shell.json("call", "arm-9", "getStatus")[0] == 3
    assert shell.json("stop", "arm-9")[0] == 3
    assert shell.json("peers", "--tenant", "elsewhere", "--timeout", "0.6")[0] == 3


def test_a_second_robot_of_the_same_id_is_refused(shell: Shell, arm: dict[str, Any]) -> None:
    code, said = shell.json("serve", "so100", "--peer-id", "arm-1")
    assert code == 1
    assert "arm-1" in said["reason"]


def test_events_are_told_one_json_value_a_line(shell: Shell, arm: dict[str, Any]) -> None:
    result = shell.run("watch", "arm-1", "--for", "4", "--json")
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0
    assert {"observationUpdate"} <= {event["event"] for event in events}


def test_ctrl_c_ends_a_watch_with_130(shell: Shell, arm: dict[str, Any]) -> None:
    watching = shell.start("watch", "arm-1", "--json")
    assert watching.stdout is not None
    assert json.loads(watching.stdout.readline())["device"] == "arm-1"
    watching.send_signal(signal.SIGINT)
    _, complaints = watching.communicate(timeout=WITHIN_S)
    assert watching.returncode == 130
    assert "Traceback" not in complaints


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)], ids=["Ctrl-C", "SIGTERM"])
def test_a_signal_stops_the_robot_first_and_leaves_no_ghost(shell: Shell, number: signal.Signals, code: int) -> None:
    served = shell.start("serve", "so100", "--peer-id", "arm-2", "--json")
    try:
        assert served.stdout is not None
        assert json.loads(served.stdout.readline())["event"] == "serving"
        assert shell.json("call", "arm-2", "execute", "instruction=wave", "duration=600")[0] == 0
        served.send_signal(number)
        told, _ = served.communicate(timeout=WITHIN_S)
    finally:
        served.kill()
    events = [json.loads(line) for line in told.splitlines()]
    assert [event["event"] for event in events] == ["stopped", "departed"]
    assert events[0]["stopped"] is True
    assert served.returncode == code
    assert shell.json("peers", "arm-2", "--timeout", "0.6")[0] == 3


def test_a_served_robot_ends_with_the_process_that_holds_its_stdin(shell: Shell) -> None:
    served = shell.start("serve", "so100", "--peer-id", "arm-3", "--json", "--until-stdin-closes")
    try:
        assert served.stdout is not None and served.stdin is not None
        assert json.loads(served.stdout.readline())["event"] == "serving"
        served.stdin.close()
        served.stdin = None
        assert served.wait(WITHIN_S) == 0
    finally:
        served.kill()
        served.communicate()


def test_callers_that_are_not_on_the_list_do_not_move_the_robot(shell: Shell) -> None:
    served = shell.start("serve", "so100", "--peer-id", "arm-4", "--rpc-allow", "trusted-*", "--json")
    try:
        assert served.stdout is not None
        assert json.loads(served.stdout.readline())["event"] == "serving"
        wave = ("call", "arm-4", "execute", "instruction=wave", "duration=1")
        code, said = shell.json(*wave)
        assert code == 1
        assert "DEVICE_CONNECT_RPC_ALLOW" in said["reason"]
        assert shell.json("stop", "arm-4")[0] == 0
        assert shell.json(*wave, "--as", "trusted-1")[0] == 0
    finally:
        served.terminate()
        served.communicate(timeout=WITHIN_S)


@pytest.mark.parametrize(
    "words",
    [
        ("serve", "no-such-robot"),
        ("serve", "so100", "--peer-id", "a.b"),
        ("serve", "so100", "--listen", "tcp/0.0.0.0:0"),
        ("serve",),
        ("call", "arm-1"),
        ("fly",),
    ],
)
def test_wrong_usage_is_one_sentence_and_exit_2(shell: Shell, words: tuple[str, ...]) -> None:
    result = shell.run(*words)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_a_broker_that_is_not_there_is_exit_3_and_no_traceback(shell: Shell) -> None:
    result = shell.run("peers", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert result.returncode == 3
    assert "Traceback" not in result.stderr


def test_doctor_renders_in_a_process_of_its_own(shell: Shell) -> None:
    code, said = shell.json("doctor")
    found = {each["name"]: each for each in said["checks"]}
    assert code == 0
    assert found["rendering"]["mark"] == "ok" or found["rendering"]["remedy"]


def test_an_arm_is_served_and_stopped_over_a_broker(shell: Shell) -> None:
    with NatsServer() as server:
        there = ("--nats", server.url)
        served = shell.start("serve", "so100", "--peer-id", "arm-5", "--json", *there)
        try:
            assert served.stdout is not None
            assert json.loads(served.stdout.readline())["event"] == "serving"
            assert [peer["id"] for peer in shell.json("peers", "--timeout", "20", *there)[1]["peers"]] == ["arm-5"]
            assert shell.json("call", "arm-5", "execute", "instruction=wave", *there)[0] == 0
            assert shell.json("stop", "--all", *there)[0] == 0
        finally:
            served.terminate()
            served.communicate(timeout=WITHIN_S)


def test_certificates_are_the_way_out_of_this_machine(shell: Shell, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    arm, operator = authority.issue("arm"), authority.issue("operator")
    endpoint = f"tls/127.0.0.1:{free_port()}"
    served = shell.start("serve", "so100", "--peer-id", "arm-6", "--json", "--listen", endpoint, *tls(arm))
    try:
        assert served.stdout is not None
        ready = json.loads(served.stdout.readline())
        assert "both sides prove who they are" in ready.get("network", ""), ready
        assert shell.json("stop", "arm-6", "--connect", endpoint, *tls(operator))[0] == 0
        stranger = Authority(tmp_path, "stranger").issue("stranger")
        assert shell.json("peers", "--connect", endpoint, *tls(stranger))[0] == 3
    finally:
        served.terminate()
        served.communicate(timeout=WITHIN_S)


def tls(who: Identity) -> tuple[str, ...]:
    return ("--tls-ca", str(who.ca), "--tls-cert", str(who.cert), "--tls-key", str(who.key))
