"""Discovery on a real NATS server, with a stand-in for the framework's registry service."""

import json
from contextlib import asynccontextmanager

import pytest
from fixtures.echo_device import EchoDevice
from fixtures.nats_server import NatsServer

from strands_robots.device_connect import discovery as discovery_module
from strands_robots.device_connect.backends import LinkConfig, open_client
from strands_robots.device_connect.discovery import Discovery

REGISTRY = "device-connect.default.discovery"


@pytest.fixture(autouse=True)
def quick_heartbeats(monkeypatch):
    """Here heartbeats are sent when the test says so, and nothing is gained by waiting for the next one."""
    monkeypatch.setattr(discovery_module, "HEARTBEATS_S", 0.5)


@pytest.fixture
def link():
    with NatsServer() as server:
        yield LinkConfig("nats", connect=(server.url,))


@asynccontextmanager
async def discovery_on(link):
    client = await open_client(link)
    discovery = Discovery(client)
    await discovery.start()
    yield discovery
    await client.close()


@asynccontextmanager
async def registry(link, answer):
    """A registry whose answers are ``answer(params)``, or None for none; yields what it was asked."""
    client, asked = await open_client(link), []

    async def on_request(data, reply):
        request = json.loads(data)
        asked.append(request["params"])
        said = answer(request["params"])
        if said is not None:
            await client.publish(reply, json.dumps({"jsonrpc": "2.0", "id": request["id"], **said}).encode())

    await client.subscribe(REGISTRY, on_request)
    await client.flush()
    yield asked
    await client.close()


@asynccontextmanager
async def heartbeating(link, name):
    """A device in registry mode: silent but for its heartbeats, and ready to describe itself."""
    client = await open_client(link)

    async def on_command(data, reply):
        result = {"device_id": name, "capabilities": {"functions": [{"name": "stop"}]}}
        await client.publish(reply, json.dumps({"id": json.loads(data)["id"], "result": result}).encode())

    await client.subscribe(f"device-connect.default.{name}.cmd", on_command)
    await client.flush()
    yield lambda: client.publish(f"device-connect.default.{name}.heartbeat", b'{"device_id": "%s"}' % name.encode())
    await client.close()


def page_of(names):
    """A registry of these devices that answers in pages, as the framework's does."""

    def answer(params):
        offset, limit = params["offset"], params["limit"]
        following = offset + limit if offset + limit < len(names) else None
        rows = [{"device_id": name} for name in names[offset : offset + limit]]
        return {"result": {"devices": rows, "next_offset": following}}

    return answer


async def test_devices_that_only_the_registry_lists_are_found_over_all_its_pages(link):
    names = [f"arm-{number:03}" for number in range(250)]
    found = []
    async with registry(link, page_of(names)) as asked, discovery_on(link) as discovery:
        peers = await discovery.collect(5.0, lambda peer: found.append(peer.id))
        assert [peer.id for peer in peers] == names
        assert sorted(found) == names
        assert [params["offset"] for params in asked] == [0, 100, 200]
        assert not discovery.stale


async def test_registry_of_long_descriptions_is_asked_for_fewer_at_a_time(link):
    names = [f"arm-{number:03}" for number in range(60)]
    events = [{"name": f"event_{number}"} for number in range(500)]

    def answer(params):
        result = page_of(names)(params)
        for row in result["result"]["devices"]:
            row["capabilities"] = {"events": events}
        return result

    async with registry(link, answer) as asked, discovery_on(link) as discovery:
        peers = await discovery.collect(5.0)
        assert [peer.id for peer in peers] == names
        assert [params["limit"] for params in asked] == [100, 25, *[6] * 10]
        assert not discovery.stale


async def test_device_that_answers_a_probe_is_described_by_its_own_word(link):
    with EchoDevice("echo-1", link):
        async with registry(link, page_of(["arm-1", "echo-1"])), discovery_on(link) as discovery:
            found = {peer.id: peer for peer in await discovery.collect(5.0)}
    assert set(found) == {"arm-1", "echo-1"}
    assert found["echo-1"].type == "echo"


async def test_network_without_a_registry_is_not_called_stale(link):
    with EchoDevice("echo-1", link):
        async with discovery_on(link) as discovery:
            assert [peer.id for peer in await discovery.collect(20.0)] == ["echo-1"]
            assert not discovery.stale


@pytest.mark.parametrize("answer", [lambda params: {"error": {"code": -32000, "message": "etcd is gone"}}, None])
async def test_device_is_found_by_its_heartbeat_while_the_registry_gives_no_list(link, answer, monkeypatch):
    monkeypatch.setenv("DEVICE_CONNECT_DISCOVERY_MODE", "registry")
    async with registry(link, answer or (lambda params: None)), discovery_on(link) as discovery:
        async with heartbeating(link, "arm-1") as beat:
            await beat()
            (peer,) = await discovery.collect(0.5)
    assert (peer.id, peer.stop_verb) == ("arm-1", "stop")
    assert "registry gives no list" in discovery.stale


async def test_list_of_a_registry_that_is_gone_counts_on_and_is_called_stale(link):
    async with discovery_on(link) as discovery:
        async with registry(link, page_of(["arm-1"])):
            await discovery.collect(5.0)
            assert not discovery.stale
        assert [peer.id for peer in await discovery.collect(0.5)] == ["arm-1"]
        assert "what it listed" in discovery.stale
        async with registry(link, page_of(["arm-2"])):
            assert [peer.id for peer in await discovery.collect(5.0)] == ["arm-2"]
            assert not discovery.stale


@pytest.mark.parametrize(
    "said",
    [
        {"result": []},
        {"result": {"devices": "many"}},
        {"result": {"devices": [1, {}, {"device_id": "arm-1", "identity": 5}], "next_offset": 0}},
        {"error": "no"},
    ],
)
async def test_registry_that_talks_nonsense_ends_no_collection(link, said):
    with EchoDevice("echo-1", link):
        async with registry(link, lambda params: said), discovery_on(link) as discovery:
            assert "echo-1" in {peer.id for peer in await discovery.collect(5.0)}
