"""Robots of the native mesh on the page."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import fleet

from strands_robots.dashboard import mesh_feed
from strands_robots.dashboard.fleet_model import FleetModel, key_of


def test_heartbeats_are_signs_of_life_while_another_robot_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answered = threading.Event(), threading.Event()

    def ask(*_: Any) -> list[Any]:
        asked.set()
        answered.wait(20)
        return []

    monkeypatch.setattr(mesh_feed, "ask_peers", ask)
    model = FleetModel()
    with fleet(tmp_path) as peers:
        peers.join(Arm("arm-1"), "arm-1")
        console = peers.join(None, "console")
        feed = mesh_feed.MeshFeed(model, console)
        console.unsubscribe("dashboard state")
        try:
            eventually(asked.is_set, what="the robots are asked")
            for _ in range(2):
                row = model.row(key_of(feed.network, "arm-1"))
                assert row is not None
                before = row.heard
                eventually(lambda: row.heard != before, what="a heartbeat")  # noqa: B023
        finally:
            answered.set()
            feed.close()
