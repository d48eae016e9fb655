"""What asks for the presence of others: ``depends_on``, ``@on(device_type=...)`` and ``peer_lost``."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from device_connect_edge.drivers import DeviceDriver, emit, on
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import LinkConfig, init_device_connect_sync, loopback_config, stop_device_connect


class Source(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A device that emits."""

    def __init__(self, device_type: str) -> None:
        super().__init__()
        self.device_type = device_type

    @emit()
    async def tick(self, number: int = 0) -> None:
        """Tick."""


class Listener(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A device that needs a toy, and follows toys alone."""

    device_type = "listener"
    depends_on = ("toy",)

    def __init__(self) -> None:
        super().__init__()
        self.ticks: list[str] = []
        self.lost: list[str] = []

    @on(device_type="toy", event_name="tick")
    async def on_tick(self, device_id: str, event_name: str, payload: dict[str, Any]) -> None:
        self.ticks.append(device_id)

    @on(event_name="peer_lost")
    async def on_lost(self, device_id: str, event_name: str, payload: dict[str, Any]) -> None:
        self.lost.append(device_id)


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest) -> Iterator[LinkConfig]:
    if request.param == "zenoh":
        yield loopback_config(free_port())
        return
    with NatsServer() as server:
        yield LinkConfig(transport="nats", connect=(server.url,))


def test_device_waits_for_a_type_follows_it_and_notes_its_loss(link: LinkConfig) -> None:
    def serve(driver: DeviceDriver, name: str) -> Any:
        return init_device_connect_sync(driver, peer_id=name, link=link, allow_insecure=True)

    listener = Listener()
    running = [serve(Source("noise"), "noise-1")]
    try:
        with ThreadPoolExecutor() as joining:
            starting = joining.submit(serve, listener, "listener-1")
            assert not starting.done()
            toy = serve(Source("toy"), "toy-1")
            running.append(starting.result(30.0))

        def both_tick() -> bool:
            running[0].emit_from_thread("tick", {"number": 1})
            toy.emit_from_thread("tick", {"number": 1})
            return "toy-1" in listener.ticks

        eventually(both_tick, what="a tick of the toy")
        assert set(listener.ticks) == {"toy-1"}
        stop_device_connect(toy)
        eventually(lambda: "toy-1" in listener.lost, what="the loss of the toy")
    finally:
        for each in running:
            stop_device_connect(each)
