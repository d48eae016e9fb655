"""Our NATS backend against the real server, with the bare framework at the other end."""

import asyncio
import json

import psutil
import pytest
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.bare_caller import Caller
from fixtures.certificates import Authority
from fixtures.echo_device import EchoDevice
from fixtures.lying_nats import LyingNatsServer
from fixtures.nats_credentials import NatsAccounts, credentials_file
from fixtures.nats_server import NatsServer
from fixtures.waiting import until

from strands_robots.device_connect.backends import LinkConfig, backend_for, link_from_environment, open_client


def link_to(server, **fields):
    return LinkConfig(transport="nats", connect=(server.url,), **fields)


@pytest.fixture
def server():
    with NatsServer() as running:
        yield running


async def test_quick_call_is_answered_while_a_slow_one_runs_on_nats(server):
    with EchoDevice("arm-1", link_to(server)):
        async with Caller("nats", servers=(server.url,)) as bare:
            await bare.sees("arm-1")
            slow = asyncio.ensure_future(bare.call("arm-1", "hold", wait_s=60))
            await bare.wait_held("arm-1", 1)
            assert (await bare.call("arm-1", "stop"))["result"] == {"stopped": True}
            assert not slow.done()
            await bare.call("arm-1", "release")
            assert (await slow)["result"] == {"held": True}


async def test_event_the_server_would_refuse_is_dropped_and_the_next_ones_flow():
    with NatsServer(max_payload=20_000) as server, EchoDevice("arm-1", link_to(server)):
        async with Caller("nats", servers=(server.url,)) as bare:
            await bare.sees("arm-1")
            received = await bare.collect("arm-1", "tick")
            await bare.call("arm-1", "burst", {"count": 1, "size": 30_000})
            await bare.call("arm-1", "burst", {"count": 3, "hz": 100})
            await until(lambda: len(received) == 3)


async def test_result_the_server_would_refuse_is_answered_with_the_limit():
    with NatsServer(max_payload=20_000) as server, EchoDevice("arm-1", link_to(server)):
        async with Caller("nats", servers=(server.url,)) as bare:
            await bare.sees("arm-1")
            answer = await bare.call("arm-1", "large", {"size": 30_000})
    assert answer["error"]["code"] == -32603
    assert "20000" in answer["error"]["message"]


async def test_jwt_credentials_over_tls_admit_a_device_as_itself_alone(tmp_path, monkeypatch):
    authority, accounts = Authority(tmp_path), NatsAccounts()
    identity = authority.issue("nats")
    with NatsServer(identity, accounts.server_lines) as server:
        folder = tmp_path / "credentials"
        folder.mkdir()
        file = credentials_file(folder, "robot-a", accounts.device("robot-a"), url=server.url, identity=identity)
        monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", str(file))
        link = link_from_environment()
        monkeypatch.delenv("MESSAGING_CREDENTIALS_FILE")
        assert link.transport == "nats"
        assert link.authenticated

        operator = accounts.operator()
        credentials = {"jwt": operator.jwt, "nkey_seed": operator.nkey_seed}
        tls = {"ca_file": str(identity.ca)}
        with EchoDevice("robot-a", link):
            async with Caller("nats", servers=(server.url,), tls=tls, credentials=credentials) as bare:
                await bare.sees("robot-a")
                assert (await bare.call("robot-a", "getStatus"))["result"]
                received = await bare.collect("robot-a", "emergencyStop")

                intruder = accounts.device("robot-b")
                client = await open_client(
                    link_to(server, jwt=intruder.jwt, nkey_seed=intruder.nkey_seed, ca=str(identity.ca))
                )
                async with Caller(client=client) as other:
                    spoofed = json.dumps({"jsonrpc": "2.0", "method": "emergencyStop", "params": {}}).encode()
                    await other.client.publish("device-connect.default.robot-a.event.emergencyStop", spoofed)
                    with pytest.raises(MessagingError):
                        await other.call("robot-a", "getStatus", wait_s=0.5)
                assert received == []

        with pytest.raises(MessagingError):
            await open_client(link_to(server, ca=str(identity.ca), connect_timeout_s=1.0))


async def test_server_of_another_authority_is_refused(tmp_path):
    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs")
    with NatsServer(theirs.issue("nats")) as server:
        with pytest.raises(MessagingError, match="no NATS connection"):
            await open_client(link_to(server, ca=str(ours.ca), connect_timeout_s=2.0))


def connections_to(server):
    """Return the number of connections of this process to the server."""
    mine = psutil.Process().net_connections("tcp")
    return sum(bool(each.raddr) and each.raddr.port == server.port for each in mine)


async def test_clients_of_one_link_share_one_connection(server):
    clients = [await open_client(link_to(server)) for _ in range(10)]
    try:
        assert connections_to(server) == 1
        await clients[0].close()
        received = [[] for _ in clients]

        async def subscribed(number):
            async def keep(data, _reply):
                received[number].append(data)

            await clients[number].subscribe("beat", keep, subscribe_only=True)

        for number in range(1, 10):
            await subscribed(number)
        await clients[1].publish("beat", b"1")
        await until(lambda: all(each == [b"1"] for each in received[1:]))
        await clients[2].close()
        await clients[1].publish("beat", b"2")
        await until(lambda: all(each == [b"1", b"2"] for each in (received[1], *received[3:])))
        assert received[2] == [b"1"]
    finally:
        for each in clients:
            await each.close()
    await until(lambda: connections_to(server) == 0)


async def test_clients_that_wait_for_a_server_share_its_refusal_and_try_anew():
    server = NatsServer()
    link = link_to(server, connect_timeout_s=1.0)
    refused = await asyncio.gather(*(open_client(link) for _ in range(5)), return_exceptions=True)
    assert all(isinstance(each, MessagingError) for each in refused)
    with server:
        client = await open_client(link)
        assert client.is_connected
        await client.close()


async def test_every_client_of_a_shared_connection_is_told_of_its_loss_and_return(server):
    told = [[], []]
    clients = [backend_for(link_to(server)) for _ in told]
    for client, events in zip(clients, told, strict=True):

        async def lost(events=events):
            events.append("lost")

        async def back(events=events):
            events.append("back")

        await client.connect([], reconnect_cb=back, disconnect_cb=lost)
    server.kill()
    await until(lambda: told == [["lost"], ["lost"]])
    server.start()
    await until(lambda: told == [["lost", "back"], ["lost", "back"]])
    for client in clients:
        await client.close()


async def test_flush_returns_after_the_server_has_the_subscriptions():
    async def ignore(data, reply):
        pass

    with LyingNatsServer() as server:
        client = await open_client(LinkConfig("nats", connect=(f"nats://127.0.0.1:{server.port}",)))
        await client.subscribe("arm-1.stop", ignore)
        await client.flush()
        sent = bytes(server.received)
        await client.close()
    assert sent.index(b"SUB arm-1.stop") < sent.rindex(b"PING")
