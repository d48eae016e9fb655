"""Robots of two machines find one another by multicast, with mutual TLS and without a stated address."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.network_lab import NetworkLab, Side, missing

from strands_robots.mesh.transport import config

pytestmark = pytest.mark.system


CALLER = """
from strands_robots import connect
with connect() as fleet:
    print(fleet["arm-1"].status()["status"])
"""


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[NetworkLab]:
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    config.make_authority(tmp_path / "keys")
    with NetworkLab() as lab:
        for side in (lab.here, lab.there):
            route = ["ip", "-n", side.namespace, "route", "add", "default", "dev", side.device]
            subprocess.run(route, check=True, capture_output=True)
        yield lab


def settings_of(peer_id: str, side: Side, folder: Path) -> dict[str, str]:
    issued = config.issue_certificate(folder / "keys", peer_id, (side.address,))
    state = folder / peer_id
    state.mkdir(mode=0o700)
    return {"STRANDS_STATE_DIR": str(state), "STRANDS_MESH_MULTICAST": "true", **issued.settings()}


def join(peer_id: str, robot: str, side: Side, folder: Path, stack: ExitStack) -> MeshPeer:
    return stack.enter_context(MeshPeer(peer_id, robot, settings_of(peer_id, side, folder), side.within))


def test_caller_on_a_machine_without_a_hub_finds_a_robot_by_multicast(lab: NetworkLab, tmp_path: Path) -> None:
    with ExitStack() as stack:
        join("arm-1", "arm", lab.here, tmp_path, stack)
        settings = {**os.environ, **settings_of("console", lab.there, tmp_path)}
        command = [*lab.there.within, sys.executable, "-c", CALLER]
        said = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=60, check=False)
    assert said.stdout.split() == ["success"], said.stderr


def test_multicast_finds_robots_on_two_machines_and_a_stop_reaches_them(lab: NetworkLab, tmp_path: Path) -> None:
    with ExitStack() as stack:
        # On each machine the first process is the hub, and the second one its client.
        arm = join("arm-1", "arm", lab.here, tmp_path, stack)
        sim = join("sim-1", "world", lab.here, tmp_path, stack)
        arm.sees("sim-1")
        join("arm-2", "arm", lab.there, tmp_path, stack)
        console = join("console", "none", lab.there, tmp_path, stack)
        console.sees("arm-1", "sim-1", "arm-2", within=40)
        sim.sees("console", "arm-2", within=40)
        assert console.ask("ping", "sim-1")["status"] == "ok"
        answered = {each["responder_id"] for each in console.ask("estop")[1]}
        assert answered == {"arm-1", "sim-1", "arm-2"}
        assert arm.ask("epoch") == console.ask("epoch")
