"""Emergency stops on the runtime's connection: one subscription for the devices of a link."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
from device_connect_edge.messaging.exceptions import SubscribeError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.device_stops import stops_of

LINK = LinkConfig(connect=("tcp/127.0.0.1:7447",))
SUBJECT = "device-connect.default.safety-1.event.emergencyStop"


class Messaging:
    """A client that keeps its subscriptions."""

    def __init__(self, refuses: bool = False) -> None:
        self.refuses = refuses
        self.callbacks: list[Any] = []

    async def subscribe_to_stops(self, subject: str, callback: Any) -> Any:
        if self.refuses:
            raise SubscribeError("refused")
        self.callbacks.append(callback)

        async def unsubscribe() -> None:
            self.callbacks.remove(callback)

        return SimpleNamespace(unsubscribe=unsubscribe)


class Device:
    """A device that keeps the stops that it received."""

    def __init__(self, messaging: Messaging) -> None:
        self.runtime = SimpleNamespace(messaging=messaging)
        self.stops: list[tuple[object, object]] = []
        self.raw: list[bytes | int | None] = []

    async def on_estop(self, device_id: object, payload: object, raw: bytes | int | None = None) -> None:
        self.stops.append((device_id, payload))
        self.raw.append(raw)


async def test_devices_of_a_link_share_one_subscription_that_outlives_its_holder() -> None:
    clients = [Messaging() for _ in range(3)]
    devices = [Device(each) for each in clients]
    for each in devices:
        await stops_of(LINK).join(each)
    assert [len(each.callbacks) for each in clients] == [1, 0, 0]
    await stops_of(LINK).leave(devices[0])
    assert [len(each.callbacks) for each in clients] == [0, 1, 0]
    await clients[1].callbacks[0](json.dumps({"params": {"reason": "x"}}).encode(), SUBJECT, None)
    assert [each.stops for each in devices] == [[], [("safety-1", {"reason": "x"})], []]
    for each in devices[1:]:
        await stops_of(LINK).leave(each)
    assert not any(each.callbacks for each in clients)


async def test_stop_that_comes_while_the_subscription_changes_hands_is_taken() -> None:
    old, new = Device(Messaging()), Device(Messaging())
    for each in (old, new):
        await stops_of(LINK).join(each)
    subscribe = new.runtime.messaging.subscribe_to_stops

    async def slow(*args: Any, **options: Any) -> Any:
        await old.runtime.messaging.callbacks[0](json.dumps({"params": {"reason": "x"}}).encode(), SUBJECT, None)
        return await subscribe(*args, **options)

    new.runtime.messaging.subscribe_to_stops = slow
    await stops_of(LINK).leave(old)
    assert new.stops == [("safety-1", {"reason": "x"})]
    await stops_of(LINK).leave(new)


@pytest.mark.parametrize("data", [b"no JSON", b"[1]", b"{}", b'"params"', b"[" * 60_000, 8_000_000])
async def test_stop_that_cannot_be_read_is_passed_on_with_its_bytes_or_their_number(data: bytes | int) -> None:
    client = Messaging()
    device = Device(client)
    await stops_of(LINK).join(device)
    await client.callbacks[0](data, SUBJECT, None)
    assert device.stops == [("safety-1", {})]
    assert device.raw == [data]
    await stops_of(LINK).leave(device)


async def test_device_that_cannot_subscribe_fails_alone() -> None:
    refused, fine = Device(Messaging(refuses=True)), Device(Messaging())
    with pytest.raises(SubscribeError):
        await stops_of(LINK).join(refused)
    await stops_of(LINK).join(fine)
    assert len(fine.runtime.messaging.callbacks) == 1
    await stops_of(LINK).leave(fine)
    await stops_of(LINK).leave(refused)
