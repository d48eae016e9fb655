"""Many devices in one process: one loop, no collector until one asks, and none in the way of another."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import psutil
import pytest
from device_connect_edge.discovery import PresenceCollector
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect import (
    DuplicateDeviceError,
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.envelope import Envelope, success
from strands_robots.serving.workers import POOL


class Idle:
    """The smallest robot: four methods, never busy."""

    def __init__(self, name: str) -> None:
        self.tool_name_str = name
        self.held: threading.Event | None = None
        self.asked = threading.Event()

    def start_task(self, instruction: str, **options: Any) -> Envelope:
        return success("started")

    def stop_task(self) -> Envelope:
        return success("stopped")

    def get_task_status(self) -> Envelope:
        self.asked.set()
        if self.held is not None:
            self.held.wait(30.0)
        return success("idle", task_status="idle")

    def get_features(self) -> Envelope:
        return success("none")


@pytest.fixture(params=["zenoh", "router", "nats"])
def link(request: pytest.FixtureRequest) -> Iterator[LinkConfig]:
    if request.param == "zenoh":
        yield loopback_config(free_port())
        return
    if request.param == "router":
        with ZenohRouter() as router:
            yield LinkConfig(transport="zenoh", connect=(router.endpoint,))
        return
    with NatsServer() as server:
        yield LinkConfig(transport="nats", connect=(server.url,))


@pytest.fixture
def serve(link: LinkConfig) -> Iterator[Any]:
    runtimes: list[Any] = []

    def start(robot: object, name: str) -> Any:
        runtimes.append(init_device_connect_sync(robot, peer_id=name, link=link, allow_insecure=True))
        return runtimes[-1]

    yield start
    for each in runtimes:
        stop_device_connect(each)


def device_threads() -> int:
    return sum(each.name == "device-connect" for each in threading.enumerate())


def test_robots_of_a_process_share_one_thread(link: LinkConfig, serve: Any) -> None:
    threads: list[int] = []
    for number in range(20):
        serve(Idle(f"arm-{number}"), f"arm-{number}")
        threads.append(psutil.Process().num_threads())
    assert device_threads() == 1
    # The first ones bring the network's threads, the plane's and those that halt.
    assert threads[-1] - threads[9] <= 2
    with FleetClient(link, "tester") as fleet:
        eventually(lambda: len(fleet.peers()) == 20)


def test_no_presence_is_parsed_until_a_device_asks(serve: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[bytes] = []
    original = PresenceCollector._on_presence

    async def counted(self: PresenceCollector, data: bytes, reply: str | None = None) -> None:
        parsed.append(data)
        await original(self, data, reply)

    monkeypatch.setattr(PresenceCollector, "_on_presence", counted)
    runtimes = [serve(Idle(f"arm-{number}"), f"arm-{number}") for number in range(3)]
    # Two bursts of announcements have gone by when the third device is up and a call was answered.
    assert parsed == []
    loop = runtimes[0]._driver.runtime._loop
    found = asyncio.run_coroutine_threadsafe(runtimes[0]._driver.list_devices(), loop).result(10.0)
    assert sorted(each["device_id"] for each in found) == ["arm-1", "arm-2"]
    assert parsed


def test_one_beat_names_the_devices_of_the_process_and_bare_heartbeats_go_on(link: LinkConfig, serve: Any) -> None:
    names = [f"arm-{number}" for number in range(5)]
    for name in names:
        serve(Idle(name), name)
    with FleetClient(link, "tester") as fleet:
        eventually(lambda: all(fleet.beats_every(name) == 1.0 for name in names), what="a beat that names all five")
        first = fleet.last_heartbeat("arm-4")
        assert first is not None
        eventually(lambda: (fleet.last_heartbeat("arm-4") or first) > first, what="the next beat")


def test_device_that_cannot_be_read_is_not_in_the_beat(link: LinkConfig, serve: Any) -> None:
    failing = Idle("arm-2")
    serve(Idle("arm-1"), "arm-1")
    runtime = serve(failing, "arm-2")

    def fail() -> Envelope:
        raise OSError("bus is gone")

    failing.get_task_status = fail  # type: ignore[method-assign]
    eventually(lambda: not runtime.lives(), what="its fault")
    with FleetClient(link, "tester") as fleet:
        eventually(lambda: fleet.beats_every("arm-1") == 1.0, what="a beat")
        assert fleet.beats_every("arm-2") == 5.0


def test_device_waits_for_one_that_comes_later(serve: Any) -> None:
    first = serve(Idle("arm-1"), "arm-1")
    waiting = asyncio.run_coroutine_threadsafe(
        first._driver.wait_for_device(device_id="arm-2", timeout=20.0), first._driver.runtime._loop
    )
    serve(Idle("arm-2"), "arm-2")
    assert waiting.result(20.0)["device_id"] == "arm-2"


def test_blocked_robot_delays_no_other_device(link: LinkConfig, serve: Any) -> None:
    blocked, other = Idle("arm-1"), Idle("arm-2")
    serve(blocked, "arm-1")
    serve(other, "arm-2")
    blocked.held = threading.Event()
    try:
        with FleetClient(link, "tester") as fleet, ThreadPoolExecutor() as callers:
            eventually(lambda: len(fleet.peers()) == 2)
            blocked.asked.clear()
            waiting = callers.submit(fleet.call, "arm-1", "getStatus")
            assert blocked.asked.wait(10.0)
            for _ in range(20):
                assert fleet.call("arm-2", "getStatus")["status"] == "success"
            assert not waiting.done() or waiting.exception() is not None
            blocked.held.set()
    finally:
        blocked.held.set()


def test_robot_that_blocks_while_it_joins_holds_up_no_other(serve: Any) -> None:
    blocked = Idle("arm-1")
    blocked.held = threading.Event()
    with ThreadPoolExecutor() as joining:
        first = joining.submit(serve, blocked, "arm-1")
        try:
            assert blocked.asked.wait(10.0)
            serve(Idle("arm-2"), "arm-2")
            assert not first.done()
        finally:
            blocked.held.set()
        assert first.result(30.0).device_id == "arm-1"


class Blocking(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A driver of somebody else, whose coroutine blocks its loop."""

    device_type = "toy"

    def __init__(self) -> None:
        super().__init__()
        self.began, self.end = threading.Event(), threading.Event()

    @rpc()
    async def block(self) -> dict[str, Any]:
        """Block."""
        self.began.set()
        self.end.wait(30.0)
        return {}


