"""A recorded check-in is no stop, and a stop that was pressed during an outage says so."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.nats_server import NatsServer
from fixtures.safety_site import Site
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety import ed25519
from strands_robots.safety.answers import StopReport
from strands_robots.safety.orders import StopRules, new_epoch
from strands_robots.safety.stop_link import CHECK_IN, ESTOP, notification

TIMES = 10


@pytest.fixture
def server() -> Iterator[NatsServer]:
    with NatsServer() as running:
        yield running


def link_to(server: NatsServer) -> LinkConfig:
    return LinkConfig(transport="nats", connect=(server.url,))


def records(event: str) -> list[dict[str, Any]]:
    return [each["payload"] for each in read_audit_log() if each["event"] == event]


def test_recorded_check_ins_under_the_name_of_a_stop_stop_no_robot(server: NatsServer) -> None:
    key, recorded = Ed25519PrivateKey.generate(), list[bytes]()
    site = Site(link_to(server), "arm-1", rules=lambda: StopRules(allow=(), keys=(ed25519.public_half(key),)))
    thief = stop_link(link_to(server))
    thief.open((CHECK_IN,), lambda event, source, payload: recorded.append(payload), lambda up: None)
    controller = safety_controller("safety-1", link_to(server), signing_key=key)
    try:
        eventually(lambda: site.ready() and thief.up)
        assert controller.wait_link(20)
        site.robots["arm-1"].start()
        controller.check_in_every(0.02)
        eventually(lambda: len(recorded) >= TIMES)
        for payload in recorded[:TIMES]:
            params = {**json.loads(payload)["params"], "purpose": "emergency-stop"}
            thief.publish("safety-1", ESTOP, notification(ESTOP, params))
        eventually(lambda: records("estop_refused"))
        # It is served after the forged ones, so none of them is still on its way.
        assert controller.stop(["arm-1"], deadline_s=20).ok
        assert len(site.entries[0].epochs) == 1
        assert len(site.robots["arm-1"].halts) == 1
    finally:
        controller.close()
        thief.close()
        site.close()


def test_a_stop_that_was_pressed_during_an_outage_is_recorded_and_reported_late(server: NatsServer) -> None:
    site = Site(link_to(server), "arm-1")
    controller = safety_controller("safety-1", link_to(server))
    try:
        eventually(site.ready)
        assert controller.wait_link(20)
        assert controller.stop(["arm-1"], deadline_s=20).ok
        server.kill()
        eventually(lambda: not controller.link_up)
        estop_id, reports = new_epoch(), list[StopReport]()
        pressed = time.time()

        def press() -> None:
            # The space bar goes on in this way: under one id, three seconds at a time.
            while not reports or reports[-1].silent or not reports[-1].link:
                reports.append(controller.stop(["arm-1"], estop_id=estop_id, deadline_s=0.5))

        thread = threading.Thread(target=press)
        thread.start()
        time.sleep(1.5)  # the outage that the record must hold
        server.start()
        thread.join()
    finally:
        controller.close()
        site.close()
    report = reports[-1]
    assert report.left_ms > 1500
    assert report.stopped["arm-1"].latency_ms >= report.left_ms
    stops = {each["estop_id"]: each for each in records("remote_estop_engaged")}
    first, late = (stops[each] for each in stops)
    assert first["timing"] == "on time"
    assert late["timing"] == "late"
    assert late["delay_s"] >= 1.5
    assert pressed <= late["pressed_at"] < pressed + 1.0
    assert late["issued"] - late["pressed_at"] >= 1.5
