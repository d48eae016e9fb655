"""Reachy Mini as a peer of the mesh: its verbs, its stop and its status."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.mesh.peers import RealClock, fleet

from strands_robots.drivers.reachy import ReachyDriver


@pytest.fixture(autouse=True)
def surroundings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "1")


def test_reachy_looks_plays_and_is_stopped_over_the_mesh(reachy: ReachyDriver, tmp_path: Path) -> None:
    with fleet(tmp_path) as peers:
        peers.clock = RealClock()
        peers.join(reachy, "head-1")
        console = peers.join(None, "console")

        def ask(action: str, **arguments: Any) -> dict[str, Any]:
            reply = console.send("head-1", {"action": action, **arguments}, timeout=20)
            assert "result" in reply, reply
            result: dict[str, Any] = reply["result"]
            return result

        assert ask("look", pitch=5)["status"] == "success"
        eventually(lambda: ask("status")["task_status"] == "completed", what="the end of the look")
        assert ask("status")["instruction"] == "look"
        assert set(ask("state")["joints"]) >= {"body_yaw", "left_antenna"}
        assert ask("playMove", move_name="nowhere1")["status"] == "error"
        assert ask("wakeUp")["status"] == "success"
        assert ask("status")["task_status"] == "running"
        assert ask("stop")["ok"] is True
        eventually(lambda: ask("status")["task_status"] == "stopped", what="the end of the move")