def test_foreign_driver_that_blocks_its_loop_holds_up_no_robot(link: LinkConfig, serve: Any) -> None:
    driver = Blocking()
    serve(driver, "toy-1")
    serve(Idle("arm-1"), "arm-1")
    try:
        with FleetClient(link, "tester") as fleet, ThreadPoolExecutor() as callers:
            eventually(lambda: len(fleet.peers()) == 2)
            callers.submit(fleet.call, "toy-1", "block", timeout=30.0)
            assert driver.began.wait(10.0)
            assert fleet.call("arm-1", "getStatus")["status"] == "success"
            driver.end.set()
    finally:
        driver.end.set()


def test_device_that_fails_to_join_leaves_the_others_alone(link: LinkConfig, serve: Any) -> None:
    serve(Idle("arm-1"), "arm-1")
    with pytest.raises(DuplicateDeviceError):
        init_device_connect_sync(Idle("arm-1"), peer_id="arm-1", link=link, allow_insecure=True)
    with FleetClient(link, "tester") as fleet:
        eventually(lambda: [each.id for each in fleet.peers()] == ["arm-1"])
        assert fleet.call("arm-1", "getStatus")["status"] == "success"


def test_device_that_leaves_disturbs_no_call_of_the_others(link: LinkConfig, serve: Any) -> None:
    # The first device holds the beat and the stops of the process.
    first = init_device_connect_sync(Idle("arm-1"), peer_id="arm-1", link=link, allow_insecure=True)
    slow = Idle("arm-2")
    serve(slow, "arm-2")
    serve(Idle("arm-3"), "arm-3")
    slow.held = threading.Event()
    try:
        with FleetClient(link, "tester") as fleet, ThreadPoolExecutor() as callers:
            eventually(lambda: len(fleet.peers()) == 3)
            slow.asked.clear()
            waiting = callers.submit(fleet.call, "arm-2", "getStatus", timeout=60.0)
            assert slow.asked.wait(20.0)
            stop_device_connect(first)
            left_at = time.monotonic()
            assert fleet.call("arm-3", "getStatus", timeout=20.0)["status"] == "success"
            assert not waiting.done()
            slow.held.set()
            assert waiting.result(60.0)["status"] == "success"
            eventually(lambda: (fleet.last_heartbeat("arm-3") or 0.0) > left_at)
    finally:
        slow.held.set()


