"""Emergency stops of foreign robots that are read with trouble: each press is a halt, whatever the last one left."""

from __future__ import annotations

from functools import partial

import pytest
from fixtures.doubted_robots import DOUBTS, doubted
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect.backends import LinkConfig

PRESSES = 12
HANG_S = 30.0
"""Longer than the test waits, so that no return of a reading helps a press along."""


@pytest.mark.parametrize("transport", ["zenoh", "nats"])
def test_each_press_halts_every_robot_while_all_readings_hang(transport: str) -> None:
    with ZenohRouter() as router, NatsServer() as server:
        routed = LinkConfig(connect=(router.endpoint,), mode="client")
        link = routed if transport == "zenoh" else LinkConfig("nats", connect=(server.url,))
        with doubted(link, HANG_S, STRANDS_HALT_DEADLINE_S="20") as site, controller(link) as hand:
            eventually(lambda: site.ask("up") and hand.ask("up"))
            for press in range(1, PRESSES + 1):
                hand.ask("begin", list(DOUBTS), 20.0)
                for doubt in DOUBTS:
                    halted = partial(lambda doubt, press: len(site.ask("stops", doubt)) >= press, doubt, press)
                    eventually(halted, what=f"halt {press} of {doubt}")
            assert site.ask("threads") < 60
