"""Foreign robots whose stop does nothing: no stop of theirs is green, whatever they answer."""

from __future__ import annotations

import pytest
from fixtures.lying_robots import ANSWERS, liars
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect.backends import LinkConfig

STOPS = 10


@pytest.mark.parametrize("transport", ["zenoh", "nats"])
def test_foreign_robots_that_stop_nothing_are_named_at_each_stop(transport: str) -> None:
    with ZenohRouter() as router, NatsServer() as server:
        routed = LinkConfig(connect=(router.endpoint,), mode="client")
        link = routed if transport == "zenoh" else LinkConfig("nats", connect=(server.url,))
        with liars(link, STRANDS_HALT_DEADLINE_S="0.2") as site, controller(link) as hand:
            eventually(lambda: site.ask("up") and hand.ask("up"))
            for _ in range(STOPS):
                report = hand.ask("stop", list(ANSWERS), 20.0)
                assert (set(report["not_stopped"]), report["stopped"], report["ok"]) == (set(ANSWERS), {}, False)
                site.ask("clear")
