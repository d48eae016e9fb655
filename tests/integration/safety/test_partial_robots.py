"""Doubles that lack a robot's verbs, on both networks at once: they join, and no stop of them looks like one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.envelope import success
from strands_robots.errors import RobotError
from strands_robots.fleet import Fleet, connect
from strands_robots.mesh import Mesh, init_mesh

DOUBLES = {
    "nothing": object,
    "named": lambda: SimpleNamespace(tool_name_str="x"),
    "starts": lambda: SimpleNamespace(start_task=lambda instruction, **_: success("Started.")),
    "stops": lambda: SimpleNamespace(stop_task=lambda: success("Stopped.")),
    "mock": MagicMock,
}
STOPS = {"stops"}


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> Iterator[tuple[Fleet, Mesh]]:
    port = free_port()
    for name, value in {"STRANDS_MESH_PORT": str(port), "STRANDS_DC_PORT": str(port), "STRANDS_MESH": "true"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    with ExitStack() as stack:
        for name, make in DOUBLES.items():
            double: Any = make()
            runtime = init_device_connect_sync(double, peer_id=name, link=loopback_config(port))
            stack.callback(stop_device_connect, runtime)
            peer = init_mesh(double, peer_id=name)
            assert peer is not None
            stack.callback(peer.close)
        console = init_mesh(None, peer_id="console")
        assert console is not None
        stack.callback(console.close)
        eventually(lambda: DOUBLES.keys() <= console.peers_by_id.keys(), what="the doubles on the mesh")
        yield stack.enter_context(connect(port=port)), console


def test_partial_robots_join_and_no_stop_of_them_is_claimed(
    served: tuple[Fleet, Mesh], caplog: pytest.LogCaptureFixture
) -> None:
    fleet, console = served
    for name in DOUBLES:
        answer = console.send(name, {"action": "stop"}, 20)["result"]
        assert answer["ok"] is (name in STOPS), answer
        robot = fleet[name]
        if name in STOPS:
            assert robot.stop()["stopped"] is True
        else:
            with pytest.raises(RobotError, match=name):
                robot.stop()
    for name in ("nothing", "named", "stops"):
        reason = console.send(name, {"action": "start", "policy_provider": "mock"}, 20)["result"]["reason"]
        assert reason == f"{name} exposes no start_task."
    replies = {reply["responder_id"]: reply["result"]["ok"] for reply in console.emergency_stop()}
    assert {name: replies[name] for name in DOUBLES} == {name: name in STOPS for name in DOUBLES}
    outcome = fleet.estop(reason="test")
    for name in DOUBLES.keys() - STOPS:
        assert f"{name} did not stop" in str(outcome)
