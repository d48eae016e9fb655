"""An MCP server names, in answer to the stop of another machine, the robot that it alone knows."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.safety.sightings import Sightings

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

pytestmark = pytest.mark.timeout(300)

ENDED_S = 30.0


@dataclass(frozen=True)
class ShopFloor:
    """A network: the flags of commands on it, those of the server, and further settings of all."""

    flags: tuple[str, ...]
    server: tuple[str, ...]
    settings: Mapping[str, str]


@pytest.fixture(params=["device_connect", "mesh"])
def shop_floor(request: pytest.FixtureRequest) -> Iterator[ShopFloor]:
    settings = {"STRANDS_MESH_PORT": str(free_port())}
    if request.param == "mesh":
        # A hub that is not frozen.
        with MeshPeer("hub", "none", settings):
            yield ShopFloor(("--mesh",), (), settings)
        return
    with NatsServer() as server:
        flags = ("--nats", server.url)
        yield ShopFloor(flags, flags, settings)


@contextmanager
def mcp_server(machine: Machine, *flags: str) -> Iterator[None]:
    """Run a server; at the end of the block its client leaves, or it is told to end."""
    server = machine.start("mcp", *flags)
    try:
        yield
    finally:
        if "--http" in flags:
            server.terminate()
        server.communicate(timeout=ENDED_S)
    assert server.returncode == 0


@pytest.mark.parametrize("http", [False, True], ids=["stdio", "http"])
def test_mcp_server_names_a_frozen_robot_that_the_stopping_machine_never_heard(
    shop_floor: ShopFloor, tmp_path: Path, *, http: bool
) -> None:
    desk, agent, shop = (Machine(tmp_path / name, **shop_floor.settings) for name in ("desk", "agent", "shop"))
    key = agent.json("keys", "console")[1]["STRANDS_MESH_CONSOLE_PUBLIC_KEYS"]
    assert desk.json("enroll", "--console", key)[0] == 0
    transport = ("--http", str(free_port())) if http else ()
    with (
        shop.serving("arm-2", *shop_floor.flags) as (robot, _),
        mcp_server(agent, "--as", "helper", *shop_floor.server, *transport),
    ):
        memory = Sightings(tmp_path / "agent")
        eventually(lambda: "arm-2" in {each.name for each in memory.read()[0]}, 60.0, what="the server's memory")
        os.kill(robot.pid, signal.SIGSTOP)
        try:
            # Its link is opened while it serves already, so the first stop may come too early.
            eventually(lambda: _named(desk, *shop_floor.flags), 120.0, what="the server's report")
        finally:
            os.kill(robot.pid, signal.SIGCONT)


def _named(desk: Machine, *flags: str) -> bool:
    code, said = desk.json("estop", "--reason", "a test", *flags)
    return code == 3 and said["silent"] == ["arm-2"] and "helper" in said["reasons"]["arm-2"]
