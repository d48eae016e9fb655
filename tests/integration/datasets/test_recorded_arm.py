"""``dataset record`` with a simulated arm: killed in an attempt, and stopped from another process."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import numpy as np
import psutil
import pytest
from fixtures.command_line import COMMAND
from fixtures.openpi_server import OpenPiServer
from fixtures.waiting import eventually, free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@pytest.fixture
def leader(tmp_path: Path) -> Path:
    """A recording that sweeps the pan for a minute."""
    file = tmp_path / "sweep.csv"
    rows = [f"{second},{0.3 * (second % 2)},-1.9,1.9,0.9,0.0,0.3" for second in range(60)]
    file.write_text("\n".join(["t," + ",".join(JOINTS), *rows]) + "\n")
    return file


def recording(folder: Path, leader: Path, *more: str) -> subprocess.Popen[str]:
    line = ["dataset", "record", str(folder), "--robot", "so100", "--leader", str(leader), "--task", "sweep"]
    line += ["--json", *more, *([] if "--cameras" in more else ["--cameras", "none"])]
    return subprocess.Popen([*COMMAND, *line], stdout=subprocess.PIPE, text=True)


def events(child: subprocess.Popen[str]) -> list[dict[str, object]]:
    output, _ = child.communicate(timeout=120)
    return [json.loads(line) for line in output.splitlines()]


def test_attempt_that_was_running_when_it_was_killed_is_saved(tmp_path: Path, leader: Path) -> None:
    folder = tmp_path / "set"
    child = recording(folder, leader, "--no-network", "--episodes", "1", "--episode-s", "60")
    try:
        running = folder / ".running" / "attempt-000000.mcap"
        eventually(lambda: running.exists() and running.stat().st_size > 20_000, within=60)
    finally:
        child.kill()
        child.communicate()
    again = events(recording(folder, leader, "--no-network", "--episodes", "1", "--episode-s", "0.5", "--success"))
    assert [(each["event"], each.get("episode")) for each in again if each["event"] == "saved"] == [("saved", 1)]
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    killed, kept = (tables.read_frames(folder / data_file(number)) for number in (0, 1))
    assert len(killed["index"]) > len(kept["index"]) > 5
    assert (killed["next.success"].any(), kept["next.success"][-1]) == (False, True)
    assert kept["stop"].tolist() == [0] * len(kept["index"]), "the end of an attempt is no stop"


@pytest.mark.system
def test_killed_encoder_ends_the_recording_by_name_and_costs_no_step(tmp_path: Path, leader: Path) -> None:
    folder = tmp_path / "set"
    child = recording(folder, leader, "--no-network", "--episode-s", "60", "--cameras", "so100/wrist")
    try:
        rows = folder / ".running" / "attempt-000000.cameras" / "so100.wrist.rows"
        eventually(lambda: rows.exists() and rows.stat().st_size > 24 * 30, within=60)
        psutil.Process(child.pid).children()[0].kill()
        told = events(child)
    finally:
        child.kill()
        child.communicate()
    assert [each.get("event", each.get("status")) for each in told if each.get("event") != "dropped"] == [
        "saved",
        "error",
    ]
    assert "The attempt failed: the process that encodes the cameras has ended" in str(told[-1]["reason"])
    info, found = check_dataset(folder)
    assert ([*info.videos], [each for each in found if each.wrong]) == (["observation.images.so100.wrist"], [])


def test_stop_from_the_network_ends_the_recording_and_is_in_it(tmp_path: Path, leader: Path) -> None:
    folder, port = tmp_path / "set", str(free_port())
    child = recording(folder, leader, "--port", port, "--peer-id", "arm-1", "--episode-s", "60")
    try:
        running = folder / ".running" / "attempt-000000.mcap"
        eventually(lambda: running.exists() and running.stat().st_size > 10_000, within=60)
        stopped = CliRunner().invoke(build("stop"), ["stop", "arm-1", "--port", port, "--json"])
        assert stopped.exit_code == 0, stopped.output
        assert child.stdout is not None
        told = [json.loads(child.stdout.readline())["event"]]
        while told[-1] != "held":
            told.append(json.loads(child.stdout.readline())["event"])
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=60)
    finally:
        child.kill()
        child.communicate()
    assert told[-2:] == ["saved", "held"]
    assert child.returncode in (1, 130), "130 where Ctrl-C came before it waited for it"
    frames = tables.read_frames(folder / data_file(0))
    assert frames["stop"].max() == 1
    assert not frames["next.success"].any()


def test_profile_of_a_policy_drives_a_robot_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_POLICIES", "")  # which the command sets
    folder, keys = tmp_path / "set", json.dumps(JOINTS)
    told = [0.1, -1.9, 1.9, 0.9, 0.0, 0.3]
    with OpenPiServer(lambda observation: {"actions": np.full((10, 6), told, np.float32)}) as server:
        file = tmp_path / "policies.toml"
        entries = f'url = "{server.url}"\nstate = {keys}\naction = {keys}\nunits = "radians"\nrate = 30\n'
        file.write_text(f'[pi]\nprovider = "openpi"\n{entries}')
        line = ["--policy", "pi", "--policies", str(file), "--task", "reach", "--episodes", "2", "--episode-s", "0.7"]
        words = ["dataset", "record", str(folder), "--robot", "so100", *line, "--pause-s", "0", "--no-network"]
        done = CliRunner().invoke(build("dataset"), [*words, "--cameras", "none"])
    assert done.exit_code == 0, done.output
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    frames = tables.read_frames(folder / data_file(1))
    assert np.allclose(frames["action"][-1], told, atol=0.02)
    assert (frames["stop"].any(), frames["intervention"].any()) == (False, False)


def test_recording_refuses_what_it_cannot_do(tmp_path: Path, leader: Path) -> None:
    said = events(recording(tmp_path / "set", leader, "--no-network"))
    assert "--episode-s is needed without a terminal" in str(said[-1]["reason"])
    assert not (tmp_path / "set").exists()
