"""Device Connect and the mesh on one machine at the same loopback port."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from device_connect_edge.messaging import MessagingError
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from fixtures.forked import COMMANDS, start
from fixtures.waiting import accepts, eventually, eventually_async, free_port, until
from tests.integration.mesh.conftest import Join

from strands_robots.device_connect.backends import loopback_config, open_client
from strands_robots.mesh.transport import config


async def answered(caller: Caller, value: str) -> None:
    """Wait until ``dev-2`` gives the value back; whoever lost the hub needs a moment to be there again."""

    async def answered() -> bool:
        try:
            answer = await caller.call("dev-2", "getStatus", {"value": value})
        except MessagingError:
            return False
        return bool(answer["result"]["value"] == value)

    await eventually_async(answered, what=f"an answer with {value}")


@pytest.mark.parametrize("first", ["device", "mesh"])
async def test_who_comes_second_shares_the_port_and_a_survivor_takes_it_over(join: Join, port: int, first: str) -> None:
    link = loopback_config(port)
    console = join("console", "none") if first == "mesh" else None
    with EchoDevice("dev-1", link) as one, EchoDevice("dev-2", link):
        console = console or join("console", "none")
        sim = join("sim-1")
        console.sees("sim-1")
        sim.sees("console")
        async with Caller(client=await open_client(link)) as caller:
            await caller.sees("dev-1", "dev-2")
            await answered(caller, "a")
            (one if first == "device" else console).kill()
            await until(lambda: accepts(port), what="a listener at the port again")
            await answered(caller, "b")
        other = join("sim-2")
        eventually(lambda: other.ask("ping", "sim-1", 0.5)["status"] == "ok")
        sim.sees("sim-2")
        async with Caller(client=await open_client(link)) as late:
            await late.sees("dev-2")


@pytest.fixture
def served_on_both(port: int, tmp_path: Path) -> Iterator[str]:
    """A simulated arm in one process, on Device Connect and on the mesh."""
    state = tmp_path / "both"
    state.mkdir(mode=0o700)
    both = {"STRANDS_MESH": "true", "STRANDS_MESH_PORT": str(port), "STRANDS_DC_PORT": str(port)}
    serving = start(
        [sys.executable, "-m", "strands_robots.cli", "serve", "so100", "--peer-id", "arm-1", "--json"],
        imports=COMMANDS,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **both, "STRANDS_STATE_DIR": str(state)},
    )
    try:
        assert serving.stdout is not None
        yield json.loads(serving.stdout.readline())["peer_id"]
    finally:
        serving.kill()
        serving.communicate()


async def test_one_process_serves_its_robot_on_both(join: Join, port: int, served_on_both: str) -> None:
    console = join("console", "none")

    def on_mesh() -> Any:
        return next((row for row in console.ask("peers") if row.get("sim_robots") == ["so100"]), None)

    peer = eventually(on_mesh, what="the arm on the mesh")["peer_id"]
    assert console.ask("send", peer, {"action": "status"}, 20)["result"]["status"] == "success"
    async with Caller(client=await open_client(loopback_config(port))) as caller:
        await caller.sees(served_on_both)
        assert (await caller.call(served_on_both, "getStatus"))["result"]
        # A stop by one road locks the robot on the other.
        console.ask("estop")
        moved = await caller.call(served_on_both, "execute", {"instruction": "wave", "policy_provider": "mock"})
        assert moved["result"]["status"] == "error"


def test_a_mesh_with_certificates_needs_another_port_and_says_so(
    join: Join, port: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config.make_authority(tmp_path / "keys")
    certified = config.issue_certificate(tmp_path / "keys", "sim-1").settings()
    with EchoDevice("dev-1", loopback_config(port)):
        assert join("sim-1", **certified).ask("alive") is False
        assert "set STRANDS_MESH_PORT" in capfd.readouterr().err
        assert join("sim-1", **certified, STRANDS_MESH_PORT=str(free_port())).ask("alive") is True
