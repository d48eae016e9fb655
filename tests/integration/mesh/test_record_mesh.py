"""Peers of the mesh are recorded by another process."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND
from fixtures.forked import COMMANDS, start
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually

from strands_robots.recording.file import RecordedEvent, RecordedJoints, RecordedPicture, read_items

pytest.importorskip("mcap")

CAMERAS = {"overview", "front", "side", "top", "table", "so100.wrist"}


@pytest.fixture
def settings(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("PORT", str(port)), ("CAMERA_HZ", "10")):
        monkeypatch.setenv(f"STRANDS_MESH_{name}", value)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))


def recorded_cameras(run: Path) -> set[str]:
    """Return the cameras whose frames are in the recording so far."""
    return {item.camera for item in read_items(run) if isinstance(item, RecordedPicture)}


def has_joints(run: Path) -> bool:
    """Return whether a robot's joints are in the recording so far."""
    return any(isinstance(item, RecordedJoints) for item in read_items(run))


def start_process(*arguments: str) -> Any:
    return start([*COMMAND, *arguments, "--json"], imports=COMMANDS, stdout=subprocess.PIPE, text=True)


@pytest.mark.usefixtures("settings")
def test_states_pictures_and_stops_of_a_served_world_are_recorded(
    tmp_path: Path, join: Callable[..., MeshPeer]
) -> None:
    run = tmp_path / "run.mcap"
    console = join("console-1", "none")
    serving = start_process("serve", "so100", "--mesh", "--peer-id", "arm-1")
    try:
        assert json.loads(serving.stdout.readline())["peer_id"] == "arm-1"
        console.sees("arm-1")
        recording = start_process("record", "arm-1", "--out", str(run), "--mesh")
        try:
            eventually(lambda: run.exists() and run.stat().st_size > 20_000 and recorded_cameras(run) >= CAMERAS)
            eventually(lambda: has_joints(run))
            console.ask("estop")
            eventually(
                lambda: "emergencyStop" in {item.event for item in read_items(run) if isinstance(item, RecordedEvent)}
            )
            recording.send_signal(signal.SIGINT)
            out = recording.communicate(timeout=60)[0]
        finally:
            recording.kill()
            recording.wait()
    finally:
        serving.kill()
        serving.communicate()
    assert recording.returncode == 0, out
    assert json.loads(out.splitlines()[-1])["lost"] == 0
    items = list(read_items(run))
    joints = next(item for item in items if isinstance(item, RecordedJoints))
    assert joints.device == "arm-1"
    assert "shoulder_pan" in joints.joints
    pictures = [item for item in items if isinstance(item, RecordedPicture)]
    assert recorded_cameras(run) == CAMERAS
    assert all(item.jpeg[:2] == b"\xff\xd8" for item in pictures)
    assert "emergencyStop" in {item.event for item in items if isinstance(item, RecordedEvent)}
