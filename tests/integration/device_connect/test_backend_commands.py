"""Every message on a command topic is answered at once."""

import asyncio
import contextlib
import json
import random

import psutil
import pytest
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config, open_client

FUZZ_MESSAGES = 20_000
GROWTH_MB = 40

MALFORMED = {
    "not JSON": (b"hello", -32700),
    "empty": (b"", -32700),
    "array": (b"[1,2]", -32600),
    "string": (b'"hi"', -32600),
    "no id": (b'{"method":"getStatus"}', -32600),
    "params list": (b'{"id":1,"method":"getStatus","params":[1]}', -32602),
    "params null": (b'{"id":1,"method":"getStatus","params":null}', -32602),
    "params text": (b'{"id":1,"method":"getStatus","params":"x"}', -32602),
    "meta": (b'{"id":1,"method":"getStatus","params":{"_dc_meta":[]}}', -32602),
    "deep": (b'{"id":1,"method":"getStatus","params":{"value":' + b"[" * 10_000 + b"]" * 10_000 + b"}}", -32600),
    "huge integer": (b'{"id":1,"method":"getStatus","params":{"value":' + b"9" * 5_000 + b"}}", -32700),
    "NaN": (b'{"id":1,"method":"getStatus","params":{"value":NaN}}', -32700),
    "unknown": (b'{"id":1,"method":"nope"}', -32601),
    "unserialisable": (b'{"id":1,"method":"notANumber"}', -32603),
}


@contextlib.asynccontextmanager
async def over(transport):
    """A device of ours, a bare caller, and the device's process."""
    if transport == "nats":
        with NatsServer() as server, EchoDevice(link=LinkConfig("nats", connect=(server.url,))) as device:
            async with Caller("nats", servers=(server.url,)) as bare:
                await bare.sees("echo-1")
                yield bare, psutil.Process(device.pid)
    else:
        port = free_port()
        with EchoDevice(link=loopback_config(port)) as device:
            async with Caller(servers=(f"tcp/127.0.0.1:{port}",)) as bare:
                await bare.sees("echo-1")
                yield bare, psutil.Process(device.pid)


@pytest.mark.parametrize("transport", ["zenoh", "nats"])
async def test_every_malformed_command_is_answered_at_once_with_its_code(transport):
    async with over(transport) as (bare, _):
        for what, (payload, code) in MALFORMED.items():
            assert (await bare.raw("echo-1", payload))["error"]["code"] == code, what
        assert (await bare.call("echo-1", "getStatus", {"value": "alive"}))["result"]["value"] == "alive"


async def test_command_of_ten_megabytes_is_refused_with_the_limit():
    async with over("zenoh") as (bare, device):
        before = device.memory_info().rss
        for _ in range(3):
            answer = await bare.raw("echo-1", b"x" * 10_000_000)
            assert answer["error"]["code"] == -32600
            assert "1048576" in answer["error"]["message"]
        assert (device.memory_info().rss - before) / 2**20 < GROWTH_MB


async def test_result_of_two_megabytes_arrives_over_zenoh():
    async with over("zenoh") as (bare, _):
        assert len((await bare.call("echo-1", "large", {"size": 2_000_000}))["result"]["text"]) == 2_000_000


async def test_quick_calls_are_answered_while_slow_ones_run():
    async with over("zenoh") as (bare, _):
        # A caller on the framework's own client would wait in its four threads; this one is ours.
        async with Caller(client=await open_client(bare_link(bare))) as caller:
            slow = [asyncio.ensure_future(caller.call("echo-1", "hold", wait_s=60)) for _ in range(8)]
            await caller.wait_held("echo-1", 8)
            assert (await caller.call("echo-1", "stop"))["result"] == {"stopped": True}
            assert not any(each.done() for each in slow)
            await caller.call("echo-1", "release")
            assert all(each["result"] == {"held": True} for each in await asyncio.gather(*slow))


async def test_device_serves_on_after_callers_gave_up():
    async with over("zenoh") as (bare, _):
        async with Caller(client=await open_client(bare_link(bare))) as caller:
            for _ in range(20):
                with pytest.raises(MessagingError):
                    await caller.call("echo-1", "move", {"seconds": 0.3}, wait_s=0.05)
            task = asyncio.ensure_future(caller.call("echo-1", "move", {"seconds": 5}))
            await asyncio.sleep(0.1)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert (await caller.call("echo-1", "getStatus"))["result"]


@pytest.mark.parametrize("transport", ["zenoh", "nats"])
async def test_device_survives_twenty_thousand_random_messages(transport):
    rng = random.Random(7)
    async with over(transport) as (bare, device):
        subject = "device-connect.default.echo-1.cmd"
        client = bare.client
        if transport == "zenoh":
            client = await open_client(bare_link(bare))
        await _flood(client, subject, rng, 2_000)
        await bare.call("echo-1", "getStatus")
        before = device.memory_info().rss
        await _flood(client, subject, rng, FUZZ_MESSAGES)
        answer = await bare.call("echo-1", "getStatus", {"value": "alive"})
        assert answer["result"]["value"] == "alive"
        assert (device.memory_info().rss - before) / 2**20 < GROWTH_MB
        if client is not bare.client:
            await client.close()


def bare_link(bare):
    """A link of ours to where a bare caller is connected."""
    return LinkConfig(connect=tuple(bare.servers))


async def _flood(client, subject, rng, count):
    """Send mutated messages of every malformed kind; four of five as requests, each of which gets a JSON answer."""
    kinds = [payload for payload, _ in MALFORMED.values()] + [
        json.dumps({"jsonrpc": "2.0", "id": 1, "method": "getStatus", "params": {"value": "x"}}).encode()
    ]

    async def ask(payload):
        json.loads(await client.request(subject, payload, timeout=20))

    for _ in range(count // 50):
        requests = []
        for number in range(50):
            payload = bytearray(rng.choice(kinds))
            for _ in range(rng.randrange(3)):
                if payload:
                    payload[rng.randrange(len(payload))] = rng.randrange(256)
            if number % 5:
                requests.append(ask(bytes(payload)))
            else:
                await client.publish(subject, bytes(payload))
        await asyncio.gather(*requests)
