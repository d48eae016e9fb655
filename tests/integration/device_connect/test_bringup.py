"""Bring-up and end of a device: discovered, refused, cancelled, and nothing left open."""

from __future__ import annotations

import asyncio
import logging
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from enum import Enum
from logging.handlers import QueueHandler
from pathlib import Path
from typing import Any, ClassVar

import psutil
import pytest
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.certificates import Authority, Identity
from fixtures.nats_credentials import NatsAccounts, Token
from fixtures.nats_server import NatsServer
from fixtures.ros_memory import MemoryLink
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually, free_port
from fixtures.zenoh_router import ZenohRouter

from strands_robots import device_connect
from strands_robots.device_connect import (
    DuplicateDeviceError,
    FleetClient,
    LinkConfig,
    bringup,
    init_device_connect,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.client import CallRefusedError
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.safety.plane import plane
from strands_robots.serving.offered_verbs import offered
from strands_robots.utils import ValidationError


@pytest.fixture
def link() -> LinkConfig:
    return loopback_config(free_port())


@pytest.fixture
def world() -> Iterator[ToyWorld]:
    toy = ToyWorld()
    yield toy
    toy.close()


@pytest.fixture(scope="module")
def nats() -> Iterator[NatsServer]:
    with NatsServer() as server:
        yield server


def open_things() -> tuple[int, int]:
    me = psutil.Process()
    return me.num_threads(), me.num_fds()


def settles(before: tuple[int, int], spare: int = 0) -> None:
    """Threads and descriptors come back to what they were; ``spare`` for Zenoh's own pool, made once."""
    eventually(
        lambda: all(now <= then + spare for now, then in zip(open_things(), before, strict=True)),
        what=f"back to {before} from {open_things()}",
    )


def no_device_thread_is_left() -> None:
    eventually(lambda: not any(t.name == "device-connect" for t in threading.enumerate()))


def test_simulation_is_found_called_and_departs(link: LinkConfig, world: ToyWorld) -> None:
    runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
    with FleetClient(link, "tester") as fleet:
        (peer,) = fleet.peers(20)
        assert (peer.id, peer.type, peer.model) == ("arm-1", "strands_sim", "toy_sim")
        assert {f["name"] for f in peer.functions} == set(offered(world, SimulationDeviceDriver.verbs))
        assert fleet.call("arm-1", "getStatus")["status"] == "success"
        stop_device_connect(runtime)
        assert fleet.peers(0.6) == []
    stop_device_connect(runtime)


def test_device_is_callable_when_the_call_returns(link: LinkConfig, world: ToyWorld) -> None:
    with FleetClient(link) as fleet:
        for _ in range(3):
            runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
            assert fleet.call("arm-1", "getStatus")["status"] == "success"
            stop_device_connect(runtime)


async def test_device_runs_on_the_callers_own_loop(link: LinkConfig, world: ToyWorld) -> None:
    runtime = await init_device_connect(world, link=link)
    assert runtime.device_id.startswith("toy_sim-")
    await asyncio.to_thread(call_status, link, runtime.device_id)
    await runtime.shutdown()
    # Off already: it would block its own loop, and time out, if it still ran.
    stop_device_connect(runtime, within=0.5)


def call_status(link: LinkConfig, name: str) -> None:
    with FleetClient(link) as fleet:
        assert fleet.call(name, "getStatus")["status"] == "success"


def test_driver_follows_from_the_object() -> None:
    robot, world, ready = ToyRobot(), ToyWorld(), RobotDeviceDriver(ToyRobot())
    assert isinstance(bringup.driver_for(world, "robot"), SimulationDeviceDriver)
    assert isinstance(bringup.driver_for(robot, "robot"), RobotDeviceDriver)
    assert bringup.driver_for(ready, "sim") is ready
    with pytest.raises(ValidationError, match="list_robots"):
        bringup.driver_for(robot, "sim")

    class Both(ToyWorld):
        start_task = stop_task = get_task_status = ToyWorld.get_state

    assert isinstance(bringup.driver_for(Both(), "sim"), SimulationDeviceDriver)
    assert isinstance(bringup.driver_for(Both(), "robot"), RobotDeviceDriver)


def test_world_of_others_is_hardware_unless_it_is_said_to_be_a_simulation() -> None:
    class Cell:
        def list_robots(self) -> list[str]:
            return []

        def stop_policy(self, robot_name: str) -> None: ...

    class Packaged(ToyWorld):
        of_package = True

    for world, served in ((Cell(), True), (Packaged(), True), (ToyWorld(), False)):
        for peer_type, hardware in (("robot", served), ("sim", False)):
            driver = bringup.driver_for(world, peer_type)
            assert isinstance(driver, SimulationDeviceDriver)
            assert driver.hardware is hardware


def test_robot_that_is_no_simulation_refuses_to_be_served_as_one() -> None:
    base = MobileBaseRobot("base", MemoryLink(), "/cmd_vel")
    with pytest.raises(ValidationError, match="peer_type must be robot for MobileBaseRobot"):
        bringup.driver_for(base, "sim")


def test_device_type_that_a_robot_states_is_announced() -> None:
    class Gripper(ToyRobot):
        device_type = "gripper"

    assert bringup.driver_for(Gripper(), "robot").identity.device_type == "gripper"
    assert bringup.driver_for(ToyRobot(), "robot").identity.device_type == "strands_robot"
    Gripper.device_type = 5
    with pytest.raises(ValidationError, match="device_type"):
        bringup.driver_for(Gripper(), "robot")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"peer_id": "arm.left"}, "peer_id"),
        ({"peer_id": ""}, "peer_id"),
        ({"peer_id": "a" * 129}, "peer_id"),
        ({"peer_type": "arm"}, "peer_type"),
        ({"tenant": "a.b"}, "tenant"),
        ({"messaging_backend": "mqtt"}, "messaging_backend"),
        ({"allow_insecure": "false"}, "allow_insecure"),
        ({}, "allow_insecure=True"),
    ],
)
def test_argument_out_of_domain_is_refused_before_anything_opens(
    world: ToyWorld, arguments: dict[str, Any], named: str
) -> None:
    before = open_things()
    with pytest.raises(ValueError, match=named):
        init_device_connect_sync(world, **arguments)
    settles(before)


