"""A device is announced again when what it can do has changed, and not before."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from typing import Any

import pytest
from device_connect_edge import DeviceRuntime
from device_connect_edge.discovery import PresenceAnnouncer
from device_connect_edge.messaging.exceptions import NotConnectedError
from fixtures.toy_robots import ToyWorld

from strands_robots.device_connect._compat import Runtime, describe_anew
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.serving.offered_verbs import Offers

LINK = LinkConfig("nats", connect=("nats://127.0.0.1:1",))


class Growing(ToyWorld):
    """A world whose robots come and go."""

    def __init__(self) -> None:
        super().__init__(robots=())

    def add(self, name: str) -> None:
        self.positions[name] = {}


class Link:
    """A link that keeps what is published, or is lost."""

    def __init__(self) -> None:
        self.published: list[dict[str, Any]] = []
        self.lost = False

    async def publish(self, _subject: str, data: bytes) -> None:
        if self.lost:
            raise NotConnectedError("the link is lost")
        self.published.append(json.loads(data))

    def functions(self) -> set[str]:
        return {each["name"] for each in self.published[-1]["capabilities"]["functions"]}


@pytest.fixture
def world() -> Iterator[Growing]:
    made = Growing()
    yield made
    made.close()


@pytest.fixture
def driver(world: Growing) -> SimulationDeviceDriver:
    made = SimulationDeviceDriver(world)
    made.offers = Offers(world, made.built_verbs, every_s=0.0)
    return made


def announce(runtime: Any, driver: SimulationDeviceDriver) -> None:
    """Look at the world, as a worker does, and announce what it can do."""
    driver.offers.look()
    describe_anew(runtime, driver)


@pytest.fixture(params=[Runtime, DeviceRuntime], ids=["ours", "the framework's own"])
def runtime(request: pytest.FixtureRequest, driver: SimulationDeviceDriver) -> Any:
    if request.param is Runtime:
        made: Any = Runtime(driver=driver, device_id="sim-1", link=LINK, allow_insecure=True)
    else:
        made = DeviceRuntime(driver=driver, device_id="sim-1", messaging_backend="nats", allow_insecure=True)
        made._d2d_mode = True
    made.messaging = Link()
    capabilities = driver.capabilities.model_dump()
    made._d2d_announcer = PresenceAnnouncer(made.messaging, "sim-1", "default", capabilities, {}, made.status)
    describe_anew(made, driver)
    return made


async def ended() -> None:
    """Let every task of this loop end."""
    await asyncio.gather(*(asyncio.all_tasks() - {asyncio.current_task()}))


async def test_device_is_announced_once_for_each_change(
    runtime: Any, driver: SimulationDeviceDriver, world: Growing
) -> None:
    announce(runtime, driver)
    await ended()
    assert runtime.messaging.published == []
    world.add("left")
    for _ in range(3):
        announce(runtime, driver)
        await ended()
    assert len(runtime.messaging.published) == 1
    assert "execute" in runtime.messaging.functions()
    world.positions.clear()
    announce(runtime, driver)
    await ended()
    assert "execute" not in runtime.messaging.functions()


async def test_next_message_of_a_link_that_was_lost_says_it(
    runtime: Any, driver: SimulationDeviceDriver, world: Growing
) -> None:
    runtime.messaging.lost = True
    world.add("left")
    announce(runtime, driver)
    await ended()
    said = json.loads(runtime._d2d_announcer._build_payload())
    assert "execute" in {each["name"] for each in said["capabilities"]["functions"]}


@pytest.mark.parametrize("kind", [Runtime, DeviceRuntime], ids=["ours", "the framework's own"])
async def test_registry_is_told_of_a_change(
    kind: type[Any], driver: SimulationDeviceDriver, world: Growing, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered: list[set[str]] = []

    async def register(self: Any, force: bool = False) -> None:
        assert force
        registered.append({each["name"] for each in self._build_registration_params()["capabilities"]["functions"]})

    monkeypatch.setattr(DeviceRuntime, "_register", register)
    more: dict[str, Any] = {"link": LINK, "discovery": "registry"} if kind is Runtime else {"messaging_backend": "nats"}
    runtime = kind(driver=driver, device_id="sim-1", allow_insecure=True, **more)
    runtime._d2d_mode = False
    await runtime._register(force=True)
    announce(runtime, driver)
    await ended()
    assert len(registered) == 1
    world.add("left")
    announce(runtime, driver)
    await ended()
    assert len(registered) == 2
    assert "execute" in registered[-1] - registered[0]


def test_devices_of_one_class_share_what_describes_them(world: Growing) -> None:
    first, second = SimulationDeviceDriver(world), SimulationDeviceDriver(Growing())
    assert first.described() is second.described()
    world.add("left")
    assert first.described() is second.described()
    first.offers = Offers(world, first.built_verbs)
    assert first.described() is not second.described()
    assert first.described() is first.described()


async def test_lockout_and_its_end_are_announced_once_each(runtime: Any, driver: SimulationDeviceDriver) -> None:
    latch = LockoutLatch("sim-1")
    driver.stops.unregistered = latch
    driver.robot.gate.attach(latch)
    driver.set_device(runtime)
    driver.reports.activity = driver.glance()
    announce(runtime, driver)
    await ended()
    runtime.messaging.published.clear()
    for change, locked in ((lambda: latch.engage("e" * 32, "desk", "smoke"), True), (latch.clear, False)):
        change()
        assert not driver.reports.unchanged()
        for _ in range(3):
            announce(runtime, driver)
            await ended()
        assert [each["status"]["locked"] for each in runtime.messaging.published] == [locked]
        assert driver.reports.unchanged()
        runtime.messaging.published.clear()
