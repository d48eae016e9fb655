"""A world whose robots change is described anew: a client sees the verbs of its first arm, and when they are gone."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from device_connect_edge import DeviceRuntime
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port, until

from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    SimulationDeviceDriver,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.backends import open_client, register
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS
from strands_robots.simulation import Simulation


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest) -> Iterator[LinkConfig]:
    if request.param == "zenoh":
        yield loopback_config(free_port())
        return
    with NatsServer() as server:
        yield LinkConfig(transport="nats", connect=(server.url,))


@pytest.fixture
def world() -> Iterator[Simulation]:
    made = Simulation()
    yield made
    made.cleanup()


def described(payload: Any) -> set[str]:
    """The functions in a presence message or a registration."""
    return {each["name"] for each in payload["capabilities"]["functions"]}


def test_client_sees_the_verbs_of_a_world_that_gains_and_loses_an_arm(link: LinkConfig, world: Simulation) -> None:
    runtime = init_device_connect_sync(world, peer_id="sim-1", link=link, allow_insecure=True)
    try:
        with FleetClient(link, "tester") as fleet:

            def functions() -> set[str]:
                return {str(each["name"]) for peer in fleet.peers(2.0) for each in peer.functions}

            assert functions() & {"step", "execute", "pick"} == {"step"}
            assert "no robot" in fleet.call("sim-1", "getPose")["reason"], "it is refused by its reason"
            world.add_robot("rover")
            eventually(lambda: functions() & {"step", "execute", "pick"} == {"step", "execute"})
            world.add_robot("so100")
            eventually(lambda: functions() >= ARM_MOTION_VERBS.keys())
            assert fleet.call("sim-1", "getPose", {"robot_name": "so100"})["status"] == "success"
            assert described(fleet.call("sim-1", "requestRegistration")) >= ARM_MOTION_VERBS.keys()
            world.remove_robot("so100")
            eventually(lambda: functions().isdisjoint(ARM_MOTION_VERBS))
    finally:
        stop_device_connect(runtime)


@asynccontextmanager
async def presence_of(link: LinkConfig, device: str) -> AsyncIterator[list[Any]]:
    """What a device announces by itself, newest last."""
    client: Any = await open_client(link)
    seen: list[Any] = []

    async def on_presence(data: bytes, _reply: str | None) -> None:
        seen.append(json.loads(data))

    await client.subscribe(f"device-connect.default.{device}.presence", on_presence, subscribe_only=True)
    try:
        yield seen
    finally:
        await client.close()


async def test_framework_own_runtime_announces_the_new_verbs_too(link: LinkConfig, world: Simulation) -> None:
    runtime = DeviceRuntime(
        driver=SimulationDeviceDriver(world),
        device_id="sim-1",
        messaging_backend=register(link),
        allow_insecure=True,
    )
    async with presence_of(link, "sim-1") as seen:
        task = asyncio.create_task(runtime.run())
        try:
            await until(lambda: seen)
            assert "pick" not in described(seen[-1])
            await asyncio.to_thread(world.add_robot, "so100")
            await until(lambda: "pick" in described(seen[-1]))
        finally:
            await runtime.stop()
            await asyncio.gather(task, return_exceptions=True)
