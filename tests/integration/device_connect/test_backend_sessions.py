"""Users of a process share one session and leave nothing open; processes of a machine meet at one port."""

import json
import os
import signal
import subprocess
import sys
import threading

import psutil
import pytest
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from fixtures.waiting import accepts, eventually, free_port, until

from strands_robots.device_connect.backends import LinkConfig, loopback_config, open_client
from strands_robots.device_connect.backends import zenoh as zenoh_backend

FLEET = """
import asyncio, json, os, sys, threading
import psutil
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDriver
from strands_robots.device_connect._compat import Runtime
from strands_robots.device_connect.backends import loopback_config, open_client

COUNT, PORT = int(sys.argv[1]), int(sys.argv[2])
me = psutil.Process()
link = loopback_config(PORT)
before = me.memory_info().rss

class Host(threading.Thread):
    def __init__(self, number):
        super().__init__(daemon=True)
        self.name = f"arm-{number}"
        self.up = threading.Event()

    def run(self):
        asyncio.run(self.main())

    async def main(self):
        self.loop, self.quit = asyncio.get_running_loop(), asyncio.Event()
        runtime = Runtime(driver=EchoDriver(), device_id=self.name, link=link, allow_insecure=True)
        task = asyncio.create_task(runtime.run())
        await runtime.wait_ready(60)
        self.up.set()
        await self.quit.wait()
        await runtime.shutdown()

hosts = [Host(number) for number in range(COUNT)]
for host in hosts:
    host.start()
for host in hosts:
    assert host.up.wait(60), host.name

async def ask_all():
    async with Caller(client=await open_client(link)) as caller:
        names = [host.name for host in hosts]
        await caller.sees(*names, within=40)
        for name in names:
            assert (await caller.call(name, "getStatus", {"value": name}))["result"]["value"] == name
    async with Caller(servers=(f"tcp/127.0.0.1:{PORT}",)) as bare:
        await bare.sees(*names, within=40)

asyncio.run(ask_all())
# Each host has a thread of its own here; those are the test's, not the backend's.
print(json.dumps({
    "mb": (me.memory_info().rss - before) / 2**20,
    "threads": me.num_threads() - COUNT,
    "descriptors": me.num_fds(),
}))
for host in hosts:
    host.loop.call_soon_threadsafe(host.quit.set)
for host in hosts:
    host.join(60)
    assert not host.is_alive()
"""

CYCLES = """
import asyncio, json, sys
import psutil
from fixtures.echo_device import EchoDriver
from fixtures.waiting import eventually
from strands_robots.device_connect._compat import Runtime
from strands_robots.device_connect.backends import LinkConfig, zenoh as zenoh_backend

link = LinkConfig(**json.loads(sys.argv[1], object_hook=lambda d: {k: tuple(v) if isinstance(v, list) else v
                                                                   for k, v in d.items()}))
me = psutil.Process()

async def once():
    runtime = Runtime(driver=EchoDriver(), device_id="arm-1", link=link, allow_insecure=True)
    task = asyncio.create_task(runtime.run())
    await runtime.wait_ready(60)
    await runtime.shutdown()
    assert task.done()

def cycle():
    asyncio.run(once())
    assert not zenoh_backend.open_links()

def used():
    return me.num_threads(), me.num_fds()

for _ in range(3):
    cycle()
settled = used()
for _ in range(20):
    cycle()
# Zenoh keeps a pool of native threads, which comes and goes by one or two whatever the cycles.
eventually(lambda: all(now <= then + 2 for now, then in zip(used(), settled)), what=f"back to {settled}: {used()}")
print("nothing grew")
"""

FORGETFUL = """
import asyncio
from fixtures.echo_device import EchoDriver
from strands_robots.device_connect._compat import Runtime
from strands_robots.device_connect.backends import LinkConfig

async def main():
    link = LinkConfig(mode="peer", listen=("tcp/127.0.0.1:0",), multicast=False)
    runtime = Runtime(driver=EchoDriver(), device_id="arm-1", link=link, allow_insecure=True)
    runtime.kept = asyncio.create_task(runtime.run())
    await runtime.wait_ready(60)

loop = asyncio.new_event_loop()
loop.run_until_complete(main())
print("leaves without a word", flush=True)
"""


def run(program, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_thirty_two_runtimes_on_their_own_loops_share_one_session():
    used = json.loads(run(FLEET, "32", str(free_port())).splitlines()[-1])
    assert used["mb"] <= 120
    assert used["threads"] <= 80
    # A loop has three descriptors of its own, which are the host's.
    assert used["descriptors"] - 3 * 32 <= 104


@pytest.mark.parametrize("mode", ["peer", "meeting"])
def test_twenty_cycles_leave_no_thread_and_no_descriptor(mode):
    link = {"mode": "peer", "multicast": False}
    link |= {"listen": ["tcp/127.0.0.1:0"]} if mode == "peer" else {"meet_port": free_port()}
    assert "nothing grew" in run(CYCLES, json.dumps(link))


def test_process_that_forgets_to_shut_down_still_ends():
    assert "leaves without a word" in run(FORGETFUL)


def test_start_that_was_given_up_never_comes_online():
    absent = free_port()
    program = CYCLES.replace("await runtime.wait_ready(60)", "await give_up(runtime)").replace(
        "def cycle",
        "async def give_up(runtime):\n"
        "    try:\n"
        "        await runtime.wait_ready(0.15)\n"
        "    except TimeoutError:\n"
        "        return\n"
        "    raise AssertionError('came up')\n\n"
        "def cycle",
    )
    link = {"connect": [f"tcp/127.0.0.1:{absent}"], "connect_timeout_s": 0.3}
    program = program.replace("range(20)", "range(8)").replace(
        "    assert not zenoh_backend.open_links()\n",
        "    eventually(lambda: not zenoh_backend.open_links())\n",
    )
    assert "nothing grew" in run(program, json.dumps(link))


def test_links_that_differ_are_unequal():
    assert LinkConfig(tenant="red") != LinkConfig(tenant="blue")
    assert hash(LinkConfig()) == hash(LinkConfig())


AGENT = """
import sys
import threading
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


def test_interpreter_keeps_its_state_of_a_zenoh_thread_between_callbacks() -> None:
    where, seen = f"tcp/127.0.0.1:{free_port()}", []
    of_thread = threading.local()

    def on_sample(_sample: object) -> None:
        of_thread.calls = getattr(of_thread, "calls", 0) + 1
        seen.append(of_thread.calls)

    listening = zenoh_backend.acquire(LinkConfig(mode="peer", listen=(where,), multicast=False))
    sending = zenoh_backend.acquire(LinkConfig(mode="peer", connect=(where,), multicast=False))
    try:
        listening.subscribe("t/ticks", on_sample)

        def threads_remember() -> bool:
            sending.session.put("t/ticks", b"tick")
            return max(seen, default=0) >= 3

        eventually(threads_remember, what="one thread that counts its callbacks")
    finally:
        zenoh_backend.release(sending)
        zenoh_backend.release(listening)
