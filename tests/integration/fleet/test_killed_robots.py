"""Robots whose process is killed: what a call says that had been sent, and calls of a robot that is gone."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots import connect, errors
from strands_robots.device_connect.backends.zenoh import LOST_S
from strands_robots.fleet import Fleet
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH

SERVE = """
import sys, time
from strands_robots import Permit, run, verb

class Kiln:
    @verb(motion=True, lasts=60.0)
    def turn_plate(self, permit: Permit) -> dict[str, float]:
        "Turn the plate."
        print("turning", flush=True)
        time.sleep(60)
        return {}

    @verb(motion=False)
    def temperature(self) -> float:
        "Read the temperature."
        return 21.5

run(Kiln(), peer_id="kiln", mesh=sys.argv[1] == "mesh")
"""

Kiln = subprocess.Popen[str]


def serve(monkeypatch: pytest.MonkeyPatch, *, mesh: bool) -> Kiln:
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(free_port()))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    networks = "mesh" if mesh else "device_connect"
    return subprocess.Popen([sys.executable, "-c", SERVE, networks], stdout=subprocess.PIPE, text=True)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kiln]:
    """A robot on Device Connect."""
    process = serve(monkeypatch, mesh=False)
    yield process
    process.kill()
    process.communicate()


@pytest.fixture
def on_both(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kiln]:
    """A robot on both networks, which is the hub of both."""
    process = serve(monkeypatch, mesh=True)
    eventually(lambda: listens(int(os.environ["STRANDS_MESH_PORT"])), within=60, what="the hub of the mesh")
    yield process
    process.kill()
    process.communicate()


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True


def known(fleet: Fleet, networks: set[str]) -> Any:
    eventually(
        lambda: "kiln" in fleet and {each.name for each in fleet._networks.bearers("kiln")} == networks,
        what="the robot on its networks",
    )
    return fleet["kiln"]


def test_call_of_a_robot_that_is_killed_in_mid_verb_may_still_be_carried_out(alone: Kiln) -> None:
    said: list[Exception] = []

    def call() -> None:
        try:
            kiln.turn_plate()
        except errors.RefusalError as exc:
            said.append(exc)

    with connect(mesh=False) as fleet:
        kiln = known(fleet, {DEVICE_CONNECT})
        calling = threading.Thread(target=call)
        calling.start()
        assert alone.stdout is not None and alone.stdout.readline() == "turning\n"
        # A call that ends sooner on a link so young may have reached nobody.
        calling.join(2 * LOST_S)
        alone.kill()
        calling.join(30)
    assert [type(each) for each in said] == [errors.NoAnswerError]
    assert "may still carry the call out" in str(said[0])


def test_robot_that_is_gone_from_both_networks_is_named_soon_and_keeps_its_verbs(on_both: Kiln) -> None:
    with connect() as fleet:
        kiln = known(fleet, {DEVICE_CONNECT, MESH})
        on_both.kill()
        on_both.wait(30)
        for verb in ("temperature", "turn_plate", "turn_plate"):
            began = time.monotonic()
            with pytest.raises((errors.NoSuchRobotError, errors.NoAnswerError), match="kiln"):
                getattr(kiln, verb)()
            assert time.monotonic() - began < 9, "it does not wait for the patience of the verb"
