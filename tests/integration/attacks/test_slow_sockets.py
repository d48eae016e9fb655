"""Thousands of connections that say nothing, at the ports that a stop passes."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fixtures.child import Child
from fixtures.mesh_strangers import APPROVED, WAVE
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually, free_port
from tests.integration.mesh.networks import OverZenoh, network

from strands_robots.device_connect.backends import LinkConfig, loopback_config

SOCKETS, STOPS = 3000, 5
ARM = ["arm-1"]


@pytest.fixture(params=["nats", "zenoh"])
def reached(request: pytest.FixtureRequest) -> Iterator[tuple[int, LinkConfig]]:
    """The port of the broker, or the one at which Zenoh peers of one machine meet."""
    if request.param == "zenoh":
        port = free_port()
        yield port, loopback_config(port)
        return
    with NatsServer() as server:
        yield server.port, LinkConfig(transport="nats", connect=(server.url,))


def silent(stack: ExitStack, port: int) -> list[socket.socket]:
    """Connect so often; each second socket sends a byte and no more."""
    made = []
    for number in range(SOCKETS):
        made.append(stack.enter_context(socket.create_connection(("127.0.0.1", port), 20.0)))
        if number % 2:
            made[-1].setblocking(False)
            try:
                made[-1].send(b"\x01")
            except OSError:  # the port hung up at once
                continue
    return made


def stopped(arm: Child, hand: Child) -> None:
    arm.ask("clear")
    arm.ask("move")
    report = hand.ask("stop", ARM, 20.0)
    assert report["ok"], report
    eventually(lambda: not arm.ask("facts")["arm-1"]["moving"])


def test_stops_pass_three_thousand_sockets_that_say_nothing(reached: tuple[int, LinkConfig]) -> None:
    port, link = reached
    with ExitStack() as stack:
        arm = stack.enter_context(robots(link, *ARM))
        hand = stack.enter_context(controller(link))
        eventually(lambda: hand.ask("stop", ARM, 5.0)["ok"], 30)
        silent(stack, port)
        for _ in range(STOPS):
            stopped(arm, hand)
        late = stack.enter_context(controller(link, "safety-2"))
        eventually(lambda: late.ask("stop", ARM, 5.0)["ok"], 60, "a stop of a controller that came meanwhile")
        stopped(arm, late)


def test_emergency_stop_of_the_mesh_passes_sockets_at_its_hub(tmp_path: object) -> None:
    with ExitStack() as stack:
        net = stack.enter_context(network("zenoh", tmp_path, APPROVED))  # type: ignore[arg-type]
        assert isinstance(net, OverZenoh)
        console, arm = net.join("console", "none"), net.join("arm-1", "arm")
        console.sees("arm-1")
        silent(stack, net.port)
        for _ in range(STOPS):
            arm.ask("clear")
            assert console.ask("send", "arm-1", WAVE, 20)["result"]["status"] == "success"
            assert [each["responder_id"] for each in console.ask("estop")[1]] == ARM
            assert (arm.ask("moving"), bool(arm.ask("epoch"))) == (False, True)
            console.ask("clear")