def test_second_device_of_an_id_refuses_to_go_live(link: LinkConfig, world: ToyWorld) -> None:
    runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
    for _ in range(3):
        with pytest.raises(DuplicateDeviceError, match="arm-1"):
            init_device_connect_sync(ToyWorld(), peer_id="arm-1", link=link)
    with FleetClient(link) as fleet:
        assert fleet.call("arm-1", "getStatus")["status"] == "success"
    stop_device_connect(runtime)
    stop_device_connect(init_device_connect_sync(world, peer_id="arm-1", link=link))


def test_warnings_of_a_device_reach_its_logger_after_others_of_its_id_have_left(link: LinkConfig) -> None:
    class Lamp(DeviceDriver):  # type: ignore[misc]
        device_type = "lamp"

        @rpc()
        async def shine(self) -> dict[str, Any]:
            """Shine."""
            raise OSError("burnt out")

    name, warnings = f"{bringup.RUNTIME_LOGGER}lamp-1", queue.SimpleQueue[logging.LogRecord]()
    runtime = init_device_connect_sync(Lamp(), peer_id="lamp-1", link=link)
    with pytest.raises(DuplicateDeviceError, match="lamp-1"):
        init_device_connect_sync(Lamp(), peer_id="lamp-1", link=link)
    stop_device_connect(init_device_connect_sync(Lamp(), peer_id="lamp-1", link=replace(link, tenant="b")))
    handler = QueueHandler(warnings)
    logging.getLogger(name).addHandler(handler)
    try:
        with FleetClient(link) as fleet, pytest.raises(CallRefusedError, match="burnt out"):
            fleet.call("lamp-1", "shine")
        assert "burnt out" in warnings.get(timeout=20).getMessage()
    finally:
        logging.getLogger(name).removeHandler(handler)
        stop_device_connect(runtime)
    assert name not in logging.root.manager.loggerDict


def test_second_device_of_an_id_refuses_on_nats_and_in_another_process(nats: NatsServer, world: ToyWorld) -> None:
    link = LinkConfig(transport="nats", connect=(nats.url,))
    with served("arm-1", nats.url):
        with pytest.raises(DuplicateDeviceError):
            init_device_connect_sync(world, peer_id="arm-1", link=link)
        runtime = init_device_connect_sync(
            world, peer_id="arm-1", link=LinkConfig("nats", connect=(nats.url,), tenant="b")
        )
        stop_device_connect(runtime)


def test_driver_that_cannot_be_announced_says_so(link: LinkConfig) -> None:
    class Colour(Enum):
        RED = 1

    class Lamp(DeviceDriver):  # type: ignore[misc]
        device_type = "lamp"

        @rpc()
        async def shine(self, colour: Colour = Colour.RED) -> dict[str, Any]:
            """Shine."""
            return {}

    with pytest.raises(ValidationError, match="shine"):
        init_device_connect_sync(Lamp(), link=link)

    class Box(DeviceDriver):  # type: ignore[misc]
        device_type = "box"
        labels: ClassVar[dict[str, Any]] = {"size": float("nan")}

    with pytest.raises((ValidationError, ValueError)):
        init_device_connect_sync(Box(), link=link)


