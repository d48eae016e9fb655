"""Real devices under the safety plane: stopped while their loop is blocked, locked, and resumed by a signature."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from device_connect_edge.messaging import MessagingError
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually, eventually_async, free_port

from strands_robots.audit import read_audit_log, verify_audit_integrity
from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.backends import open_client
from strands_robots.device_connect.client import DeviceTimeoutError, NoSuchDeviceError
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.envelope import Envelope
from strands_robots.safety import ed25519
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.plane import plane
from strands_robots.safety.resume import sign
from strands_robots.safety.stop_link import ESTOP, notification

MOVE = {"instruction": "wave", "duration": 300.0}


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest) -> Iterator[LinkConfig]:
    if request.param == "nats":
        with NatsServer() as server:
            yield LinkConfig(transport="nats", connect=(server.url,))
    else:
        yield loopback_config(free_port())


@pytest.fixture
def operator(monkeypatch: pytest.MonkeyPatch) -> Ed25519PrivateKey:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(ed25519.public_half(key)))
    return key


class KnowsItsLoop:
    """Remembers the event loop that it is served on, so that a test may block it."""

    loop: asyncio.AbstractEventLoop | None = None

    async def connect(self) -> None:
        self.loop = asyncio.get_running_loop()
        await super().connect()  # type: ignore[misc]


class Simulated(KnowsItsLoop, SimulationDeviceDriver): ...


class Real(KnowsItsLoop, RobotDeviceDriver): ...


class Floor:
    """A simulation and an arm on one network, an agent that drives them, and a controller that stops them."""

    def __init__(self, link: LinkConfig) -> None:
        self.link = link
        self.world, self.arm = ToyWorld(), ToyRobot()
        self.drivers = (Simulated(self.world), Real(self.arm))
        self.runtimes = [
            init_device_connect_sync(driver, peer_id=name, link=link, allow_insecure=True)
            for name, driver in zip(("sim-1", "arm-1"), self.drivers, strict=True)
        ]
        self.agent = FleetClient(link, "tester").__enter__()
        self.controller: SafetyController = safety_controller("safety-1", link)

    def ready(self) -> bool:
        up = self.controller.link_up and all(each.link.up for each in estop_listener().registrations)
        return up and all(self.asked(device, "getStatus").get("status") == "success" for device in ("sim-1", "arm-1"))

    def asked(self, device: str, function: str, **params: object) -> Envelope:
        """The answer of a device; empty while it is not known on the network yet."""
        try:
            return self.agent.call(device, function, params)
        except (MessagingError, NoSuchDeviceError, DeviceTimeoutError):
            return {}

    def move(self) -> None:
        for device in ("sim-1", "arm-1"):
            answer = self.agent.call(device, "execute", MOVE)
            assert answer["status"] == "success", answer
        eventually(lambda: self.world.writes and self.arm.writes)

    def close(self) -> None:
        self.world.close()
        self.arm.close()
        self.controller.close()
        self.agent.close()
        for runtime in self.runtimes:
            stop_device_connect(runtime)


def recorded(event: str) -> list[dict[str, Any]]:
    """Return the audit records of this name."""
    return [each for each in read_audit_log() if each["event"] == event]


@pytest.fixture
def floor(link: LinkConfig, monkeypatch: pytest.MonkeyPatch) -> Iterator[Floor]:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute")
    made = Floor(link)
    try:
        eventually(made.ready)
        yield made
    finally:
        made.close()
    assert estop_listener().registrations == ()
    assert plane().robots == {}


def test_a_stop_halts_locks_and_is_answered_and_a_signed_resume_frees_without_moving(
    floor: Floor, operator: Ed25519PrivateKey
) -> None:
    floor.move()
    report = floor.controller.stop(["sim-1", "arm-1"], "smoke", deadline_s=20)
    at = time.monotonic()
    assert report.ok, report
    time.sleep(0.05)
    for toy in (floor.world, floor.arm):
        assert toy.writes[-1] <= at
    for device in ("sim-1", "arm-1"):
        refused = floor.agent.call(device, "execute", MOVE)
        assert refused["status"] == "error"
        assert report.estop_id in refused["reason"]
        assert "safety-1" in refused["reason"]
        nonce = new_epoch()
        status = floor.agent.call(device, "getStatus", {"nonce": nonce})
        assert status["statement"]["nonce"] == nonce
        assert "statement" not in floor.agent.call(device, "getStatus")
        assert floor.agent.call(device, "getStatus", {"nonce": "of old"})["status"] == "error"
        assert status["status"] == "success"
        assert status["locked"] is True
        assert status["lockout"][0]["epoch"] == report.estop_id
        assert floor.agent.call(device, "resume", {"assertion": {}})["reason"] == "resume rejected"
        (assertion,) = sign(operator, report.estop_id, ["arm-1", "sim-1"])
        assert floor.agent.call(device, "resume", {"assertion": assertion})["locked"] is False
    writes = len(floor.arm.writes)
    time.sleep(0.05)
    assert len(floor.arm.writes) == writes
    floor.move()
    events = ("remote_estop_engaged", "resume_denied", "resume_ok")
    eventually(lambda: [len(recorded(name)) for name in events] == [2, 2, 2])
    assert verify_audit_integrity()["ok"]


def test_a_blocked_event_loop_of_every_device_does_not_hold_up_the_stop(floor: Floor) -> None:
    floor.move()
    release = threading.Event()
    blocked = []
    for driver in floor.drivers:
        assert driver.loop is not None
        driver.loop.call_soon_threadsafe(lambda: blocked.append(release.wait(60)))
    try:
        report = floor.controller.stop(["sim-1", "arm-1"], deadline_s=20)
        at = time.monotonic()
        assert report.ok
        time.sleep(0.05)
        assert max(floor.world.writes[-1], floor.arm.writes[-1]) <= at
        assert blocked == []
    finally:
        release.set()


def test_stop_by_the_runtime_and_by_the_listener_halts_once(floor: Floor) -> None:
    floor.move()

    async def emit() -> None:
        client = await open_client(floor.link)
        payload = notification(ESTOP, {"reason": "button", "estop_id": new_epoch()})
        separator = "." if floor.link.transport == "nats" else "/"

        async def locked() -> bool:
            await client.publish(separator.join(("device-connect", "default", "panel-1", "event", ESTOP)), payload)
            return len(plane().lockouts()) == 2

        await eventually_async(locked)
        await client.close()

    asyncio.run(emit())
    eventually(lambda: len(recorded("remote_estop_engaged")) >= 2)
    time.sleep(0.1)
    records = recorded("remote_estop_engaged")
    assert sorted(each["peer_id"] for each in records) == ["arm-1", "sim-1"]
    assert json.dumps(records[0]["payload"]["reason"]) == '"button"'


def test_a_device_that_raises_an_emergency_stop_is_locked_first_and_all_others_by_the_same_stop(floor: Floor) -> None:
    floor.move()
    told: list[str] = []
    neighbour = stop_link(floor.link)
    neighbour.open((ESTOP,), lambda event, source, payload: told.append(source), lambda up: None)
    eventually(lambda: neighbour.up)
    asyncio.run(floor.drivers[1].emergencyStop(reason="smoke"))
    lockouts = plane().lockouts()
    assert set(lockouts) == {"sim-1", "arm-1"}
    assert {each.source for robot in lockouts.values() for each in robot} == {"arm-1"}
    assert [each.reason for each in lockouts["arm-1"]] == ["smoke"]
    written = eventually(lambda: len(recorded("emergency_stop")) == 2 and recorded("emergency_stop"))
    assert all(each["payload"]["stopped"] for each in written)
    # The event goes to everyone, and comes back to its own process as the same stop.
    eventually(lambda: told == ["arm-1"])
    neighbour.close()
    assert [len(each.epochs) for each in plane().robots.values()] == [1, 1]
    assert floor.asked("arm-1", "execute", **MOVE)["locked"] is True


def test_a_lockout_outlives_the_device_and_its_process_memory(floor: Floor) -> None:
    report = floor.controller.stop(["sim-1", "arm-1"], deadline_s=20)
    assert report.ok
    stop_device_connect(floor.runtimes[0])
    floor.runtimes[0] = init_device_connect_sync(ToyWorld(), peer_id="sim-1", link=floor.link, allow_insecure=True)
    refused = eventually(lambda: floor.asked("sim-1", "execute", **MOVE))
    assert report.estop_id in refused["reason"]
