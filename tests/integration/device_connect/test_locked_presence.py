"""A locked robot says so in its presence, also one that the framework serves; others say nothing of it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from device_connect_edge import DeviceRuntime, discovery
from device_connect_edge.drivers import DeviceDriver
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port, until

from strands_robots.device_connect import (
    LinkConfig,
    init_device_connect,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.backends import open_client, register
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.plane import plane
from strands_robots.tools import robot_mesh


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[LinkConfig]:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "*")
    monkeypatch.setenv("STRANDS_MESH", "false")
    if request.param == "zenoh":
        port = free_port()
        monkeypatch.setenv("STRANDS_DC_PORT", str(port))
        yield loopback_config(port)
        return
    with NatsServer() as server:
        monkeypatch.setenv("MESSAGING_BACKEND", "nats")
        monkeypatch.setenv("NATS_URL", server.url)
        monkeypatch.setenv("DEVICE_CONNECT_ALLOW_INSECURE", "true")
        monkeypatch.setenv("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
        yield LinkConfig(transport="nats", connect=(server.url,))


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot("arm-1")
    yield toy
    toy.close()


@asynccontextmanager
async def stated_by(link: LinkConfig, device: str) -> AsyncIterator[list[Any]]:
    """What a device says of its lockout in its presence, without being asked, newest last."""
    client: Any = await open_client(link)
    stated: list[Any] = []

    async def on_presence(data: bytes, _reply: str | None) -> None:
        stated.append(json.loads(data).get("status", {}).get("locked"))

    await client.subscribe(f"device-connect.default.{device}.presence", on_presence, subscribe_only=True)
    try:
        yield stated
    finally:
        await client.close()


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have devices announce themselves once, and then where something has changed."""
    monkeypatch.setattr(discovery, "BURST_DURATION", 0.0)
    monkeypatch.setattr(discovery, "STEADY_INTERVAL", 300.0)


async def follows_the_lockout(stated: list[Any]) -> None:
    """Wait until a device has stated each change of its lockout."""
    await until(lambda: stated and stated[-1] is False)
    await asyncio.to_thread(plane().begin, StopOrder(new_epoch(), "desk", "smoke"))
    await until(lambda: stated[-1] is True)
    await asyncio.to_thread(plane().clear_local, "the test")
    await until(lambda: stated[-1] is False)


@pytest.mark.usefixtures("quiet")
async def test_robot_announces_its_lockout_and_its_end(link: LinkConfig, robot: ToyRobot) -> None:
    async with stated_by(link, "arm-1") as stated:
        runtime = await init_device_connect(robot, peer_id="arm-1", link=link, allow_insecure=True)
        try:
            await follows_the_lockout(stated)
        finally:
            await runtime.shutdown()


@pytest.mark.usefixtures("quiet")
async def test_robot_on_the_framework_own_runtime_does_so_too(link: LinkConfig, robot: ToyRobot) -> None:
    runtime = DeviceRuntime(
        driver=RobotDeviceDriver(robot), device_id="arm-1", messaging_backend=register(link), allow_insecure=True
    )
    async with stated_by(link, "arm-1") as stated:
        task = asyncio.create_task(runtime.run())
        try:
            await follows_the_lockout(stated)
        finally:
            await runtime.stop()
            await asyncio.gather(task, return_exceptions=True)


def test_agent_sees_a_lockout_at_once_and_none_of_a_bare_device(link: LinkConfig, robot: ToyRobot) -> None:
    runtimes = [
        init_device_connect_sync(body, peer_id=name, link=link, allow_insecure=True)
        for name, body in {"arm-1": robot, "kettle": DeviceDriver()}.items()
    ]
    try:

        def locked() -> dict[str, Any]:
            return {row["id"]: row.get("locked", "unsaid") for row in robot_mesh(action="peers")["peers"]}

        eventually(lambda: locked() == {"arm-1": False, "kettle": "unsaid"}, what="both devices")
        for _ in range(3):
            plane().begin(StopOrder(new_epoch(), "desk", "smoke"))
            assert locked() == {"arm-1": True, "kettle": "unsaid"}
            plane().clear_local("the test")
            assert locked() == {"arm-1": False, "kettle": "unsaid"}
    finally:
        for runtime in runtimes:
            stop_device_connect(runtime)
