"""Callers that multicast may bring to a mesh, on a machine without a hub: what becomes of it when one comes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.waiting import accepts, eventually, free_port

from strands_robots.mesh.transport.config import Posture
from strands_robots.mesh.transport.zenoh import ZenohTransport


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def caller(port: int) -> Iterator[ZenohTransport]:
    transport = transport_at(port, multicast=True)
    transport.dials_only = True
    transport.connect()
    assert not accepts(port), "a caller is never the hub"
    yield transport
    transport.close()


def transport_at(port: int, *, multicast: bool) -> ZenohTransport:
    hub = f"tcp/127.0.0.1:{port}"
    return ZenohTransport(Posture(f"strands-{port}", (), (), hub, None, None, multicast, 16))


def test_robot_of_a_process_that_only_called_before_is_reached(caller: ZenohTransport, port: int) -> None:
    caller.take_part()
    # Where multicast has brought it to others meanwhile, it needs no hub.
    eventually(lambda: accepts(port) or caller.linked(), what="a hub of this machine")


def test_caller_reaches_a_hub_that_comes_later(caller: ZenohTransport, port: int) -> None:
    hub = transport_at(port, multicast=False)
    hub.connect()
    try:
        # It tries every 8 s at the latest.
        eventually(caller.linked, within=30.0, what="the link to the hub")
    finally:
        hub.close()
