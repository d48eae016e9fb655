"""Two terminals without configuration, and certificates made by command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND
from fixtures.waiting import eventually
from typer.testing import CliRunner

from strands_robots.cli.app import build


@contextmanager
def served(tmp_path: Path, port: int) -> Iterator[tuple[subprocess.Popen[str], dict[str, str]]]:
    """``arm-1`` on the mesh of this port, and the environment of a second terminal."""
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    settings = {**os.environ, "STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(state)}
    serving = subprocess.Popen(
        [*COMMAND, "serve", "so100", "--mesh", "--peer-id", "arm-1", "--json"],
        stdout=subprocess.PIPE,
        text=True,
        env=settings,
    )
    try:
        assert serving.stdout is not None
        assert json.loads(serving.stdout.readline())["peer_id"] == "arm-1"
        yield serving, settings
    finally:
        serving.kill()
        serving.wait()


def ask(settings: dict[str, str], *arguments: str) -> tuple[int, dict[str, Any]]:
    """The exit code and the answer of a command in the second terminal."""
    ended = subprocess.run(
        [*COMMAND, *arguments, "--json"], capture_output=True, text=True, env=settings, check=False, timeout=60
    )
    assert ended.stdout, ended.stderr
    return ended.returncode, json.loads(ended.stdout)


def lockouts(file: Path) -> dict[str, list[dict[str, Any]]]:
    """The lockouts of each robot by name, as stored in a lockout file."""
    return {each["name"]: each["holds"] for each in json.loads(file.read_text())["robots"].values()}


def test_a_served_arm_is_seen_from_another_terminal_and_ctrl_c_stops_it(tmp_path: Path, port: int) -> None:
    with served(tmp_path, port) as (serving, settings):
        code, seen = ask(settings, "peers", "--mesh", "--timeout", "5")
        [row] = seen["peers"]
        assert (code, row["peer_id"], row["type"], row["sim_robots"]) == (0, "arm-1", "sim", ["so100"])
        serving.send_signal(signal.SIGINT)
        rest = serving.communicate(timeout=60)[0]
        assert json.loads(rest.splitlines()[0])["stopped"] is True


def test_served_arm_is_stopped_locked_and_cleared_from_another_terminal(tmp_path: Path, port: int) -> None:
    with served(tmp_path, port) as (_, settings):
        assert ask(settings, "stop", "arm-1", "--mesh")[1]["stopped"] is True
        code, answer = ask(settings, "estop", "--mesh")
        assert (code, answer["stopped"], list(answer["robots"])) == (0, True, ["arm-1"])
        # It is locked at once and stored a moment later, because no disk may delay a halt.
        file = tmp_path / "state" / "lockouts.json"
        eventually(lambda: file.exists() and lockouts(file))
        assert list(lockouts(file)) == ["arm-1"]
        assert ask(settings, "resume", "--local", "arm-1")[0] == 0
        assert lockouts(file) == {"arm-1": []}


def test_unanswered_stop_is_no_success(tmp_path: Path, port: int) -> None:
    settings = {**os.environ, "STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(tmp_path)}
    code, answer = ask(settings, "estop", "--mesh")
    assert (code, answer["stopped"]) == (3, None)


@pytest.mark.parametrize("command", [["serve", "so100"], ["peers"], ["stop", "--all"], ["estop"]])
def test_network_flag_that_the_mesh_does_not_take_is_refused(command: list[str]) -> None:
    ended = CliRunner().invoke(build(), [*command, "--mesh", "--nats", "nats://127.0.0.1:4222"])
    assert ended.exit_code == 2
    assert "--mesh takes no network flag but --port" in ended.output


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
