"""A served simulation is recorded in motion, and its recording replayed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fixtures.waiting import free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.recording import read_entries
from strands_robots.simulation import Simulation

pytest.importorskip("mcap")


def test_what_an_arm_did_is_recorded_and_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    run = tmp_path / "run.mcap"
    world = Simulation("bench")
    world.add_robot("arm", "so100")
    runtime = init_device_connect_sync(world, peer_id="sim-1", link=loopback_config(port))
    try:
        assert world.start_policy("arm", "wave", duration=20)["status"] == "success"
        line = ["record", "sim-1", "--out", str(run), "--for", "2", "--port", str(port), "--json"]
        done = CliRunner().invoke(build(), line)
    finally:
        stop_device_connect(runtime)
        world.cleanup()
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["lost"] == 0
    assert told["messages"]["/sim-1/streamStep"] > 20
    assert {"streamStep", "observationUpdate"} <= {entry.event for entry in read_entries(run)}
    again = CliRunner().invoke(build(), ["replay", str(run), "--to", "so100", "--speed", "2", "--json"])
    assert again.exit_code == 0, again.output
    told = json.loads(again.stdout.splitlines()[-1])
    assert (told["state"], told["stopped"], told["errors"]) == ("completed", True, 0)


def test_nothing_heard_is_a_failure_and_not_an_empty_success(tmp_path: Path) -> None:
    line = ["record", "nobody-1", "--out", str(tmp_path / "run.mcap"), "--for", "0.3", "--port", str(free_port())]
    done = CliRunner().invoke(build(), [*line, "--json"])
    assert done.exit_code != 0
