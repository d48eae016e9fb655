"""Rows of one id on two networks: one robot or two, who is moved, and who is stopped."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import until
from tests.fleet.scripted import OURS, ScriptedNetwork

from strands_robots.dashboard import fleet_model, page_robots
from strands_robots.dashboard.feeds import Feeds
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.page_robots import PageRobot, PageRobots
from strands_robots.envelope import error, success
from strands_robots.errors import NoAnswerError
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks
from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity
from strands_robots.utils import ValidationError

FIRST, SECOND = "dc:both", "mesh:both"
SILENT_S = 0.6


def fed(model: FleetModel, *networks: ScriptedNetwork) -> Feeds:
    """Return the feeds of networks, which are joined."""
    joined = Networks(networks)
    feeds = Feeds(model, joined)
    joined.begin(here=True)
    return feeds


class Page:
    """A page of two networks that both have a robot of one id, which is looked at all the time."""

    def __init__(self) -> None:
        self.device_connect = ScriptedNetwork(DEVICE_CONNECT, {"both": OURS})
        self.mesh = ScriptedNetwork(MESH, {"both": OURS})
        self.networks = (self.device_connect, self.mesh)
        self.model = FleetModel()
        self.model.history.silent_s = SILENT_S
        self.feeds: Feeds | None = None
        self.in_use: set[str] = set()

    async def begin(self) -> None:
        self.feeds = fed(self.model, *self.networks)
        self.robots = PageRobots(self.model, self.feeds)
        self._looking = asyncio.create_task(self._look())
        await until(lambda: all(self.row(key) and self.row(key).locked is not None for key in (FIRST, SECOND)))

    async def _look(self) -> None:
        while True:
            self.robots.look(self.in_use)
            await asyncio.sleep(0.02)

    def row(self, key: str) -> Any:
        return self.model.row(key)

    def robot(self, key: str) -> PageRobot:
        return self.robots.of(key)

    def shown(self) -> list[str]:
        """The keys that a page which is opened now shows."""
        message = json.loads(self.model.changes(0)[1])
        return sorted({row["key"] for row in message["rows"]} - {*message["gone"]})

    def moved(self) -> list[str]:
        return [each.name for each in self.networks for call in each.calls if call[1] == "moveTo"]

    def close(self) -> None:
        self._looking.cancel()
        self.robots.close()
        if self.feeds is not None:
            self.feeds.close()


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    made = Page()
    yield made
    made.close()


@pytest.fixture
def keys(tmp_path: Path) -> list[SigningIdentity]:
    return [KeyFile(ROBOTS, name, tmp_path).load_or_make() for name in ("one", "two")]


@pytest.fixture
async def one(page: Page, keys: list[SigningIdentity]) -> Page:
    """A page on which both rows are of one robot."""
    for each in page.networks:
        each.sign_with(keys[0])
    await page.begin()
    await until(lambda: page.shown() == [FIRST], what="one row")
    return page


async def test_robot_whose_key_signs_on_both_networks_has_one_row(one: Page) -> None:
    assert one.row(FIRST).namesake is False
    assert SECOND in json.loads(one.model.changes(1)[1])["gone"], "an open page takes its card away"
    assert one.robots.twins(FIRST) == [FIRST, SECOND]
    answer = await one.robot(FIRST).call("moveTo", {"x": 1.0}, 3.0, moves=True)
    assert (answer["status"], one.moved()) == ("success", [DEVICE_CONNECT])


async def test_events_of_a_hidden_row_are_not_told_twice(one: Page) -> None:
    for each in one.networks:
        each.say("both", "doorOpened")
    said = json.loads(one.model.changes(0)[1])["events"]
    assert [each["key"] for each in said if each["event"] == "doorOpened"] == [FIRST]


async def test_second_row_comes_back_and_moves_the_robot_where_the_first_is_silent(one: Page) -> None:
    one.device_connect.mute.add("both")
    await until(lambda: one.shown() == [FIRST, SECOND], what="both rows")
    assert one.row(SECOND).namesake is True
    asked = one.device_connect.calls.copy()
    answer = await one.robot(SECOND).call("moveTo", {"x": 1.0}, 3.0, moves=True)
    assert (answer["status"], one.moved()) == ("success", [MESH])
    assert [call for call in one.device_connect.calls if call[2].get("nonce")] == [
        call for call in asked if call[2].get("nonce")
    ], "a silent network is not waited for"
    one.device_connect.mute.clear()
    await until(lambda: one.shown() == [FIRST], what="one row")


async def test_other_robot_that_takes_the_id_is_not_moved_in_the_place_of_a_silent_one(
    one: Page, keys: list[SigningIdentity]
) -> None:
    one.device_connect.mute.add("both")
    await until(lambda: one.shown() == [FIRST, SECOND], what="both rows")
    one.device_connect.answers["getStatus"] = NoAnswerError("it did not answer")
    one.mesh.sign_with(keys[1])
    one.mesh.sessions += 1
    answer = await one.robot(SECOND).call("moveTo", {"x": 1.0}, 3.0, moves=True)
    assert answer["code"] == page_robots.AMBIGUOUS
    assert one.moved() == []


async def test_robot_that_is_enrolled_on_an_absent_network_is_moved_by_its_key_alone(
    keys: list[SigningIdentity],
) -> None:
    near, gone = ScriptedNetwork(DEVICE_CONNECT, {"both": OURS}), ScriptedNetwork(MESH, {})
    gone.unreachable, gone.enrolled = "no hub", {"both": keys[0].public}
    model, networks = FleetModel(), Networks([near, gone], stays=True)
    feeds = Feeds(model, networks)
    robots = PageRobots(model, feeds)
    try:
        feeds.begin()
        await until(lambda: feeds.get("dc") and model.row(FIRST), what="its row")
        near.sign_with(keys[1])
        refused = await robots.of(FIRST).call("moveTo", {"x": 1.0}, 3.0, moves=True)
        assert "it is enrolled on mesh, which is not joined" in refused["reason"]
        near.sign_with(keys[0])
        assert (await robots.of(FIRST).call("moveTo", {"x": 1.0}, 3.0, moves=True))["status"] == "success"
    finally:
        robots.close()
        feeds.close()
        networks.close()


async def test_robot_that_is_silent_on_both_networks_keeps_one_row(one: Page) -> None:
    for each in one.networks:
        each.mute.add("both")
    await until(lambda: one.model.silent(one.row(FIRST)) and one.model.silent(one.row(SECOND)), what="silence")
    one.robots.look(set())
    assert one.shown() == [FIRST]


async def test_row_that_a_page_uses_stays(one: Page) -> None:
    one.in_use.add(SECOND)
    await until(lambda: one.shown() == [FIRST, SECOND], what="the row in use")


@pytest.mark.parametrize("state", ["not_stopped", "alarm", "refused", "unknown", "claimed", "silent"])
async def test_bad_answer_to_a_stop_is_never_hidden(one: Page, state: str) -> None:
    one.model.verdict("mesh", "both", {"id": "e" * 32, "state": state})
    await until(lambda: one.shown() == [FIRST, SECOND], what="the row with the answer")


@pytest.mark.parametrize("state", ["not_stopped", "unknown", "silent"])
async def test_bad_answer_that_one_robot_gives_on_both_networks_is_named_once(
    one: Page, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    monkeypatch.setattr(fleet_model, "UNANSWERED_S", 0.0)
    for network in ("dc", "mesh"):
        one.model.verdict(network, "both", {"id": "e" * 32, "state": state})
    one.robots.look(set())
    assert (one.shown(), one.row(FIRST).namesake) == ([FIRST], False)
    one.model.verdict("dc", "both", {"id": "e" * 32, "state": "stopped"})
    await until(lambda: one.shown() == [FIRST, SECOND], what="what only the second row says")


async def test_other_robot_that_takes_the_id_gets_its_row(one: Page, keys: list[SigningIdentity]) -> None:
    one.mesh.sign_with(keys[1])
    one.mesh.sessions += 1
    await until(lambda: one.shown() == [FIRST, SECOND], what="two rows")


@pytest.mark.parametrize("verb", ["moveTo", "acquireControl"])
async def test_two_robots_of_one_id_have_two_rows_and_are_moved_by_none(
    page: Page, keys: list[SigningIdentity], verb: str
) -> None:
    for network, key in zip(page.networks, keys, strict=True):
        network.sign_with(key)
    await page.begin()
    await until(lambda: page.row(FIRST).namesake and page.row(SECOND).namesake, what="rows with their networks")
    assert page.shown() == [FIRST, SECOND]
    for key in (FIRST, SECOND):
        answer = await page.robot(key).call(verb, {}, 3.0, moves=True)
        assert "device_connect and mesh both have a robot of this id" in answer["reason"]
        assert answer["code"] == page_robots.AMBIGUOUS
        assert (await page.robot(key).call("getStatus", {}, 3.0))["status"] == "success"
    assert not [call for each in page.networks for call in each.calls if call[1] == verb]


async def test_enrolled_robot_is_moved_by_its_own_row_alone(page: Page, keys: list[SigningIdentity]) -> None:
    for network, key in zip(page.networks, keys, strict=True):
        network.sign_with(key)
        network.enrolled = {"both": keys[1].public}
    await page.begin()
    refused = await page.robot(FIRST).call("moveTo", {}, 3.0, moves=True)
    assert "the enrolled robot of this id is on mesh" in refused["reason"]
    assert (await page.robot(SECOND).call("moveTo", {}, 3.0, moves=True))["status"] == "success"
    assert page.moved() == [MESH]
    assert page.shown() == [FIRST, SECOND]


async def test_robot_of_one_network_is_moved_without_a_question(page: Page) -> None:
    page.mesh.robots = {"sim-1": OURS}
    page.feeds = fed(page.model, *page.networks)
    page.robots = PageRobots(page.model, page.feeds)
    page._looking = asyncio.create_task(page._look())
    await until(lambda: page.row(FIRST) and page.row("mesh:sim-1"), what="the robots")
    assert (await page.robot(FIRST).call("moveTo", {}, 3.0, moves=True))["status"] == "success"
    assert not [call for each in page.networks for call in each.calls if "nonce" in call[2]]


Answer = Callable[..., Any]


@pytest.mark.parametrize(
    ("first", "second", "stopped"),
    [
        (success("", stopped=True), success("", stopped=True), True),
        (success("", stopped=True), error("no brakes", stopped=False), False),
        (error("no answer", stopped=None), success("", stopped=True), None),
        (error("no answer", stopped=None), error("no brakes", stopped=False), False),
    ],
)
async def test_halt_of_two_robots_of_one_id_reaches_both_and_the_worst_answer_counts(
    page: Page, first: Any, second: Any, stopped: bool | None
) -> None:
    await page.begin()
    page.device_connect.stops, page.mesh.stops = first, second
    for key in (FIRST, SECOND):
        assert (await page.robot(key).stop()).get("stopped") is stopped
    assert [each.stopped for each in page.networks] == [["both", "both"], ["both", "both"]]


async def test_halt_of_one_robot_counts_once_one_network_has_its_answer(
    one: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    never = asyncio.Event()

    async def silent(*_: object) -> Any:
        one.device_connect.stopped.append("both")
        await never.wait()

    monkeypatch.setattr(one.device_connect, "stop_async", silent)
    async with asyncio.timeout(5.0):
        assert (await one.robot(FIRST).stop())["stopped"] is True
    assert [each.stopped for each in one.networks] == [["both"], ["both"]]
    never.set()


async def test_row_of_a_network_that_is_not_joined_says_so() -> None:
    model = FleetModel()
    model.update("mesh", "sim-1")
    robots = PageRobots(model, Feeds(model, Networks(())))
    with pytest.raises(ValidationError, match="sim-1 is out of reach"):
        robots.of("mesh:sim-1")
    with pytest.raises(ValidationError, match="No robot"):
        robots.of("mesh:sim-2")
    robots.close()