@pytest.mark.timeout(600)
def test_rounds_of_joins_and_leaves_leave_nothing(link: LinkConfig) -> None:
    def turn() -> None:
        runtimes = [
            init_device_connect_sync(Idle(f"arm-{each}"), peer_id=f"arm-{each}", link=link, allow_insecure=True)
            for each in range(10)
        ]
        for each in runtimes:
            stop_device_connect(each)

    turn()
    me = psutil.Process()
    eventually(lambda: device_threads() == 0)
    threads, files = me.num_threads(), me.num_fds()
    for _ in range(3):
        turn()
    # Workers end after two idle seconds, Zenoh's pool stays.
    eventually(lambda: device_threads() == 0 and me.num_threads() <= threads + 2 and me.num_fds() <= files + 2)


OURS = ("strands_robots.", "device_connect_edge.", "nats.", "logging.", "threading.")
"""Modules of which a round leaves nothing."""


@pytest.fixture
def no_records() -> Iterator[None]:
    """Make no log records: the test's own log would keep them. Loggers remember their levels until this is called."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("no_records")
def test_rounds_of_joins_and_leaves_leave_no_object(link: LinkConfig) -> None:
    """Every round has devices of other ids, so that what is kept for each id ever seen counts as well."""
    left: list[weakref.ref[Idle]] = []

    def turn(number: int) -> None:
        names = [f"arm-{number}-{each}" for each in range(10)]
        robots = [Idle(name) for name in names]
        left.extend(weakref.ref(each) for each in robots)
        for runtime in [
            init_device_connect_sync(robot, peer_id=name, link=link, allow_insecure=True)
            for name, robot in zip(names, robots, strict=True)
        ]:
            stop_device_connect(runtime)

    def none_left() -> bool:
        gc.collect()
        left[:] = [each for each in left if each() is not None]
        return not left

    def objects() -> Counter[str]:
        # Workers of the last round may still stand in a call of it.
        eventually(lambda: POOL.idle == 0 and none_left(), 60.0, what="the end of the robots of a round")
        kinds = (f"{kind.__module__}.{kind.__qualname__}" for kind in map(type, gc.get_objects()))
        # Of other modules a process of many tests has objects that come and go.
        return Counter(kind for kind in kinds if kind.startswith(OURS))

    turn(0)
    turn(1)
    before = objects()
    for number in range(2, 6):
        turn(number)

    def kept() -> dict[str, int]:
        return {name: more for name, more in (objects() - before).items() if more >= 40}

    # Of anything that is kept for each device there would be forty more. What hangs on a robot is found by the
    # collection after the one that finds the robot.
    with contextlib.suppress(AssertionError):
        eventually(lambda: not kept(), what="the end of what the robots had")
    assert kept() == {}


def test_last_device_ends_the_thread_and_the_next_one_starts_it_again(link: LinkConfig) -> None:
    for _ in range(3):
        runtime = init_device_connect_sync(Idle("arm-1"), peer_id="arm-1", link=link, allow_insecure=True)
        assert device_threads() == 1
        stop_device_connect(runtime)
        assert device_threads() == 0


def test_devices_join_from_several_threads_at_once(serve: Any, link: LinkConfig) -> None:
    with ThreadPoolExecutor(8) as joining:
        list(joining.map(lambda number: serve(Idle(f"arm-{number}"), f"arm-{number}"), range(16)))
    assert device_threads() == 1
    with FleetClient(link, "tester") as fleet:
        eventually(lambda: len(fleet.peers()) == 16)
