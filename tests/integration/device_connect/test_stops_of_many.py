"""Plain stops of a large fleet: every device is asked at once and named."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator

import pytest
from fixtures.nats_server import NatsServer
from nats.aio.client import Client
from nats.aio.msg import Msg

from strands_robots.device_connect import FleetClient, LinkConfig

COUNT = 200
SILENT = frozenset(f"arm-{number}" for number in range(0, COUNT, 2))
"""Devices that answer only once every other one was asked too."""

DOTTED = "arm$left"
"""An id that the network carries and no call can have."""


class Fleet:
    """Stand-ins of many devices on one connection."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._up = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),), daemon=True)
        self._end = asyncio.Event()
        self.asked: set[str] = set()
        self.threads: set[str] = set()
        self._thread.start()
        assert self._up.wait(20)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(20)
        self._loop.close()

    async def _serve(self) -> None:
        client = Client()
        await client.connect(self._url)
        root = "device-connect.default"

        async def announce(_probe: Msg) -> None:
            for name in (*(f"arm-{number}" for number in range(COUNT)), DOTTED):
                described = {"device_id": name, "capabilities": {"functions": [{"name": "stop"}]}}
                await client.publish(f"{root}.{name}.presence", json.dumps(described).encode())

        async def respond(command: Msg) -> None:
            stopped = {"status": "success", "stopped": True, "content": [{"text": "still"}]}
            reply = {"jsonrpc": "2.0", "id": json.loads(command.data)["id"], "result": stopped}
            await command.respond(json.dumps(reply).encode())

        async def answer(command: Msg) -> None:
            name = command.subject.split(".")[2]
            self.asked.add(name)
            self.threads.update(each.name for each in threading.enumerate())
            if name in SILENT:
                held.append(command)
            else:
                await respond(command)
            while held and len(self.asked) == COUNT:
                await respond(held.pop())

        held: list[Msg] = []
        await client.subscribe(f"{root}.discovery.probe", cb=announce)
        await client.subscribe(f"{root}.*.cmd", cb=answer)
        await client.flush()
        self._up.set()
        await self._end.wait()
        await client.close()


@pytest.fixture
def link() -> Iterator[LinkConfig]:
    with NatsServer() as server:
        yield LinkConfig(transport="nats", connect=(server.url,))


@pytest.fixture
def devices(link: LinkConfig) -> Iterator[Fleet]:
    fleet = Fleet(link.connect[0])
    yield fleet
    fleet.close()


def test_stop_of_all_asks_every_device_and_starts_no_thread_for_each(link: LinkConfig, devices: Fleet) -> None:
    with FleetClient(link) as fleet:
        before = {each.name for each in threading.enumerate()}
        answers = fleet.stop_all(30.0)
    assert devices.asked == {f"arm-{number}" for number in range(COUNT)}
    assert answers.keys() == devices.asked | {DOTTED}
    assert {name for name, answer in answers.items() if answer.get("stopped") is True} == devices.asked
    assert answers[DOTTED]["stopped"] is None
    assert devices.threads <= before | {"sightings"}, "one thread writes down who was there"


def test_silent_devices_delay_no_stop_of_the_others(link: LinkConfig, devices: Fleet) -> None:
    names = sorted(SILENT) + [f"arm-{number}" for number in range(1, COUNT, 2)]
    with FleetClient(link) as fleet:
        silent = fleet.stop_each(["arm-0", "arm-2"], 0.5)
        answers = fleet.stop_each(names, 30.0)
    assert {name: answer["stopped"] for name, answer in silent.items()} == {"arm-0": None, "arm-2": None}
    assert list(answers) == names
    assert all(answer.get("stopped") is True for answer in answers.values())
