"""Thousands of connections that say nothing, at the broker that a stop passes."""

from __future__ import annotations

import socket
from contextlib import ExitStack

from fixtures.nats_server import NatsServer
from fixtures.plane_process import planned
from fixtures.stop_controller import controller
from fixtures.waiting import eventually

from strands_robots.device_connect.backends import LinkConfig

SOCKETS, STOPS = 3000, 5
ARM = ["arm-1"]


def test_stops_pass_three_thousand_sockets_that_say_nothing() -> None:
    with ExitStack() as stack:
        server = stack.enter_context(NatsServer())
        link = LinkConfig(transport="nats", connect=(server.url,))
        robots = stack.enter_context(planned(ARM, link))
        hand = stack.enter_context(controller(link))
        eventually(lambda: hand.ask("stop", ARM, 5.0)["ok"])
        for _ in range(SOCKETS):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), 20.0))
        for _ in range(STOPS):
            robots.ask("clear")
            robots.ask("move")
            report = hand.ask("stop", ARM, 20.0)
            assert report["ok"], report
            assert not robots.ask("facts")["arm-1"]["moving"]
