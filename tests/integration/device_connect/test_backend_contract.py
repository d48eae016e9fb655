"""Scenarios that every backend passes, with the bare framework at the other end."""

import asyncio
import contextlib

import pytest
from device_connect_edge import DeviceRuntime
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice, EchoDriver
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually_async, free_port, until
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect.backends import LinkConfig, open_client, register

D2D = {"DEVICE_CONNECT_DISCOVERY_MODE": "d2d"}


class Network:
    """A broker, our link to it, and the framework's own way to it."""

    def __init__(self, transport, broker):
        self.broker = broker
        self.transport = transport
        self.endpoint = broker.url if transport == "nats" else broker.endpoint
        self.link = LinkConfig(transport, connect=(self.endpoint,))
        self.environment = {"NATS_URL" if transport == "nats" else "ZENOH_CONNECT": self.endpoint, **D2D}

    def bare_caller(self):
        return Caller(self.transport, servers=(self.endpoint,))


@pytest.fixture(params=["zenoh", "nats"])
def network(request):
    with NatsServer() if request.param == "nats" else ZenohRouter() as broker:
        yield Network(request.param, broker)


async def called_and_followed(caller):
    """Find, call and follow ``arm-1``."""
    await caller.sees("arm-1")
    assert (await caller.call("arm-1", "getStatus", {"value": "hi"}))["result"]["value"] == "hi"
    received = await caller.collect("arm-1", "tick")
    await caller.call("arm-1", "burst", {"count": 50, "hz": 500})
    await until(lambda: len(received) == 50)
    assert [each["n"] for each in received] == list(range(50))


async def test_bare_agent_finds_calls_and_follows_our_device(network):
    with EchoDevice("arm-1", network.link):
        async with network.bare_caller() as bare:
            await called_and_followed(bare)


async def test_our_client_finds_calls_and_follows_a_bare_device(network):
    with EchoDevice("arm-1", environment=network.environment):
        async with Caller(client=await open_client(network.link)) as caller:
            await called_and_followed(caller)


async def test_device_answers_and_emits_when_a_killed_broker_has_come_back(network):
    with EchoDevice("arm-1", network.link):
        async with Caller(client=await open_client(network.link)) as caller:
            await caller.sees("arm-1")
            network.broker.kill()
            await until(lambda: not caller.client.is_connected, what="the lost broker noticed")
            with pytest.raises(MessagingError, match="not connected"):
                await caller.call("arm-1", "getStatus")
            network.broker.start()

            async def answered():
                with contextlib.suppress(MessagingError):
                    return (await caller.call("arm-1", "getStatus", wait_s=0.5)).get("result")

            await eventually_async(answered, what="an answer after the restart")
            async with network.bare_caller() as bare:
                await bare.sees("arm-1")
                received = await bare.collect("arm-1", "tick")
                await bare.call("arm-1", "burst", {"count": 3})
                await until(lambda: len(received) == 3)


@pytest.mark.parametrize(
    ("transport", "scheme", "reason"), [("zenoh", "tcp/", "no Zenoh link"), ("nats", "nats://", "no NATS connection")]
)
async def test_absent_broker_is_reported_within_the_deadline(transport, scheme, reason):
    link = LinkConfig(transport, connect=(f"{scheme}127.0.0.1:{free_port()}",), connect_timeout_s=1.0)
    with pytest.raises(MessagingError, match=reason):
        async with asyncio.timeout(30):
            await open_client(link)


async def test_request_without_a_responder_fails_long_before_its_deadline(network):
    async with Caller(client=await open_client(network.link)) as caller:
        started = asyncio.get_running_loop().time()
        with pytest.raises(MessagingError, match="no device answers"):
            await caller.call("absent", "getStatus", wait_s=60)
        assert asyncio.get_running_loop().time() - started < 30


async def test_stock_runtime_uses_a_registered_backend_by_name(network, monkeypatch):
    monkeypatch.setenv("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    register()
    runtime = DeviceRuntime(
        driver=EchoDriver(),
        device_id="arm-1",
        messaging_backend=f"strands-{network.transport}",
        messaging_urls=[network.endpoint],
        allow_insecure=True,
    )
    task = asyncio.create_task(runtime.run())
    try:
        async with network.bare_caller() as bare:
            await called_and_followed(bare)
        assert runtime.messaging.link == network.link
    finally:
        await runtime.stop()
        await asyncio.gather(task, return_exceptions=True)
