"""Two terminals, two commands, no configuration: two robots on the mesh; and certificates without a recipe."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from strands_robots.cli.app import build

COMMAND = [sys.executable, "-m", "strands_robots.cli"]


def test_a_served_arm_is_seen_from_another_terminal_and_ctrl_c_stops_it(tmp_path: Path, port: int) -> None:
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
        seen = subprocess.run(
            [*COMMAND, "peers", "--mesh", "--json"],
            capture_output=True,
            text=True,
            env=settings,
            check=True,
            timeout=30,
        )
        [row] = json.loads(seen.stdout)["peers"]
        assert (row["peer_id"], row["type"], row["sim_robots"]) == ("arm-1", "sim", ["so100"])
        serving.send_signal(signal.SIGINT)
        rest = serving.communicate(timeout=15)[0]
        assert json.loads(rest.splitlines()[0])["stopped"] is True
    finally:
        serving.kill()
        serving.wait()


def test_keys_are_made_issued_and_named_for_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str]:
        ended = CliRunner().invoke(build(), ["mesh", "keys", *words])
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
