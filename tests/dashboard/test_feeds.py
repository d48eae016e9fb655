"""Feeds of the page's networks: each made once its network is joined, now or later."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.dashboard import feeds as module
from strands_robots.dashboard.feeds import Feeds
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks


class Page:
    """Feeds of two scripted networks."""

    def __init__(self) -> None:
        self.device_connect, self.mesh = ScriptedNetwork(DEVICE_CONNECT), ScriptedNetwork(MESH, {"sim-1": ()})
        self.networks = Networks([self.device_connect, self.mesh], stays=True, unasked=[MESH])
        self.model = FleetModel()
        self.feeds = Feeds(self.model, self.networks)

    def names(self) -> list[str]:
        return [each.network for each in self.feeds.joined]


@pytest.fixture
def page() -> Iterator[Page]:
    made = Page()
    yield made
    made.feeds.close()
    made.networks.close()


def test_network_that_comes_later_is_shown_without_the_others_waiting_for_it(page: Page) -> None:
    page.device_connect.unreachable = "nothing listens there"
    page.feeds.begin()
    eventually(lambda: page.names() == ["mesh"], what="the mesh")
    ((name, missed),) = page.feeds.unsent.items()
    assert (name, missed().absent) == ("dc", "nothing listens there")
    eventually(lambda: page.model.row("mesh:sim-1"), what="a robot of the mesh")
    page.device_connect.unreachable = ""
    eventually(lambda: page.names() == ["dc", "mesh"], what="both, Device Connect first")
    eventually(lambda: page.model.row("dc:arm-1"), what="a robot of Device Connect")
    assert page.feeds.unsent == page.feeds.missing == {}


def test_only_networks_that_someone_asked_for_are_missing(page: Page) -> None:
    page.device_connect.unreachable, page.mesh.unreachable = "nothing listens there", "no mesh answers"
    page.feeds.begin()
    eventually(lambda: page.feeds.missing, what="a missing network")
    eventually(lambda: page.feeds.unsent["mesh"]().absent == "no mesh answers", what="an absent one")
    assert page.feeds.missing == {"dc": "nothing listens there"}


def test_network_whose_feed_cannot_be_made_is_told_and_tried_again(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "AGAIN_S", 0.02)
    subscribe = page.mesh.subscribe

    def fails(*_: Any) -> Any:
        raise RuntimeError("no events")

    monkeypatch.setattr(page.mesh, "subscribe", fails)
    page.feeds.begin()
    eventually(lambda: page.feeds.missing == {"mesh": "no events"}, what="the reason")
    eventually(lambda: page.names() == ["dc"], what="the other network")
    assert page.feeds.senders["mesh"] is page.mesh.controller, "stops leave on it all the same"
    monkeypatch.setattr(page.mesh, "subscribe", subscribe)
    eventually(lambda: page.names() == ["dc", "mesh"], what="both networks")
    assert page.feeds.missing == {}


def test_feed_of_a_network_that_is_joined_at_the_end_is_closed(page: Page) -> None:
    page.feeds.begin()
    eventually(lambda: len(page.names()) == 2, what="both networks")
    page.feeds.close()
    assert page.mesh.standing_for == page.device_connect.standing_for == []
    assert page.mesh.subscribers == page.device_connect.subscribers == []
    page.feeds.add(module.FleetFeed(page.model, page.mesh))
    assert page.mesh.subscribers == []


def test_stops_come_from_the_controller_of_the_network_which_knows_the_robots_of_the_page(page: Page) -> None:
    page.feeds.begin()
    eventually(lambda: page.model.expected("dc") == ("arm-1",), what="its robot")
    assert page.feeds.senders["dc"] is page.device_connect.controller
    assert page.device_connect.standing_for[0]() == ("arm-1",)
    eventually(lambda: page.feeds.senders.keys() == {"dc", "mesh"}, what="the mesh's as well")
