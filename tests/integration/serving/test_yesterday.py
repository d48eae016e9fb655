"""Robots and callers of the release before beside those of today, both ways, on both networks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually, free_port
from fixtures.yesterday import earlier_package

from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.mesh import init_mesh, session

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(earlier_package(tmp_path_factory.mktemp("earlier")))


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> int:
    number = free_port()
    monkeypatch.setenv("STRANDS_MESH", "true")
    for name in ("STRANDS_MESH_PORT", "STRANDS_DC_PORT"):
        monkeypatch.setenv(name, str(number))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    return number


@contextmanager
def mesh_peer(robot: Any, name: str) -> Iterator[Any]:
    peer = init_mesh(robot, name)
    assert peer is not None
    try:
        yield peer
    finally:
        peer.close()
        eventually(lambda: session.current_session() is None)


def command(earlier: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of the earlier release."""
    return subprocess.run(
        [sys.executable, "-m", "strands_robots.cli", *words],
        env={**os.environ, "PYTHONPATH": earlier},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )


def test_the_earlier_release_is_what_runs(earlier: str) -> None:
    asked = (
        "import strands_robots as s, importlib.util as u; print(s.__file__, u.find_spec(s.__name__ + '.identity_map'))"
    )
    where = [sys.executable, "-c", asked]
    told = subprocess.run(where, env={**os.environ, "PYTHONPATH": earlier}, capture_output=True, text=True, check=True)
    assert told.stdout.split() == [f"{earlier}/strands_robots/__init__.py", "None"]


def test_robot_of_the_earlier_release_is_driven_and_stopped_over_the_mesh(
    earlier: str, port: int, state_directory: Path
) -> None:
    settings = {"PYTHONPATH": earlier, "STRANDS_STATE_DIR": str(state_directory)}
    old = MeshPeer("sim-1", "world", settings)
    try:
        with mesh_peer(None, "console") as console:
            eventually(lambda: console.get_peer("sim-1"))
            for _ in range(2):
                assert console.send("sim-1", {"action": "status"}, 20)["result"]["status"] == "success"
                started = console.send("sim-1", {"action": "start", "instruction": "w", "policy_provider": "mock"}, 20)
                assert started["result"]["status"] == "success"
                assert console.send("sim-1", {"action": "stop"}, 20)["result"]["ok"] is True
            refused = console.send("sim-1", {"action": "describe"}, 20)
            assert "action must be one of" in refused["error"]
            answers = console.emergency_stop()
            assert [each["responder_id"] for each in answers if each["type"] == "response"] == ["sim-1"]
            refused = console.send("sim-1", {"action": "start", "instruction": "w", "policy_provider": "mock"}, 20)
            assert refused["error"] == "command rejected"
    finally:
        old.close()


def test_console_of_the_earlier_release_stops_an_own_verb_over_the_mesh(
    earlier: str, port: int, state_directory: Path
) -> None:
    robot = Barista()
    with mesh_peer(robot, "barista-9"):
        old = MeshPeer("console", "none", {"PYTHONPATH": earlier, "STRANDS_STATE_DIR": str(state_directory)})
        try:
            old.sees("barista-9")
            assert old.ask("send", "barista-9", {"action": "status"}, 20)["result"]["status"] == "success"
            for _ in range(2):
                working = threading.Thread(target=robot.brew_coffee, args=(8,))
                working.start()
                eventually(robot.brewing.is_set)
                assert old.ask("send", "barista-9", {"action": "stop"}, 20)["result"]["ok"] is True
                working.join(20.0)
            old.ask("estop")
            refused = old.ask("send", "barista-9", {"action": "start", "policy_provider": "mock"}, 20)
            assert refused["error"] == "command rejected"
        finally:
            old.close()


def test_robot_of_the_earlier_release_is_driven_and_stopped_over_device_connect(earlier: str, port: int) -> None:
    words = [sys.executable, "-m", "strands_robots.cli", "serve", "so100", "--peer-id", "arm-1", "--json"]
    environment = {**os.environ, "PYTHONPATH": earlier}
    served = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        assert json.loads(served.stdout.readline())["peer_id"] == "arm-1"
        with FleetClient(loopback_config(port), "tester") as client:
            eventually(lambda: [peer.id for peer in client.peers()] == ["arm-1"])
            for _ in range(2):
                assert client.call("arm-1", "getStatus", {}, 20.0)["status"] == "success"
                assert (
                    client.call("arm-1", "execute", {"instruction": "w", "duration": 60.0}, 20.0)["status"] == "success"
                )
                assert client.stop("arm-1", 20.0)["status"] == "success"
    finally:
        served.terminate()
        served.communicate(timeout=60.0)


def test_command_line_of_the_earlier_release_calls_an_own_verb_and_stops_it(earlier: str, port: int) -> None:
    robot = Barista()
    runtime = init_device_connect_sync(robot, peer_id="barista-1", link=loopback_config(port))
    try:
        assert "brewCoffee" in command(earlier, "peers", "barista-1").stdout
        made = command(earlier, "call", "barista-1", "brewCoffee", "cups=2", "--json")
        assert json.loads(made.stdout)["cups"] == 2
        for _ in range(2):
            working = threading.Thread(target=robot.brew_coffee, args=(8,))
            working.start()
            eventually(robot.brewing.is_set)
            stopped = command(earlier, "stop", "barista-1")
            assert stopped.returncode == 0, stopped.stdout + stopped.stderr
            assert not robot.brewing.is_set()
            working.join(20.0)
    finally:
        stop_device_connect(runtime)
