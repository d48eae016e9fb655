"""A served simulation is recorded in motion, and its recording replayed."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import pytest
from fixtures.command_line import COMMAND
from fixtures.waiting import eventually, free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.recording.file import RecordedEvent, read_events, read_items, recorded_actions
from strands_robots.simulation import Simulation

pytest.importorskip("mcap")
pytestmark = pytest.mark.timeout(300)


def test_recorded_motion_is_replayed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    run = tmp_path / "run.mcap"
    world = Simulation("bench")
    world.add_robot("arm", "so100")
    runtime = init_device_connect_sync(world, peer_id="sim-1", link=loopback_config(port))
    try:
        assert world.start_policy("arm", "wave", duration=600)["status"] == "success"
        line = ["record", "sim-1", "--out", str(run), "--for", "4", "--port", str(port), "--json"]
        done = CliRunner().invoke(build(), line)
    finally:
        stop_device_connect(runtime)
        world.cleanup()
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["lost"] == 0
    assert result["messages"]["/sim-1/streamStep"] > 20
    assert {"streamStep", "observationUpdate"} <= {entry.event for entry in read_events(run)}
    again = CliRunner().invoke(build(), ["replay", str(run), "--to", "so100", "--speed", "2", "--json"])
    assert again.exit_code == 0, again.output
    result = json.loads(again.stdout.splitlines()[-1])
    assert (result["state"], result["stopped"], result["errors"]) == ("completed", True, 0)


def test_serve_records_its_arm_also_while_it_stands(tmp_path: Path) -> None:
    run, port = tmp_path / "run.mcap", str(free_port())
    line = [*COMMAND, "serve", "so100", "--port", port, "--peer-id", "sim-1", "--record", str(run), "--json"]
    serving = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    try:
        assert serving.stdout is not None
        assert json.loads(serving.stdout.readline())["event"] == "serving"
        moved = CliRunner().invoke(
            build(), ["call", "sim-1", "execute", "instruction=wave", "duration=600", "--port", port, "--json"]
        )
        assert moved.exit_code == 0, moved.output
        eventually(lambda: run.stat().st_size > 30_000, within=60)
        serving.send_signal(signal.SIGINT)
        rest = [json.loads(text) for text in serving.communicate(timeout=60)[0].splitlines()]
    finally:
        serving.kill()
        serving.wait()
    result = next(each for each in rest if each["event"] == "recorded")
    assert result["lost"] == 0
    assert result["messages"]["/sim-1/so100/joint_states"] > 20
    assert result["messages"]["/sim-1/policyStarted"] == 1
    assert result["messages"]["/sim-1/halted"] >= 1
    items = list(read_items(run))
    ended = [item for item in items if isinstance(item, RecordedEvent) and item.event == "policyComplete"]
    assert [entry.payload["state"] for entry in ended] == ["stopped"]
    assert recorded_actions(run)


def test_recording_without_messages_fails_and_leaves_no_file(tmp_path: Path) -> None:
    line = ["record", "nobody-1", "--out", str(tmp_path / "run.mcap"), "--for", "0.3", "--port", str(free_port())]
    done = CliRunner().invoke(build(), [*line, "--json"])
    assert done.exit_code == 3
    assert not (tmp_path / "run.mcap").exists()
