"""Our NATS backend against the real server, with the bare framework at the other end."""

import asyncio
import json

import pytest
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.bare_caller import Caller
from fixtures.certificates import Authority
from fixtures.echo_device import EchoDevice
from fixtures.nats_credentials import NatsAccounts, credentials_file
from fixtures.nats_server import NatsServer
from fixtures.waiting import until

from strands_robots.device_connect.backends import LinkConfig, link_from_environment, open_client


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