def test_bring_up_that_times_out_reports_the_last_error(world: ToyWorld) -> None:
    taken = socket.create_server(("127.0.0.1", 0))
    with taken, pytest.raises(TimeoutError, match=r"arm-1 was not up on the network within 2 s: no Zenoh link at tcp/"):
        link = LinkConfig(listen=(f"tcp/127.0.0.1:{taken.getsockname()[1]}",))
        init_device_connect_sync(world, peer_id="arm-1", link=link, bringup_timeout=2.0)


def test_twenty_start_and_stop_cycles_leave_nothing(link: LinkConfig, world: ToyWorld) -> None:
    def cycle() -> None:
        stop_device_connect(init_device_connect_sync(world, peer_id="arm-1", link=link))

    others = set(threading.enumerate())
    cycle()
    eventually(lambda: not any(t.name == "robot-call" for t in set(threading.enumerate()) - others))
    before = open_things()
    for _ in range(20):
        cycle()
    settles(before, spare=2)
    no_device_thread_is_left()


def test_twenty_failed_bring_ups_leave_nothing(world: ToyWorld) -> None:
    absent = LinkConfig(transport="nats", connect=(f"nats://127.0.0.1:{free_port()}",), connect_timeout_s=0.2)

    class Broken(SimulationDeviceDriver):
        async def connect(self) -> None:
            raise OSError("no such bus")

    link, others = loopback_config(free_port()), set(threading.enumerate())
    with pytest.raises(OSError, match="no such bus"):
        init_device_connect_sync(Broken(world), link=link)
    eventually(lambda: not any(t.name == "robot-call" for t in set(threading.enumerate()) - others))
    before = open_things()
    for _ in range(10):
        with pytest.raises(OSError):
            init_device_connect_sync(world, link=absent, bringup_timeout=0.4)
        with pytest.raises(OSError, match="no such bus"):
            init_device_connect_sync(Broken(world), link=link)
    settles(before, spare=2)
    no_device_thread_is_left()


