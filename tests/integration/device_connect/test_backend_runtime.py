"""The framework's runtime on our backend: readiness, failures of the start, and the end."""

import asyncio
import json
import threading

import pytest
from device_connect_edge import DeviceRuntime
from device_connect_edge.messaging.exceptions import AuthenticationError
from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDriver
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port, until
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect._compat import Runtime
from strands_robots.device_connect.backends import LinkConfig, loopback_config, open_client, register
from strands_robots.device_connect.backends import zenoh as zenoh_backend


@pytest.fixture
def link():
    return loopback_config(free_port())


def start(link, driver=None, allow_insecure=True):
    """Start a runtime; return it and its task."""
    runtime = Runtime(driver=driver or EchoDriver(), device_id="arm-1", link=link, allow_insecure=allow_insecure)
    return runtime, asyncio.create_task(runtime.run())


@pytest.fixture
async def runtime(link):
    made, task = start(link)
    await made.wait_ready(30)
    yield made
    await made.shutdown()
    assert task.done()
    assert not zenoh_backend.open_links()


async def test_ready_device_is_callable_and_discoverable_at_once(runtime, link):
    async with Caller(client=await open_client(link)) as caller:
        assert (await caller.call("arm-1", "getStatus", {"value": "x"}))["result"]["value"] == "x"
        await caller.sees("arm-1")


async def test_presence_carries_the_present_status(runtime, link):
    async with Caller(client=await open_client(link)) as caller:
        received = []

        async def on_presence(data, _reply):
            received.append(json.loads(data)["status"].get("availability"))

        await caller.client.subscribe("device-connect.default.arm-1.presence", on_presence, subscribe_only=True)
        runtime.status["availability"] = "busy"
        await until(lambda: "busy" in received)


async def test_any_thread_may_emit(runtime, link):
    async with Caller(client=await open_client(link)) as caller:
        received = await caller.collect("arm-1", "tick")
        thread = threading.Thread(target=lambda: [runtime.emit_from_thread("tick", {"n": n}) for n in range(100)])
        thread.start()
        await until(lambda: len(received) == 100)
        thread.join()
        assert [each["n"] for each in received] == list(range(100))


async def test_event_that_json_cannot_carry_is_dropped_and_the_next_one_flows(runtime, link, caplog):
    async with Caller(client=await open_client(link)) as caller:
        received = await caller.collect("arm-1", "tick")
        await runtime.enqueue_event("tick", {"n": float("nan")})
        await runtime.enqueue_event("tick", {"n": 2})
        await until(lambda: received)
        assert received == [{"n": 2}]
        assert "NaN" in caplog.text


async def test_driver_that_cannot_connect_is_reported_and_leaves_nothing_open(link):
    class Broken(EchoDriver):
        async def connect(self):
            raise OSError("no motor answers")

    runtime, task = start(link, Broken())
    with pytest.raises(OSError, match="no motor answers"):
        await runtime.wait_ready(30)
    await asyncio.gather(task, return_exceptions=True)
    assert not zenoh_backend.open_links()


async def test_start_that_waits_for_a_router_can_be_ended():
    absent = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port()}",), connect_timeout_s=0.3)
    runtime, task = start(absent)
    with pytest.raises(TimeoutError):
        await runtime.wait_ready(0.2)
    await runtime.shutdown()
    assert task.done()
    await until(lambda: not zenoh_backend.open_links())


async def test_router_that_comes_late_is_found_soon():
    absent = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port()}",), connect_timeout_s=0.2)
    runtime, task = start(absent)
    with pytest.raises(TimeoutError):
        await runtime.wait_ready(1.5)
    with ZenohRouter(port=int(absent.connect[0].rpartition(":")[2])):
        await runtime.wait_ready(30)
        async with Caller(client=await open_client(absent)) as caller:
            await caller.sees("arm-1")
            assert (await caller.call("arm-1", "getStatus"))["result"]
        await runtime.shutdown()
    assert task.done()


async def test_credentials_that_a_server_refuses_end_the_start_with_its_reason():
    with NatsServer(accounts="authorization { token: right }") as server:
        link = LinkConfig("nats", connect=(server.url.replace("//", "//wrong@"),), connect_timeout_s=1)
        runtime, task = start(link)
        with pytest.raises(AuthenticationError):
            await runtime.wait_ready(30)
    await asyncio.gather(task, return_exceptions=True)


async def test_unauthenticated_link_needs_the_opt_in(link):
    runtime, task = start(link, allow_insecure=False)
    with pytest.raises(ValueError, match="allow_insecure"):
        await runtime.wait_ready(30)
    await asyncio.gather(task, return_exceptions=True)
    assert not zenoh_backend.open_links()


async def test_certificates_in_the_environment_do_not_change_an_explicit_link(link, monkeypatch):
    monkeypatch.setenv("MESSAGING_TLS_CA_FILE", "/nowhere/ca.pem")
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:1")
    runtime, task = start(link)
    await runtime.wait_ready(30)
    assert runtime.messaging.link == link
    await runtime.shutdown()
    assert task.done()


async def test_stock_runtime_may_use_the_backend_by_name(link):
    runtime = DeviceRuntime(
        driver=EchoDriver(), device_id="arm-1", messaging_backend=register(link), allow_insecure=True
    )
    task = asyncio.create_task(runtime.run())
    try:
        async with Caller(client=await open_client(link)) as caller:
            await caller.sees("arm-1")
            assert (await caller.call("arm-1", "getStatus"))["result"]
    finally:
        await runtime.stop()
        await asyncio.gather(task, return_exceptions=True)
    assert not zenoh_backend.open_links()


async def test_departure_is_announced(link):
    first, task = start(link)
    await first.wait_ready(30)
    async with Caller(client=await open_client(link)) as caller:
        farewells = []

        async def on_presence(data, _reply):
            if json.loads(data).get("departing"):
                farewells.append(True)

        await caller.client.subscribe("device-connect.default.arm-1.presence", on_presence, subscribe_only=True)
        await first.shutdown()
        await until(lambda: farewells)
    assert task.done()
