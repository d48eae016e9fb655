"""Verdicts of the page's STOP: stopped is said only of a robot that said so itself."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from typing import Any

import pytest
from fixtures.page_feed import page_feeds
from fixtures.waiting import eventually
from tests.fleet.scripted import OURS, ScriptedNetwork

from strands_robots.dashboard.feeds import Feeds
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.page_robots import FleetStop, verdict_of
from strands_robots.fleet import safety_console
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.roster import Roster
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.sightings import Known, RosterRow, sightings
from strands_robots.safety.statements import Proof
from strands_robots.safety.stop_roster import StopOutcome


def answer(name: str = "arm-1", stopped: bool | None = True, **more: Any) -> Answer:
    return Answer(name, stopped, 9.0, more.pop("why", ""), **more)


@pytest.mark.parametrize(
    ("given", "state"),
    [
        (answer(), "stopped"),
        (answer(proof=Proof.SIGNED, required=True), "stopped"),
        (answer(required=True), "claimed"),
        (answer(stopped=False, why="no brakes"), "not_stopped"),
        (answer(stopped=False, required=True), "not_stopped"),
        (answer(stopped=None), "unknown"),
        (answer(stopped=None, why="resumed before"), "refused"),
    ],
)
def test_answer_is_shown_as_what_it_proves(given: Answer, state: str) -> None:
    assert verdict_of(given, 0.0)["state"] == state


class Controller:
    """Answers a stop with what the test gives."""

    def __init__(self, report: StopReport) -> None:
        self.link_up = True
        self.controller_id = "dashboard"
        self.network = None
        self.report = report
        self.expected: Collection[str] = ()

    def press(self, estop_id: str) -> None:
        """Nothing to note."""

    def stop(self, expected: Collection[str], reason: str, *, estop_id: str, on_progress: Any) -> StopReport:
        self.expected = expected
        on_progress(
            Progress(estop_id, self.report.answered, self.report.unanswered, True, 150.0, alarms=self.report.alarms)
        )
        return self.report

    def review(self, report: StopReport) -> StopReport:
        return self.report


class Fed:
    """A feed of which only the controller is used."""

    network = "dc"

    def __init__(self, controller: Controller) -> None:
        self.controller = controller


def stopped_by(report: StopReport, *names: str) -> tuple[FleetModel, FleetStop, Controller]:
    model, controller = FleetModel(), Controller(report)
    for name in names:
        model.update("dc", name, expected=True)
    feeds = page_feeds(model, Fed(controller))
    stop = FleetStop(model, feeds)
    stop.press()
    feeds.buttons.close()
    eventually(lambda: not stop.running, what="the stop's end")
    stop.refresh()
    return model, stop, controller


def states(model: FleetModel) -> dict[str, str]:
    return {row.id: row.stop["state"] for row in model.rows() if row.stop is not None}


def test_every_robot_that_was_seen_must_answer() -> None:
    names = ("arm-1", "arm-2")
    report = StopReport("e" * 32, {each: answer(each) for each in names}, {}, {}, (), True, 20.0)
    model, _, controller = stopped_by(report, *names)
    assert set(controller.expected) == set(names)
    assert states(model) == dict.fromkeys(names, "stopped")


def test_refusing_robot_alarm_and_claim_are_each_shown_as_such() -> None:
    report = StopReport(
        "e" * 32,
        {"arm-1": answer("arm-1")},
        {"arm-2": answer("arm-2", stopped=False, why="no brakes"), "arm-5": answer("arm-5", stopped=None)},
        {},
        (),
        True,
        20.0,
        claimed={"arm-3": answer("arm-3", required=True)},
        alarms={"arm-4": "wrong key", "arm-1": "wrong key"},
    )
    model, _, _ = stopped_by(report, "arm-1", "arm-2", "arm-3", "arm-4", "arm-5")
    assert states(model) == {
        "arm-1": "stopped",
        "arm-2": "not_stopped",
        "arm-3": "claimed",
        "arm-4": "alarm",
        "arm-5": "unknown",
    }
    first = model.row("dc:arm-1")
    assert first is not None and first.stop is not None
    assert first.stop["alarm"] == "wrong key"


def test_robot_that_finds_later_that_it_did_not_stop_turns_red() -> None:
    report = StopReport("e" * 32, {"arm-1": answer("arm-1")}, {}, {}, (), True, 20.0)
    model, stop, controller = stopped_by(report, "arm-1")
    controller.report = StopReport("e" * 32, {}, {"arm-1": answer("arm-1", stopped=False)}, {}, (), True, 20.0)
    stop.refresh()
    assert states(model) == {"arm-1": "not_stopped"}


def test_page_is_told_that_it_cannot_stop_when_the_link_is_down_or_all_robots_are_silent() -> None:
    report = StopReport("e" * 32, {"arm-1": answer("arm-1")}, {}, {}, (), True, 20.0)
    model, stop, controller = stopped_by(report, "arm-1")
    model.sign_of_life("dc", "arm-1")
    assert stop.state()["can_stop"] is True
    controller.link_up = False
    assert stop.state()["can_stop"] is False
    controller.link_up = True
    model.clock = lambda: 10e9
    assert stop.state()["can_stop"] is False


class ScopedController(Controller):
    """Notes the scope of each stop."""

    network = None

    def __init__(self, report: StopReport) -> None:
        super().__init__(report)
        self.scopes: list[Scope] = []

    def stop(  # type: ignore[override]
        self, expected: Collection[str], reason: str, *, estop_id: str, on_progress: Any, scope: Scope = EVERY_ROBOT
    ) -> StopReport:
        self.scopes.append(scope)
        return super().stop(expected, reason, estop_id=estop_id, on_progress=on_progress)


def test_button_of_one_robot_stops_it_alone_and_shows_no_other_as_silent() -> None:
    model = FleetModel()
    controller = ScopedController(StopReport("e" * 32, {"arm-1": answer()}, {}, {}, (), True, 9.0))
    for name in ("arm-1", "arm-2"):
        model.update("dc", name, expected=True)
    stop = FleetStop(model, page_feeds(model, Fed(controller)))
    stop.press_one("arm-1")
    eventually(lambda: controller.scopes and not stop.running)
    stop.refresh()
    assert controller.scopes == [Scope.named(["arm-1"])]
    rows = {row.id: row.stop for row in model.rows()}
    assert rows["arm-1"] is not None and rows["arm-1"]["state"] == "stopped"
    assert rows["arm-2"] is None
    # What is no robot's button is that of all.
    stop.press_one("arm-9")
    stop.press_one("arm 1")
    eventually(lambda: len(controller.scopes) >= 2 and not stop.running)
    assert set(controller.scopes[1:]) == {EVERY_ROBOT}


def test_button_of_a_cell_stops_its_robots_and_those_without_a_cell() -> None:
    model = FleetModel()
    controller = ScopedController(StopReport("e" * 32, {}, {}, {}, (), True, 150.0))
    cells = {"arm-1": "cell-1", "arm-2": "cell-2", "arm-3": "", "arm-4": None}
    for name, cell in cells.items():
        model.update("dc", name, expected=True, cell=cell)
    stop = FleetStop(model, page_feeds(model, Fed(controller)))
    stop.press_cell("cell-1")
    eventually(lambda: controller.scopes and not stop.running)
    stop.refresh()
    assert controller.scopes == [Scope(cell="cell-1")]
    assert set(controller.expected) == {"arm-1", "arm-3", "arm-4"}
    assert {row.id for row in model.rows() if row.stop is not None} == {"arm-1", "arm-3", "arm-4"}
    assert stop.state()["pressed_for"] == "cell cell-1 and robots without a cell"


def test_button_of_a_cell_sends_nothing_on_a_network_whose_robots_are_all_in_another() -> None:
    model = FleetModel()
    controllers = {name: ScopedController(StopReport("e" * 32, {}, {}, {}, (), True, 9.0)) for name in ("dc", "mesh")}
    feeds = [Fed(each) for each in controllers.values()]
    feeds[1].network = "mesh"
    model.update("dc", "arm-1", expected=True, cell="cell-1")
    model.update("mesh", "arm-2", expected=True, cell="cell-2")
    stop = FleetStop(model, page_feeds(model, *feeds))
    stop.press_cell("cell-1")
    eventually(lambda: controllers["dc"].scopes and not stop.running)
    assert controllers["mesh"].scopes == [], "there it would become a stop of all"


@pytest.mark.parametrize("cell", ["cell-9", "", "cell 1", "*"])
def test_button_of_no_cell_is_that_of_all(cell: str) -> None:
    model = FleetModel()
    controller = ScopedController(StopReport("e" * 32, {}, {}, {}, (), True, 9.0))
    for name in ("arm-1", "arm-2"):
        model.update("dc", name, expected=True, cell=f"cell-{name[-1]}")
    stop = FleetStop(model, page_feeds(model, Fed(controller)))
    stop.press_cell(cell)
    eventually(lambda: controller.scopes and not stop.running)
    assert controller.scopes == [EVERY_ROBOT]
    assert set(controller.expected) == {"arm-1", "arm-2"}
    assert stop.state()["pressed_for"] == ""


def test_stop_of_a_cell_that_became_one_of_all_expects_all() -> None:
    model = FleetModel()
    controller = ScopedController(StopReport("e" * 32, {}, {}, {}, (), True, 300.0, widened=True))
    for name in ("arm-1", "arm-2"):
        model.update("dc", name, expected=True, cell=f"cell-{name[-1]}")
    stop = FleetStop(model, page_feeds(model, Fed(controller)))
    stop.press_cell("cell-1")
    eventually(lambda: controller.scopes and not stop.running)
    stop.refresh()
    assert {row.id for row in model.rows() if row.stop is not None} == {"arm-1", "arm-2"}
    assert stop.state()["pressed_for"] == ""


class Scripted(ScopedController):
    """The controller of a scripted network; a press on it is counted."""

    def __init__(self, name: str) -> None:
        super().__init__(StopReport("e" * 32, {name: answer(name)}, {}, {}, (), True, 9.0))
        self.presses = 0

    def press(self, estop_id: str) -> None:
        self.presses += 1


class Networked:
    """A page on Device Connect, which is joined, and on the mesh, which is not."""

    def __init__(self, *unasked: str) -> None:
        self.there, self.gone = ScriptedNetwork(DEVICE_CONNECT), ScriptedNetwork(MESH, {"sim-1": OURS})
        self.there.controller, self.gone.controller = Scripted("arm-1"), Scripted("sim-1")
        self.gone.unreachable = "no mesh answers"
        self.networks = Networks([self.there, self.gone], stays=True, unasked=unasked)
        self.model = FleetModel()
        self.feeds = Feeds(self.model, self.networks)
        self.stop = FleetStop(self.model, self.feeds)
        self.feeds.begin()
        eventually(lambda: self.feeds.get("dc") and MESH in self.networks.absent, what="the first attempts")

    def roster(self, *names: str) -> None:
        """Have this machine remember robots of the mesh."""
        for name in names:
            sightings().note(self.gone.key, name)
        eventually(lambda: {*names} <= {row.name for row in Roster.of(self.gone.key).rows}, what="the roster")

    def comes(self) -> None:
        """Have the mesh come."""
        self.gone.unreachable = ""
        eventually(lambda: self.feeds.get("mesh"), what="the mesh")

    def refreshed(self) -> dict[str, Any]:
        self.stop.refresh()
        return self.stop.state()


@pytest.fixture
def networked() -> Iterator[Callable[..., Networked]]:
    made: list[Networked] = []

    def make(*unasked: str) -> Networked:
        made.append(Networked(*unasked))
        return made[-1]

    yield make
    for each in made:
        each.feeds.close()
        each.networks.close()


def test_stop_of_all_names_the_robots_of_the_roster_on_a_network_that_is_not_joined(
    networked: Callable[..., Networked],
) -> None:
    page = networked(MESH)
    page.roster("sim-1", "sim-2")
    page.stop.press()
    assert page.there.controller.presses == 1
    eventually(lambda: page.model.row("mesh:sim-2"), what="the robots that were missed")
    for name in ("sim-1", "sim-2"):
        row = page.model.row(f"mesh:{name}")
        assert row is not None and row.stop is not None
        assert (row.stop["state"], row.stop["why"]) == ("silent", "the stop did not leave: no mesh answers")
    told = page.refreshed()
    assert told["missing"] == {}, "no one asked for the mesh"
    assert told["roster"]["mesh"]["ok"] is False
    assert told["roster"]["mesh"]["sentence"].startswith("It did not leave on mesh: no mesh answers.")


def test_network_without_a_robot_in_the_roster_spoils_no_verdict(networked: Callable[..., Networked]) -> None:
    page = networked()
    page.stop.press()
    assert page.refreshed()["missing"] == {"mesh": "no mesh answers"}
    eventually(lambda: not any(each.name == "missed robots" for each in threading.enumerate()), what="its roster")
    assert "mesh" not in page.refreshed()["roster"]


def test_press_leaves_on_a_network_once_it_is_joined(networked: Callable[..., Networked]) -> None:
    page = networked()
    page.roster("sim-1")
    page.stop.press()
    eventually(lambda: "mesh" in page.refreshed()["roster"], what="the network that was missed")
    page.comes()
    assert page.gone.controller.presses == 1
    eventually(lambda: page.refreshed() and states(page.model).get("sim-1") == "stopped", what="its answer")
    assert "mesh" not in page.refreshed()["roster"]


def test_press_of_long_ago_does_not_leave_on_a_network_that_comes_later(
    networked: Callable[..., Networked], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = networked(MESH)
    page.stop.press()
    eventually(lambda: not page.stop.running, what="the stop's end")
    monkeypatch.setattr(safety_console, "LATE_S", 0.0)
    page.comes()
    assert page.gone.controller.presses == 0


def test_press_leaves_on_a_stop_link_of_its_own_before_the_network_is_joined() -> None:
    there = ScriptedNetwork(DEVICE_CONNECT)
    there.has_stop_link, there.unreachable, there.controller = True, "nothing listens there", Scripted("arm-1")
    networks, model = Networks([there], stays=True), FleetModel()
    feeds = Feeds(model, networks)
    stop = FleetStop(model, feeds)
    try:
        feeds.begin()
        stop.press()
        assert there.controller.presses == 1
        eventually(lambda: networks.absent, what="the first attempt")
        assert stop.state()["missing"] == {"dc": "nothing listens there"}
        there.unreachable = ""
        eventually(lambda: feeds.joined, what="the network")
        assert (len(there.standing_for), there.controller.presses) == (1, 1)
    finally:
        feeds.close()
        networks.close()
    assert there.standing_for == []


def test_robot_on_both_networks_is_none_of_others_in_a_stop_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    model = FleetModel()
    feeds = [Fed(Controller(StopReport("e" * 32, {"arm-1": answer()}, {}, {}, (), True, 9.0))) for _ in range(2)]
    feeds[1].network = "mesh"
    made = page_feeds(model, *feeds)
    stop = FleetStop(model, made)
    stop.press()
    eventually(lambda: not stop.running, what="the stop's end")
    for (name, _), button in made.buttons.every.items():
        key = ScriptedNetwork(name).key
        roster = Roster(key, (RosterRow("arm-1", Known.ENROLLED),), elsewhere=2)
        assert button.report is not None
        button.outcome = StopOutcome(button.report, button.report, roster)
    notes = [each["notes"] for each in stop.state()["roster"].values()]
    assert [" ".join(each).count("1 robot of other networks") for each in notes] == [1, 1]


def test_network_without_link_and_robot_is_waited_for_by_no_stop_and_alarms_no_one() -> None:
    model = FleetModel()
    near, far = (ScopedController(StopReport("e" * 32, {}, {}, {}, (), up, 9.0)) for up in (True, False))
    far.link_up = False
    feeds = [Fed(near), Fed(far)]
    feeds[1].network = "mesh"
    made = page_feeds(model, *feeds)
    stop = FleetStop(model, made)
    model.update("dc", "arm-1", expected=True)
    model.sign_of_life("dc", "arm-1")
    stop.press()
    eventually(lambda: made.buttons.every["mesh", EVERY_ROBOT].report is not None, what="a stop that does not leave")
    assert made.buttons.every["mesh", EVERY_ROBOT].running
    assert (stop.state()["links"], stop.state()["can_stop"]) == ({"dc": True}, True)
    eventually(lambda: not made.buttons.every["dc", EVERY_ROBOT].running, what="the other's end")
    assert not stop.running
    model.update("mesh", "sim-1", expected=True)
    assert (stop.state()["links"], stop.state()["can_stop"]) == ({"dc": True, "mesh": False}, False)
    assert stop.running
    made.buttons.close()


def test_network_that_is_joined_without_a_press_gets_none(networked: Callable[..., Networked]) -> None:
    page = networked()
    eventually(lambda: page.model.row("dc:arm-1"), what="the robot")
    page.stop.press_one("arm-1")
    page.comes()
    page.refreshed()
    assert page.gone.controller.presses == 0


def test_page_without_any_network_cannot_stop() -> None:
    model = FleetModel()
    assert FleetStop(model, page_feeds(model)).state()["can_stop"] is False


def test_button_of_one_robot_reaches_each_network_that_has_its_id() -> None:
    model = FleetModel()
    controllers = {
        name: ScopedController(StopReport("e" * 32, {}, {}, {}, (), True, 9.0)) for name in ("dc", "mesh", "other")
    }
    feeds = []
    for name, controller in controllers.items():
        feeds.append(Fed(controller))
        feeds[-1].network = name
        model.update(name, "arm-2" if name == "other" else "arm-1", expected=True)
    stop = FleetStop(model, page_feeds(model, *feeds))
    stop.press_one("arm-1")
    eventually(lambda: not stop.running and controllers["dc"].scopes and controllers["mesh"].scopes)
    assert controllers["dc"].scopes == controllers["mesh"].scopes == [Scope.named(["arm-1"])]
    assert controllers["other"].scopes == [], "there it would become a stop of all"