def test_bring_up_that_fails_before_its_runtime_leaves_no_robot_registered(
    link: LinkConfig, world: ToyWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def unreadable() -> None:
        await asyncio.to_thread(eventually, lambda: "unread-1" in plane().robots)
        raise OSError("no such bus")

    driver = SimulationDeviceDriver(world)
    monkeypatch.setattr(driver.reports, "read", unreadable)
    with pytest.raises(OSError, match="no such bus"):
        init_device_connect_sync(driver, peer_id="unread-1", link=link)
    assert "unread-1" not in plane().robots


def test_bring_up_that_timed_out_never_comes_online_later(world: ToyWorld) -> None:
    class Slow(SimulationDeviceDriver):
        async def connect(self) -> None:
            await asyncio.sleep(1.0)

    link = loopback_config(free_port())
    with pytest.raises(TimeoutError):
        init_device_connect_sync(Slow(world), peer_id="late-1", link=link, bringup_timeout=0.4)
    with FleetClient(link) as fleet:
        time.sleep(1.2)
        assert fleet.peers(0.5) == []


def test_bring_up_without_a_runtime_raises_runtime_error(
    link: LinkConfig, world: ToyWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def nothing(*_: object, **__: object) -> None:
        return None

    monkeypatch.setattr(bringup, "init_device_connect", nothing)
    with pytest.raises(RuntimeError, match="without a runtime"):
        init_device_connect_sync(world, link=link)
    no_device_thread_is_left()


SERVE = """
import sys
from fixtures.toy_robots import ToyWorld
from strands_robots.device_connect import (
    LinkConfig, StopSignal, init_device_connect_sync, loopback_config, stop_device_connect)
name, where, end = sys.argv[1:]
link = loopback_config(int(where)) if where.isdigit() else LinkConfig(transport="nats", connect=(where,))
world = ToyWorld()
with StopSignal() as stop:
    runtime = init_device_connect_sync(world, peer_id=name, link=link)
    print("up", flush=True)
    if end == "signal":
        stop.wait()
        world.halt("signal")
        stop_device_connect(runtime)
    elif end == "exit":
        sys.stdin.read()
print("down", flush=True)
"""


class served:
    """A world in a process of its own."""

    def __init__(self, name: str, where: str, end: str = "signal") -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVE, name, where, end],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __enter__(self) -> subprocess.Popen[str]:
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == "up"
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_device_departs_on_a_signal(link: LinkConfig, number: signal.Signals) -> None:
    with FleetClient(link) as fleet, served("arm-1", str(link.meet_port)) as process:
        eventually(lambda: [p.id for p in fleet.peers(0.6)] == ["arm-1"])
        process.send_signal(number)
        assert process.wait(40) == 0
        eventually(lambda: "arm-1" not in fleet.known())


def test_device_departs_at_the_end_of_the_program(link: LinkConfig) -> None:
    with FleetClient(link) as fleet, served("arm-1", str(link.meet_port), "exit") as process:
        eventually(lambda: [p.id for p in fleet.peers(0.6)] == ["arm-1"])
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(40) == 0
        eventually(lambda: "arm-1" not in fleet.known())


def test_id_of_a_killed_device_is_free_again(nats: NatsServer, world: ToyWorld) -> None:
    with served("arm-7", nats.url) as process:
        process.kill()
        process.wait()
        link = LinkConfig(transport="nats", connect=(nats.url,))
        stop_device_connect(init_device_connect_sync(world, peer_id="arm-7", link=link))


def test_two_tenants_do_not_see_each_other(world: ToyWorld) -> None:
    port = free_port()
    ours, theirs = loopback_config(port, "ours"), loopback_config(port, "theirs")
    first = init_device_connect_sync(world, peer_id="arm-1", link=ours)
    second = init_device_connect_sync(ToyWorld("other"), peer_id="arm-1", link=theirs)
    with FleetClient(ours) as here, FleetClient(theirs) as there:
        assert [p.model for p in here.peers(20)] == ["toy_sim"]
        assert [p.model for p in there.peers(20)] == ["other"]
    stop_device_connect(first)
    stop_device_connect(second)


def test_public_constant_is_the_join_timeout() -> None:
    assert device_connect._LOOP_JOIN_TIMEOUT_S == 5.0


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def authenticated_link(identity: Identity, **where: object) -> LinkConfig:
    return replace(LinkConfig(ca=str(identity.ca), cert=str(identity.cert), key=str(identity.key)), **where)  # type: ignore[arg-type]


def finds_moves_and_stops(link: LinkConfig) -> None:
    with FleetClient(link, "operator") as fleet:
        assert [peer.id for peer in fleet.peers(20)] == ["arm-1"]
        assert fleet.call("arm-1", "execute", {"instruction": "wave"})["status"] == "success"
        assert fleet.stop("arm-1")["stopped"] == ["left"]


def test_device_behind_a_router_with_mutual_tls_needs_no_opt_in(authority: Authority, world: ToyWorld) -> None:
    with ZenohRouter(authority.issue("router")) as router:
        where = {"connect": (router.endpoint,)}
        runtime = init_device_connect_sync(
            world, peer_id="arm-1", link=authenticated_link(authority.issue("arm-1"), **where)
        )
        finds_moves_and_stops(authenticated_link(authority.issue("operator"), **where))
        stop_device_connect(runtime)


def test_certificates_of_the_environment_need_no_opt_in(
    authority: Authority, world: ToyWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = authority.issue("arm-1")
    with ZenohRouter(authority.issue("router")) as router:
        monkeypatch.setenv("ZENOH_CONNECT", router.endpoint)
        for part in ("ca", "cert", "key"):
            monkeypatch.setenv(f"MESSAGING_TLS_{part.upper()}_FILE", str(getattr(robot, part)))
        runtime = init_device_connect_sync(world, peer_id="arm-1")
        finds_moves_and_stops(authenticated_link(authority.issue("operator"), connect=(router.endpoint,)))
        stop_device_connect(runtime)


def test_peers_with_mutual_tls_admit_no_stranger(authority: Authority, world: ToyWorld) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    runtime = init_device_connect_sync(
        world, peer_id="arm-1", link=authenticated_link(authority.issue("arm-1"), mode="peer", listen=(endpoint,))
    )
    finds_moves_and_stops(authenticated_link(authority.issue("operator"), mode="peer", connect=(endpoint,)))
    with FleetClient(LinkConfig(mode="peer", connect=(endpoint.replace("tls/", "tcp/"),), multicast=False)) as stranger:
        assert stranger.peers(0.6) == []
    stop_device_connect(runtime)


def test_device_on_nats_with_tls_and_tokens_needs_no_opt_in(
    authority: Authority, world: ToyWorld, caplog: pytest.LogCaptureFixture
) -> None:
    accounts = NatsAccounts()
    with NatsServer(authority.issue("server"), accounts.server_lines) as server:

        def link(token: Token) -> LinkConfig:
            return LinkConfig(
                transport="nats",
                connect=(server.url,),
                ca=str(authority.ca),
                jwt=token.jwt,
                nkey_seed=token.nkey_seed,
            )

        runtime = init_device_connect_sync(world, peer_id="arm-1", link=link(accounts.device("arm-1")))
        finds_moves_and_stops(link(accounts.operator()))
        stop_device_connect(runtime)
    assert "does not answer" not in caplog.text
