"""Our Zenoh backend between peers and through a router, with the bare framework at the other end."""

import contextlib
import json
import os
import subprocess
import sys

import pytest
import zenoh
from device_connect_edge.messaging.exceptions import MessagingError
from fixtures.bare_caller import Caller
from fixtures.certificates import Authority
from fixtures.echo_device import EchoDevice
from fixtures.waiting import eventually, eventually_async, free_port, until
from fixtures.zenoh_router import ZenohRouter, only_own_subjects

from strands_robots.device_connect.backends import LinkConfig, backend_for, loopback_config, open_client


@pytest.fixture
def router():
    with ZenohRouter() as running:
        yield running


def certified(identity, **fields):
    return LinkConfig(ca=str(identity.ca), cert=str(identity.cert), key=str(identity.key), **fields)


def stock_tls(identity):
    return {"ca_file": str(identity.ca), "cert_file": str(identity.cert), "key_file": str(identity.key)}


async def test_peers_with_endpoints_and_no_multicast_find_and_call_each_other():
    port = free_port()
    hub = LinkConfig(mode="peer", listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    other = LinkConfig(mode="peer", connect=(f"tcp/127.0.0.1:{port}",), multicast=False)
    with EchoDevice("arm-1", hub), EchoDevice("arm-2", other):
        async with Caller(client=await open_client(other)) as caller:
            await caller.sees("arm-1", "arm-2")
            for name in ("arm-1", "arm-2"):
                assert (await caller.call(name, "getStatus", {"value": name}))["result"]["value"] == name


def test_of_two_peers_that_meet_by_gossip_only_the_unreachable_one_dials():
    meeting, listening = f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    links = (
        LinkConfig(mode="peer", listen=(meeting,), multicast=False),
        LinkConfig(mode="peer", listen=(listening,), connect=(meeting,), multicast=False),
        LinkConfig(mode="peer", connect=(meeting,), multicast=False),
    )
    with contextlib.ExitStack() as stack:
        _, reached, dialling = [
            stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(link.zenoh())))) for link in links
        ]
        eventually(lambda: len(dialling.info.peers_zid()) == len(reached.info.peers_zid()) == 2)
        (one,) = [link for link in dialling.info.links() if str(link.zid) == str(reached.zid())]
        assert str(one.dst) == listening


async def test_client_reports_the_loss_and_the_return_of_a_router(router):
    reported = []

    async def lost():
        reported.append("lost")

    async def back():
        reported.append("back")

    client = backend_for(LinkConfig(connect=(router.endpoint,)))
    await client.connect(servers=[], disconnect_cb=lost, reconnect_cb=back)
    try:
        router.kill()
        await until(lambda: reported == ["lost"])
        router.start()
        await until(lambda: reported == ["lost", "back"])
    finally:
        await client.close()


async def test_access_rules_admit_a_device_as_itself_alone(tmp_path):
    authority = Authority(tmp_path)
    rules = only_own_subjects("default", ("robot-a", "robot-b"), "operator")
    with ZenohRouter(authority.issue("router"), rules) as router:
        link = {name: certified(authority.issue(name), connect=(router.endpoint,)) for name in ("robot-a", "robot-b")}
        with EchoDevice("robot-a", link["robot-a"]):
            bare = Caller(servers=(router.endpoint,), tls=stock_tls(authority.issue("operator")))
            async with bare, Caller(client=await open_client(link["robot-b"])) as other:
                await bare.sees("robot-a")
                assert (await bare.call("robot-a", "getStatus"))["result"]
                received = await bare.collect("robot-a", "emergencyStop")
                genuine = await bare.collect("robot-b", "emergencyStop")
                stop = json.dumps({"jsonrpc": "2.0", "method": "emergencyStop", "params": {}}).encode()

                async def own_is_heard() -> bool:
                    # A new subscription takes a moment to reach all peers.
                    for name in ("robot-a", "robot-b"):
                        await other.client.publish(f"device-connect.default.{name}.event.emergencyStop", stop)
                    return len(genuine) >= 3

                await eventually_async(own_is_heard)
                with pytest.raises(MessagingError):
                    await other.call("robot-a", "getStatus", wait_s=0.5)
                assert received == []


async def test_peers_over_mutual_tls_admit_only_their_own_authority(tmp_path):
    port = free_port()
    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs")
    endpoint = f"tls/127.0.0.1:{port}"
    hub = certified(ours.issue("arm-1"), mode="peer", listen=(endpoint,), multicast=False)
    other = certified(ours.issue("arm-2"), mode="peer", connect=(endpoint,), multicast=False)
    assert hub.authenticated
    with EchoDevice("arm-1", hub), EchoDevice("arm-2", other):
        agent = certified(ours.issue("agent"), mode="peer", connect=(endpoint,), multicast=False)
        async with Caller(client=await open_client(agent)) as caller:
            await caller.sees("arm-1", "arm-2")
            assert (await caller.call("arm-2", "getStatus"))["result"]
        async with Caller(servers=(endpoint,), tls=stock_tls(ours.issue("bare"))) as bare:
            await bare.sees("arm-1", "arm-2")
            assert (await bare.call("arm-1", "getStatus"))["result"]
        intruders = (
            certified(theirs.issue("mallory"), mode="peer", connect=(endpoint,), multicast=False),
            LinkConfig(mode="peer", connect=(f"tcp/127.0.0.1:{port}",), multicast=False),
        )
        for link in intruders:
            async with Caller(client=await open_client(link)) as caller:
                with pytest.raises(MessagingError, match="no device answers"):
                    await caller.call("arm-1", "getStatus", wait_s=20)


async def test_two_tenants_do_not_see_each_other():
    port = free_port()
    with (
        EchoDevice("arm-1", loopback_config(port, tenant="red"), tenant="red"),
        EchoDevice("arm-2", loopback_config(port, tenant="blue"), tenant="blue"),
    ):
        red = Caller(client=await open_client(loopback_config(port, tenant="red")), tenant="red")
        blue = Caller(client=await open_client(loopback_config(port, tenant="blue")), tenant="blue")
        async with red, blue:
            await red.sees("arm-1")
            await blue.sees("arm-2")
            for caller, stranger in ((red, "arm-2"), (blue, "arm-1")):
                with pytest.raises(AssertionError):
                    await caller.sees(stranger, within=0.5)
                with pytest.raises(MessagingError):
                    await caller.call(stranger, "getStatus", wait_s=1)


MULTICAST = """
import asyncio
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from strands_robots.device_connect.backends import LinkConfig

async def main():
    with EchoDevice("ours", LinkConfig()), EchoDevice("bare"):
        async with Caller() as bare:
            await bare.sees("ours", "bare")
            assert (await bare.call("ours", "getStatus"))["result"]
            assert (await bare.call("bare", "getStatus"))["result"]

asyncio.run(main())
print("found by multicast")
"""


def test_peers_find_each_other_by_multicast_with_nothing_configured():
    """In a network namespace of its own: the machine's loopback mostly lacks the MULTICAST flag."""
    prepare = "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo"
    if subprocess.run(["unshare", "-n", "true"], capture_output=True, check=False).returncode:
        pytest.skip("a network namespace cannot be made here (needs root or user namespaces)")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ZENOH_", "MESSAGING_"))}
    done = subprocess.run(
        ["unshare", "-n", "sh", "-c", f'{prepare} && exec "$0" -c "$1"', sys.executable, MULTICAST],
        capture_output=True,
        text=True,
        timeout=110,
        env=environment,
        check=False,
    )
    assert "found by multicast" in done.stdout, done.stderr[-3000:]
