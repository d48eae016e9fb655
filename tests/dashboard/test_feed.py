"""Robots of any network on the page: found, described, asked for their lockouts, followed."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted import OURS, ScriptedNetwork, function

from strands_robots.dashboard import feeds
from strands_robots.dashboard.feeds import FleetFeed
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.history import RobotRow
from strands_robots.envelope import error, success
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH

Row = RobotRow


class Page:
    """A feed of a scripted network, and its model."""

    def __init__(self, network: ScriptedNetwork) -> None:
        self.there, self.model = network, FleetModel()
        self.feed = FleetFeed(self.model, network)

    def row(self, robot: str) -> Row | None:
        return self.model.row(f"{self.feed.network}:{robot}")

    def shown(self, robot: str) -> Row:
        """Wait until a robot is shown with its lockouts."""
        eventually(lambda: (row := self.row(robot)) is not None and row.locked is not None, what=f"{robot} is shown")
        row = self.row(robot)
        assert row is not None
        return row

    def timeline(self) -> str:
        return self.model.changes(0)[1]


@pytest.fixture(params=[DEVICE_CONNECT, MESH])
def page(request: pytest.FixtureRequest) -> Iterator[Page]:
    network = ScriptedNetwork(request.param)
    network.announces_verbs = request.param == DEVICE_CONNECT
    network.open()
    opened = Page(network)
    yield opened
    opened.feed.close()


def test_robot_is_shown_with_its_verbs_under_the_network_key_of_the_page(page: Page) -> None:
    row = page.shown("arm-1")
    assert page.feed.network == {DEVICE_CONNECT: "dc", MESH: "mesh"}[page.there.name]
    assert (row.kind, row.model, row.locked, row.expected) == ("strands_robot", "so100", False, True)
    eventually(lambda: [form["name"] for form in row.forms] == ["moveTo", "getStatus", "stop"], what="its verbs")
    assert row.holdable


def test_robot_that_comes_later_is_found_without_waiting_for_the_next_search(page: Page) -> None:
    page.shown("arm-1")
    page.there.robots["arm-2"] = OURS
    began = time.monotonic()
    page.shown("arm-2")
    assert time.monotonic() - began < feeds.SEARCH_AGAIN_S / 2


def test_parts_of_a_world_have_no_card_and_cause_no_further_search(page: Page) -> None:
    page.shown("arm-1")
    page.there.children["cell__left"] = "cell"
    page.there.robots |= {"cell": OURS, "cell__left": OURS}
    page.shown("cell")
    assert page.row("cell__left") is None
    searches, asked = page.there.searches, len(page.there.asked)
    eventually(lambda: len(page.there.asked) >= asked + 6, what="further looks")
    assert page.there.searches == searches


def test_strangers_that_send_events_cause_one_search_a_second_at_most(page: Page) -> None:
    page.shown("arm-1")
    searches, began = page.there.searches, time.monotonic()

    def searched() -> bool:
        for number in range(100):
            page.there.say(f"stranger-{number}", "hello")
        return page.there.searches >= searches + 2

    eventually(searched, what="searches for the strangers")
    assert time.monotonic() - began >= feeds.SEARCH_SOON_S
    assert page.row("stranger-1") is None


def test_events_fill_the_row_and_only_rare_ones_the_timeline(page: Page) -> None:
    row = page.shown("arm-1")
    page.there.say("arm-1", "state", joints={"pan": 0.5}, part="left", frequent=True)
    page.there.say("arm-1", "presence", task={"state": "running", "instruction": "wave"}, frequent=True)
    page.there.say("arm-1", "health", load=0.25, frequent=True, alive=False)
    page.there.say("arm-1", "doorOpened", {"by": "desk"})
    assert row.joints == {"left": {"pan": 0.5}}
    assert row.task == {"state": "running", "instruction": "wave"}
    assert row.load == 0.25
    said = page.timeline()
    assert "doorOpened" in said and '"event": "state"' not in said and '"event": "presence"' not in said


def test_event_that_a_broker_kept_is_no_sign_of_life(page: Page) -> None:
    row = page.shown("arm-1")
    page.there.mute.add("arm-1")
    asked = len(page.there.asked)
    eventually(lambda: len(page.there.asked) > asked, what="a question that is not answered")
    before = row.heard
    page.there.say("arm-1", "locked", alive=False)
    assert row.heard == before
    page.there.say("arm-1", "started")
    assert row.heard != before


def test_silent_robots_keep_no_other_one_waiting_for_its_lockout(page: Page) -> None:
    page.shown("arm-1")
    silent = {f"silent-{number}": OURS for number in range(3 * feeds.PARALLEL)}
    page.there.mute |= set(silent)
    page.there.robots |= silent
    eventually(lambda: set(silent) <= set(page.there.asked), 60.0, what="every silent robot was asked once")
    # From now on those wait among themselves.
    eventually(lambda: page.there.asked.count("silent-0") >= 2, 60.0, what="a silent robot is asked again")
    for epoch in ("a" * 32, "b" * 32):
        page.there.locked["arm-1"] = epoch
        began = time.monotonic()
        eventually(
            lambda epoch=epoch: (row := page.row("arm-1")) and row.lockouts[:1] and row.lockouts[0]["epoch"] == epoch
        )  # type: ignore[misc]
        assert time.monotonic() - began < 2 * feeds.poll_interval(len(silent)) + 1.0


def test_robot_that_was_silent_is_described_anew_where_its_network_does_not_announce_verbs() -> None:
    network = ScriptedNetwork(MESH)
    network.announces_verbs = False
    page = Page(network)
    try:
        row = page.shown("arm-1")
        network.mute.add("arm-1")
        asked = network.asked.count("arm-1")
        eventually(lambda: network.asked.count("arm-1") >= asked + 3, what="it did not answer a question")
        network.robots["arm-1"] = (*OURS, function("brewCoffee"))
        network.mute.clear()
        eventually(lambda: "brewCoffee" in [form["name"] for form in row.forms], what="its new verb")
    finally:
        page.feed.close()


@pytest.fixture
def mesh_page() -> Iterator[Page]:
    network = ScriptedNetwork(MESH)
    network.announces_verbs = False
    opened = Page(network)
    yield opened
    opened.feed.close()


def test_silent_robots_delay_neither_the_verbs_of_another_one_nor_the_search(
    mesh_page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    there, released = mesh_page.there, threading.Event()
    describe = there.describe

    def blocked(robot: str, *, anew: bool = False) -> object:
        if robot in there.mute:
            released.wait(30.0)
        return describe(robot)

    monkeypatch.setattr(there, "describe", blocked)
    silent = {f"a-silent-{number}": OURS for number in range(60)}
    there.mute |= set(silent)
    there.robots |= silent
    try:
        eventually(lambda: set(silent) <= set(there.asked), what="every silent robot was asked")
        there.robots["z-lively"] = OURS
        row = mesh_page.shown("z-lively")
        eventually(lambda: len(row.forms) == 3, what="its verbs")
    finally:
        released.set()


def test_new_silent_robots_keep_no_new_one_waiting(mesh_page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "ASK_S", 60.0)
    silent = {f"a-silent-{number}": OURS for number in range(24)}
    mesh_page.there.mute |= set(silent)
    mesh_page.there.robots |= silent | {"z-lively": OURS}
    mesh_page.shown("z-lively")


def test_robot_has_the_verbs_of_its_kind_until_it_answers(mesh_page: Page) -> None:
    there = mesh_page.there
    there.of_kind = (function("getStatus", "read"),)
    there.mute.add("arm-2")
    there.robots["arm-2"] = OURS
    eventually(lambda: (row := mesh_page.row("arm-2")) is not None and row.forms, what="the verbs of its kind")
    row = mesh_page.row("arm-2")
    assert row is not None
    assert [form["name"] for form in row.forms] == ["getStatus"]
    there.mute.clear()
    eventually(lambda: "moveTo" in [form["name"] for form in row.forms], what="its own verbs")


def test_silent_robot_that_was_removed_is_asked_no_more(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "ASK_S", 0.1)
    page.shown("arm-1")
    page.there.mute.add("arm-2")
    page.there.robots["arm-2"] = OURS
    eventually(lambda: page.there.asked.count("arm-2") >= 2, what="a silent robot")
    del page.there.robots["arm-2"]
    assert page.model.forget(f"{page.feed.network}:arm-2", 0.0)

    def looks_without_it() -> int:
        return list(reversed(page.there.asked)).index("arm-2")

    # Both are asked in turn.
    eventually(lambda: looks_without_it() >= 8, what="looks at the other robot alone")


def test_forgotten_robot_is_met_anew_with_its_verbs(page: Page) -> None:
    page.shown("arm-1")
    assert page.model.forget("dc:arm-1" if page.there.name == DEVICE_CONNECT else "mesh:arm-1", 0.0)
    row = page.shown("arm-1")
    eventually(lambda: row.forms, what="its verbs")


def test_device_of_others_says_what_it_lacks(page: Page) -> None:
    page.there.robots["kettle"] = (function("boil"),)
    page.there.of_kind = (function("boil"),)
    row = page.shown("kettle")
    eventually(lambda: row.lacking == "no lockout, no lease, no stop", what="what it lacks")
    assert not row.holdable
    ours = page.shown("arm-1")
    eventually(lambda: ours.forms and not ours.lacking, what="one of ours lacks nothing")


def test_call_that_is_refused_is_an_answer_and_a_stop_is_graded(page: Page) -> None:
    page.there.answers["moveTo"] = lambda arguments: error("busy")
    moved = asyncio.run(page.feed.call("arm-1", "moveTo", {"x": 1.0}, 3.0))
    gone = asyncio.run(page.feed.call("arm-9", "moveTo", {}, 3.0))
    assert (moved["status"], gone["status"]) == ("error", "error")
    assert asyncio.run(page.feed.stop("arm-1"))["stopped"] is True
    assert page.there.stopped == ["arm-1"]


def test_closer_look_reads_limits_units_cameras_and_joints_within_bounds(page: Page) -> None:
    page.there.robots["arm-1"] = (*OURS, function("getFeatures"), function("listCameras"), function("getState"))
    page.there.answers |= {
        "getFeatures": lambda _: success("", joints={"pan": [-1, 1]}, joint_units={"pan": "radians"}),
        "listCameras": lambda _: success("", cameras=["front", *("x" * 1000 for _ in range(100))]),
        "getState": lambda _: success("", joints={"pan": 0.5}),
    }
    row = page.shown("arm-1")
    asyncio.run(page.feed.look_closer("arm-1"))
    assert (row.limits["pan"], row.units["pan"], row.joints[""]) == ((-1.0, 1.0), "radians", {"pan": 0.5})
    assert row.cameras[0] == "front"
    assert len(row.cameras) == feeds.CAMERAS_MAX
    assert max(map(len, row.cameras)) == feeds.CAMERA_NAME_MAX


def test_resume_frees_the_robots_and_names_the_network_that_is_gone(page: Page) -> None:
    page.there.locked["arm-1"] = "a" * 32
    assert page.feed.resume(["arm-1"], None, 1.0) == {"arm-1": (True, "free")}

    def gone(*_: Any, **__: Any) -> Any:
        raise feeds.RefusalError("the broker is gone")

    page.there.lockouts = gone  # type: ignore[method-assign]
    assert page.feed.resume(["arm-1"], None, 1.0) == {"arm-1": (False, "the broker is gone")}


def test_feed_that_is_closed_hears_nothing_more(page: Page) -> None:
    page.shown("arm-1")
    page.feed.close()
    assert page.there.subscribers == []


def test_network_that_fails_for_a_time_is_looked_at_again() -> None:
    network = ScriptedNetwork(MESH)
    network.unreachable = "the broker is gone"
    page = Page(network)
    try:
        eventually(lambda: network.searches, what="a search that fails")
        network.unreachable = ""
        page.shown("arm-1")
    finally:
        page.feed.close()
