"""The beat of a process: one message a second that names its devices."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from device_connect_edge.messaging.exceptions import NotConnectedError
from fixtures.waiting import until

from strands_robots.device_connect import presence
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.discovery import HEARTBEATS_MAX, Discovery
from strands_robots.device_connect.presence import LivingDevice, devices_in, process_heartbeat

LINK = LinkConfig(connect=("tcp/127.0.0.1:7447",))


class Messaging:
    """A client that keeps what is published."""

    def __init__(self, link: LinkConfig = LINK) -> None:
        self.link = link
        self.sent: list[tuple[str, bytes]] = []
        self.down, self.refused = False, 0

    async def publish(self, subject: str, data: bytes) -> None:
        if self.down:
            self.refused += 1
            raise NotConnectedError("not connected")
        self.sent.append((subject, data))


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presence, "PROCESS_HEARTBEAT_S", 0.01)


def device(name: str, messaging: Messaging, lives: Any = lambda: True, fields: Any = dict) -> LivingDevice:
    return LivingDevice(name, messaging, lives, fields)


async def test_one_message_names_every_device_of_the_process() -> None:
    messaging = Messaging()
    devices = [device(f"arm-{each}", messaging) for each in range(50)]
    for each in devices:
        process_heartbeat(LINK).join(each)
    await until(lambda: len(messaging.sent) >= 2)
    subject, data = messaging.sent[-1]
    for each in devices:
        process_heartbeat(LINK).leave(each)
    assert subject == "device-connect.default.arm-0.heartbeat"
    assert devices_in(data) == [f"arm-{each}" for each in range(50)]
    # A reader that knows only heartbeats finds one.
    assert json.loads(data)["device_id"] == "arm-0"


async def test_beat_leaves_out_a_device_that_left_or_cannot_be_read() -> None:
    messaging = Messaging()
    unread = device("arm-2", messaging, lives=lambda: False)
    first, second = device("arm-0", messaging), device("arm-1", messaging)
    for each in (first, second, unread):
        process_heartbeat(LINK).join(each)
    process_heartbeat(LINK).leave(first)
    sent = len(messaging.sent)
    await until(lambda: len(messaging.sent) >= sent + 2)
    assert messaging.sent[-1][0] == "device-connect.default.arm-1.heartbeat"
    assert devices_in(messaging.sent[-1][1]) == ["arm-1"]
    for each in (second, unread):
        process_heartbeat(LINK).leave(each)


async def test_last_device_ends_the_beat() -> None:
    messaging = Messaging()
    only = device("arm-0", messaging)
    process_heartbeat(LINK).join(only)
    await until(lambda: messaging.sent)
    before = process_heartbeat(LINK)
    before.leave(only)
    assert process_heartbeat(LINK) is not before
    assert not [
        each for each in asyncio.all_tasks() if each.get_name() == "process-heartbeat" and not each.cancelling()
    ]


async def test_beat_goes_on_after_a_lost_link_and_an_unsendable_state() -> None:
    messaging, facts = Messaging(), [{"state": object()}]
    only = device("arm-0", messaging, fields=lambda: facts[0])
    process_heartbeat(LINK).join(only)
    await asyncio.sleep(0)
    messaging.down = True
    facts[0] = {}
    await until(lambda: messaging.refused)
    messaging.down = False
    await until(lambda: messaging.sent)
    process_heartbeat(LINK).leave(only)


def test_heartbeat_of_one_device_names_no_other() -> None:
    assert devices_in(b'{"device_id": "arm-1", "ts": 1.0}') == ()
    assert devices_in(b'{"devices": "arm-1"}') == ()
    assert devices_in(b'"devices"') == ()
    assert devices_in(b'{"devices": [1, "arm-1", null]}') == ["arm-1"]


async def test_client_takes_a_beat_as_a_sign_of_life_of_all_it_names() -> None:
    found = Discovery(Messaging())  # type: ignore[arg-type]
    await found._on_heartbeat(b'{"devices": ["arm-1", "arm-2"]}', "device-connect.default.arm-1.heartbeat", None)
    assert found.last_heartbeat("arm-2") is not None
    assert found.beats_every("arm-2") == 1.0
    await found._on_heartbeat(b"{}", "device-connect.default.bare-1.heartbeat", None)
    assert found.beats_every("bare-1") == 5.0


async def test_beat_proves_only_its_own_device_where_devices_are_identified() -> None:
    link = LinkConfig(transport="nats", connect=("nats://127.0.0.1:4222",), jwt="x", nkey_seed="y")
    assert link.identified
    found = Discovery(Messaging(link))  # type: ignore[arg-type]
    await found._on_heartbeat(b'{"devices": ["arm-1", "arm-2"]}', "device-connect.default.arm-1.heartbeat", None)
    assert found.last_heartbeat("arm-1") is not None
    assert found.last_heartbeat("arm-2") is None


async def test_memory_of_heartbeats_is_bounded() -> None:
    found = Discovery(Messaging())  # type: ignore[arg-type]
    for number in range(HEARTBEATS_MAX + 100):
        await found._on_heartbeat(b"{}", f"device-connect.default.arm-{number}.heartbeat", None)
    assert found.last_heartbeat("arm-0") is None
    assert found.last_heartbeat(f"arm-{HEARTBEATS_MAX + 99}") is not None
