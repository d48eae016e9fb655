"""Processes of one machine meet without configuration, without multicast, and without a central process."""

import os
import signal
import subprocess
import sys

import psutil
import pytest
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from fixtures.waiting import accepts, eventually, free_port, until

from strands_robots.device_connect.backends import loopback_config, open_client

AGENT = """
import sys
from device_connect_agent_tools import connect, disconnect, discover_devices, invoke_device
from fixtures.waiting import eventually
connect()
eventually(lambda: {each["device_id"] for each in discover_devices()} >= {"arm-1", "arm-2", "arm-3"})
for name in ("arm-1", "arm-2", "arm-3"):
    answer = invoke_device(name, "getStatus", {"value": name})
    assert answer["result"]["value"] == name, answer
disconnect()
print("agent saw all")
"""


@pytest.fixture
def port() -> int:
    return free_port()


def test_bare_agent_finds_and_calls_every_process_at_the_meeting_port(port):
    link = loopback_config(port)
    with EchoDevice("arm-1", link), EchoDevice("arm-2", link), EchoDevice("arm-3", link):
        environment = {
            **os.environ,
            "ZENOH_CONNECT": f"tcp/127.0.0.1:{port}",
            "DEVICE_CONNECT_DISCOVERY_MODE": "d2d",
        }
        done = subprocess.run(
            [sys.executable, "-c", AGENT], env=environment, capture_output=True, text=True, timeout=90, check=False
        )
    assert "agent saw all" in done.stdout, done.stderr[-3000:]


async def test_another_process_takes_over_the_meeting_port_of_a_killed_one(port):
    link = loopback_config(port)
    with EchoDevice("arm-1", link) as holder, EchoDevice("arm-2", link), EchoDevice("arm-3", link):
        async with Caller(client=await open_client(link)) as caller:
            await caller.sees("arm-1", "arm-2", "arm-3")
            holder.kill()
            eventually(lambda: accepts(port), what="a listener at the meeting port again")
            assert (await caller.call("arm-2", "getStatus"))["result"]
            with EchoDevice("arm-4", link):
                await caller.sees("arm-2", "arm-3", "arm-4")
                async with Caller(servers=(f"tcp/127.0.0.1:{port}",)) as bare:
                    await bare.sees("arm-2", "arm-3", "arm-4")
                    for name in ("arm-2", "arm-3", "arm-4"):
                        assert (await bare.call(name, "getStatus"))["result"]


async def test_nothing_of_a_loopback_link_listens_beyond_this_machine(port):
    with EchoDevice("arm-1", loopback_config(port)) as device:
        listeners = _listeners_of(device.pid)
        assert port in {each[1] for each in listeners}
        assert {each[0] for each in listeners} == {"127.0.0.1"}


async def test_stopped_peer_does_not_hold_up_the_others(port):
    link = loopback_config(port)
    with EchoDevice("arm-1", link), EchoDevice("arm-2", link) as stopped:
        async with Caller(client=await open_client(link)) as caller:
            await caller.sees("arm-1", "arm-2")
            received = await caller.collect("arm-1", "tick")
            stopped.send_signal(signal.SIGSTOP)
            try:
                for sent in range(200, 2001, 200):
                    # No more at once than a link holds for a peer that gets no turn to take them.
                    await caller.call("arm-1", "burst", {"count": 200, "hz": 4000, "size": 4000})
                    for _ in range(2):
                        assert (await caller.call("arm-1", "getStatus", wait_s=5.0))["result"]
                    await until(lambda sent=sent: len(received) == sent, what="every event at a peer that runs")
            finally:
                stopped.send_signal(signal.SIGCONT)


def _listeners_of(pid):
    """(address, port) of every listening TCP socket of a process, IPv4 and IPv6, from /proc."""
    return {
        (each.laddr.ip, each.laddr.port)
        for each in psutil.Process(pid).net_connections("tcp")
        if each.status == psutil.CONN_LISTEN
    }
