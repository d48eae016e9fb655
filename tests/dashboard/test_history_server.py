"""The history as the page's server sends it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.page_feed import PageFeed, page_feeds
from fixtures.waiting import eventually
from starlette.testclient import TestClient

from strands_robots.dashboard.access import Access, loopback_origins
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.server import Dashboard

ORIGIN = "http://127.0.0.1:8800"


class Site:
    """A server with three robots, and an open page with its ticket."""

    def __init__(self, client: TestClient, model: FleetModel) -> None:
        self.client, self.model = client, model
        self.ticket = ""

    def get(self, path: str, **query: Any) -> Any:
        return self.client.get(path, params={"ticket": self.ticket, **query})

    def lines(self, path: str, **query: Any) -> list[Any]:
        answer = self.get(path, **query)
        assert answer.status_code == 200, answer.text
        return [json.loads(line) for line in answer.text.splitlines()]


@pytest.fixture
def site() -> Iterator[Site]:
    model = FleetModel()
    for name in ("arm-1", "arm-2", "arm-3"):
        model.update("dc", name, kind="strands_robot")
        model.sign_of_life("dc", name)
    model.observe("dc", "arm-1", {"pan": 0.5, "lift": -1.0})
    app = Dashboard(model, page_feeds(model, PageFeed()), Access(loopback_origins(8800))).app()
    with TestClient(app, base_url=ORIGIN, client=("127.0.0.1", 4000)) as client:
        made = Site(client, model)
        with client.websocket_connect("ws://127.0.0.1:8800/state", headers={"origin": ORIGIN}) as socket:
            socket.send_json({"type": "hello"})
            made.ticket = socket.receive_json()["ticket"]
            yield made


def test_states_of_all_robots_are_sent_once_and_then_what_changed(site: Site) -> None:
    head, *rows = site.lines("/history")
    assert {row["key"]: row["as"] for row in rows} == {f"dc:arm-{number}": "s" for number in (1, 2, 3)}
    assert all(row["at"][0] <= head["now"] for row in rows)
    since = {"number": head["number"], "at": head["now"]}
    assert len(site.lines("/history", **since)) == 1
    site.model.task("dc", "arm-2", state="running")
    assert [(row["key"], row["as"]) for row in site.lines("/history", **since)[1:]] == [("dc:arm-2", "sm")]


def test_stops_are_those_of_the_pages_and_outlive_the_timeline(site: Site) -> None:
    address = "ws://127.0.0.1:8800/{}"
    with site.client.websocket_connect(address.format("stop"), headers={"origin": ORIGIN}) as stop:
        for message in ({"type": "hello"}, {"type": "stop", "id": 1}):
            stop.send_json(message)
        while stop.receive_json()["type"] != "pressed":
            pass
    with site.client.websocket_connect(address.format("state"), headers={"origin": ORIGIN}) as socket:
        for call in ({"type": "hello"}, {"type": "call", "id": 1, "key": "dc:arm-2", "verb": "stop"}):
            socket.send_json(call)
        eventually(lambda: len(site.lines("/history")[0]["stops"]) == 2, what="the halt")
    for number in range(1200):
        site.model.note("dc", "STOP pressed", "STOP pressed", {"button": number})
        site.model.note("dc", "arm-2", "halted here", {"stopped": True})
    stops = site.lines("/history")[0]["stops"]
    assert [(event, key) for event, _, key in stops] == [("STOP pressed", ""), ("halted here", "dc:arm-2")]
    assert time.time() - 60 < stops[0][1] <= stops[1][1] <= time.time()


def test_samples_of_one_robot_are_sent_a_line_a_series(site: Site) -> None:
    eventually(lambda: site.get("/series", robot="dc:arm-1").status_code == 200, what="the first sample")
    head, *rows = site.lines("/series", robot="dc:arm-1")
    assert [row["name"] for row in rows] == ["lag", "answer", "rate", "load", "joint:/pan", "joint:/lift"]
    assert all(len(row["values"]) == len(head["times"]) for row in rows)
    assert {row["name"]: row["values"][0] for row in rows}["joint:/lift"] == -1.0


@pytest.mark.parametrize("path", ["/history", "/series"])
def test_history_needs_the_ticket_of_an_open_page(site: Site, path: str) -> None:
    assert site.client.get(path, params={"robot": "dc:arm-1", "ticket": "guessed"}).status_code == 403


def test_series_of_no_robot_is_refused(site: Site) -> None:
    assert site.get("/series", robot="dc:nobody").status_code == 404


@pytest.mark.parametrize("number", ["nan", "inf", "-1e999", "x", "", "1e308"])
def test_impossible_numbers_of_a_query_raise_nothing(site: Site, number: str) -> None:
    assert site.get("/history", number=number, at=number).status_code == 200
