"""Nothing on the page moves by itself or after a press: Chromium counts what it lays out elsewhere.

Entries soon after an input count as well, which browsers leave out of their own score.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.page_driving import card, hold, open_robot, take, verb_form
from fixtures.page_feed import forms_of
from fixtures.page_site import picture, shows
from fixtures.served_page import FORMS, ServedPage
from fixtures.waiting import eventually

from strands_robots.envelope import error, success
from strands_robots.safety.answers import Answer

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WATCH = """
window.shifts = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.shifts.push([entry.value, ...entry.sources.map(
    (each) => `${each.node ? each.node.id || each.node.className || each.node.nodeName : "?"}: ` +
      `${each.previousRect.x},${each.previousRect.y} ${each.previousRect.width}x${each.previousRect.height} to ` +
      `${each.currentRect.x},${each.currentRect.y} ${each.currentRect.width}x${each.currentRect.height}`)]);
}).observe({ type: "layout-shift", buffered: true });
"""
STATED = {"type": "string", "description": "Name of the object; empty to give its place"}
READS = forms_of([{"name": name, "labels": {"direction": "read"}} for name in ("getObjects", "getPose")])
SEES = (*FORMS, *forms_of([{"name": "getPicture", "labels": {"direction": "read"}}]))
PICK = forms_of(
    [
        {
            "name": "pick",
            "labels": {"direction": "write"},
            "parameters": {
                "properties": {
                    "object": STATED,
                    "x": {"type": "number", "description": "x of its centre, in metres"},
                    "yaw": {"type": "number", "description": "Degrees by which it is turned"},
                    "speed": {"type": "number", "description": "Share of full speed", "default": 0.5},
                    "picture": {"type": "string", "description": "Camera, as listCameras has it"},
                }
            },
        }
    ]
)
OBJECTS = {"red_cube": {"x": 0.24, "y": 0.09}, "plate": {"x": 0.2, "y": -0.14}}
SIZES = [pytest.param((1280, 800), id="desk"), pytest.param((360, 740), id="phone")]


@pytest.fixture(params=SIZES)
def still(request: pytest.FixtureRequest, chrome: Any, served: ServedPage) -> Any:
    """A page at two sizes that counts what moves."""
    width, height = request.param
    context = chrome.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.add_init_script(WATCH)
    page.goto(served.url)
    yield page
    context.close()


def settle(page: Any) -> None:
    """Let what was asked for be laid out and reported."""
    page.evaluate(
        "new Promise((yes) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(yes, 100))))"
    )


def unmoved(page: Any, what: str) -> None:
    settle(page)
    assert page.evaluate("window.shifts") == [], what


def locked(served: ServedPage, name: str, *, by: str = "dashboard") -> None:
    row = {"epoch": "e" * 32, "source": by, "since": time.time(), "reason": "STOP on the operator's page"}
    served.model.update("dc", name, locked=True, lockouts=[row])


def alive(served: ServedPage, *names: str) -> Callable[[], None]:
    def tell() -> None:
        for name in names:
            served.model.sign_of_life("dc", name, 3.0)

    return tell


def test_a_move_is_counted_at_all(still: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    card(still, "arm-1").wait_for()
    still.evaluate("document.querySelector('.tools').style.height = '9rem'")
    eventually(lambda: still.evaluate("window.shifts.length"), what="the shift of the cards")


def test_cards_stay_where_they_are(still: Any, served: ServedPage) -> None:
    for name in ("arm-2", "arm-4"):
        served.robot(name)
        card(still, name).wait_for()
        unmoved(still, f"{name} came")
    before = card(still, "arm-2").bounding_box()
    for name in ("arm-1", "arm-3"):
        served.robot(name)
        card(still, name).wait_for()
        unmoved(still, f"{name} came between")
    served.model.task("dc", "arm-4", state="running", instruction="stack the blue cups " * 8, step=4)
    card(still, "arm-4").get_by_text("running").wait_for()
    unmoved(still, "a motion began")
    served.model.task("dc", "arm-4", state="idle")
    card(still, "arm-4").get_by_text("idle").wait_for()
    unmoved(still, "a motion ended")
    served.model.update(
        "dc", "arm-3", locked=None, doubt="its answer is signed by nobody that is known here", alarm=True
    )
    card(still, "arm-3").get_by_text("Lockout not known").wait_for()
    unmoved(still, "a doubt")
    still.locator(".card[data-key='dc:arm-2'] .halt").click()
    card(still, "arm-2").get_by_text("Halted at").wait_for()
    unmoved(still, "a halt and its answer")
    served.model.forget("dc:arm-1", -1.0)
    eventually(lambda: card(still, "arm-1").count() == 0, what="arm-1 is gone")
    unmoved(still, "a robot went")
    assert card(still, "arm-2").bounding_box() == before
    served.model.update("dc", "arm-2", forms=SEES, model="so101")
    card(still, "arm-2").get_by_text("so101").wait_for()
    unmoved(still, "a robot told that it has a camera")
    assert card(still, "arm-2").bounding_box() == before
    still.locator("#sort").click()
    card(still, "arm-2").locator(".shot").wait_for()


@pytest.mark.parametrize(("view", "place"), [("History", ".lane"), ("Cameras", ".tile:has(.name[href])")])
def test_rows_under_a_filter_stay_where_they_are(still: Any, served: ServedPage, view: str, place: str) -> None:
    def moves(*numbers: int) -> None:
        for number in range(4):
            served.model.task("dc", f"arm-{number}", state="running" if number in numbers else "idle")

    def seen() -> list[str]:
        return [str(text) for text in still.locator(f"{place} a, {place} .lane-name").all_inner_texts()]

    for number in range(4):
        served.robot(f"arm-{number}", forms=SEES)
    moves(1, 2, 3)
    shows(still, "document.querySelectorAll('.card').length === 4")
    still.select_option("#filter", "moving")
    shows(still, "document.querySelectorAll('.card').length === 3")
    still.locator("#views a", has_text=view).click()
    eventually(lambda: seen() == ["arm-1", "arm-2", "arm-3"], what="the robots that move")
    places = {each: still.locator(place, has_text=each).bounding_box() for each in ("arm-2", "arm-3")}
    settle(still)
    still.evaluate("window.shifts = []")
    moves(2, 3)
    eventually(lambda: [each for each in seen() if each] == ["arm-2", "arm-3"], what="arm-1 is not seen")
    moves(3)
    eventually(lambda: [each for each in seen() if each] == ["arm-3"], what="arm-2 is not seen")
    moves(0, 2, 3)
    eventually(lambda: [each for each in seen() if each] == ["arm-2", "arm-3", "arm-0"], what="arm-0 comes last")
    assert {each: still.locator(place, has_text=each).bounding_box() for each in places} == places
    unmoved(still, "robots pass the filter, and pass no more")
    if view == "History":
        assert still.locator(".lane").count() == 4


def test_a_stop_and_its_answers_move_nothing(still: Any, served: ServedPage) -> None:
    link = served.feed.controller
    for number in range(4):
        served.robot(f"arm-{number}")
    card(still, "arm-3").wait_for()
    link.verdicts["arm-1"] = Answer("arm-1", False, 9.0, "no brakes, and a reason that is longer than any line")
    still.keyboard.press("Space")
    still.locator("#stop-said li[data-key='dc:arm-1'][data-state='not_stopped']").wait_for()
    unmoved(still, "the answers by name")
    link.verdicts["arm-1"] = Answer("arm-1", True, 9.0, "")
    still.locator("#stop").click()
    still.locator("#stop-said li[data-key='dc:arm-1'][data-state='stopped']").wait_for()
    unmoved(still, "a second stop")
    for number in range(4):
        locked(served, f"arm-{number}")
    still.locator("#resume summary").wait_for()
    unmoved(still, "the lockout, and the way to a resume")
    still.locator("#resume summary").click()
    still.locator(".sheet").wait_for()
    unmoved(still, "the resume is opened")
    picture(still, f"still-resume-{still.viewport_size['width']}")
    link.link_up = False
    shows(still, "!document.getElementById('alarm').hidden", 30.0)
    unmoved(still, "the network is lost")
    served.stop_serving()
    shows(still, "document.getElementById('alarm').textContent.includes('NOT CONNECTED')", 30.0)
    unmoved(still, "the server is lost")
    still.locator("#stop").click()
    shows(still, "document.getElementById('alarm').textContent.includes('NOT SENT')")
    unmoved(still, "a press that is not sent")
    with ServedPage(served.port) as again:
        again.robot("arm-1")
        shows(still, "document.getElementById('link').textContent === 'Connected'", 30.0)
        unmoved(still, "another server")


def test_a_pad_stays_under_the_pointer(still: Any, served: ServedPage) -> None:
    served.robot("arm-1", limits={"pan": (-1.0, 1.0), "lift": (-1.0, 1.0)})
    served.model.observe("dc", "arm-1", {"pan": 0.1, "lift": 0.2})
    button = take(still)
    unmoved(still, "the view is opened, and control is taken")
    place = button.bounding_box()
    for _ in range(3):
        hold(still, button)
        still.locator(".drive .said", has_text="Moving pan +").wait_for()
        served.model.task("dc", "arm-1", state="running", instruction="moveJoints pan 45.0, lift 10.0", step=3)
        assert button.bounding_box() == place
        still.mouse.up()
        still.locator(".drive .said", has_text="Stopped (").wait_for()
        assert button.bounding_box() == place
        served.model.task("dc", "arm-1", state="idle")
    assert {next(iter(each["joints"])) for each in served.feed.asked("moveJoints")} == {"pan"}, "one joint moves"
    served.feed.answers["moveJoints"] = [
        error("pan would leave its range, which ends at 90 degrees. " * 4, code="range")
    ]
    hold(still, button)
    still.locator(".drive .said", has_text="It does not move").wait_for()
    still.mouse.up()
    unmoved(still, "a refusal")
    locked(served, "arm-1", by="desk-1")
    still.locator("#robot .lock", has_text="LOCKED by desk-1").wait_for()
    still.locator(".drive .control", has_text="It is LOCKED").wait_for()
    unmoved(still, "a lockout")
    assert button.bounding_box() == place
    picture(still, f"still-drive-{still.viewport_size['width']}")


def test_pads_keep_their_places_when_other_joints_are_told(page: Any, served: ServedPage) -> None:
    def titles() -> list[str]:
        return [str(each) for each in page.locator(".pads legend").all_inner_texts()]

    served.robot("arm-1")
    served.model.observe("dc", "arm-1", {"pan": 0.1, "lift": 0.2})
    button = take(page)
    assert titles() == ["Joints", "Gripper's pose", "Gripper"]
    hold(page, button)
    eventually(lambda: served.feed.asked("moveJoints"), what="the jog")
    served.model.observe("dc", "arm-1", {"pan": 0.1, "lift": 0.2, "wrist": 0.3})
    page.locator("button.jog[aria-label='wrist +']").wait_for()
    assert titles() == ["Joints", "Gripper's pose", "Gripper"]
    page.locator(".drive .said", has_text="Stopped (").wait_for()
    page.mouse.up()


def test_events_and_results_are_read_in_their_own_places(still: Any, served: ServedPage) -> None:
    served.robot("arm-1", forms=(*FORMS, *READS, *PICK), cameras=("front", "wrist"))
    served.feed.answers["getObjects"] = [success("2 objects.", objects=OBJECTS)]
    served.feed.answers["pick"] = [
        success("Holding red_cube.", reached={"x": 0.24}, holding=True, ended_at=1795479780.3)
    ]
    open_robot(still)
    for number in range(60):
        served.model.note("dc", "arm-1", "policyComplete", {"steps": number, "t": 1795479780.3})
    eventually(lambda: still.locator(".events li").count() == 60, what="60 events")
    unmoved(still, "events")
    assert "1795479780" not in still.locator(".events").inner_text(), "times, no epochs"
    form = verb_form(still, "pick")
    unmoved(still, "a form")
    assert form.locator(".asked .field").count() == 2
    assert form.locator(".more .field").count() == 3 and not form.locator(".more .field").first.is_visible()
    assert form.locator("#p-pick-object option").all_inner_texts() == ["(not given)", "red_cube", "plate"]
    assert form.locator("#p-pick-picture option").all_text_contents() == ["(not given)", "front", "wrist"]
    form.locator("#p-pick-object").select_option("red_cube")
    form.get_by_role("button", name="Run").click()
    form.locator(".said[data-tone='good'] table").first.wait_for()
    unmoved(still, "a result")
    assert served.feed.asked("pick")[0]["object"] == "red_cube"
    assert "1795479780" not in form.locator(".said").inner_text()
    form.get_by_text("More: 3 fields").click()
    unmoved(still, "the other fields")
    labels, fields = form.locator("label").all(), form.locator("select, input").all()
    for label, field in zip(labels, fields, strict=True):
        one, other = label.bounding_box(), field.bounding_box()
        assert one["x"] + one["width"] <= other["x"] and abs(one["y"] - other["y"]) < 30, (
            "the label is beside its field"
        )


# One robot, one cell, all robots.


def test_button_of_a_cell_is_there_where_the_robot_is_in_one(still: Any, served: ServedPage) -> None:
    served.robot("arm-1", cell="cell-1")
    served.robot("arm-2")
    open_robot(still, "arm-2")
    assert not still.locator(".stop-cell").is_visible()
    served.model.update("dc", "arm-2", cell="cell-2")
    unmoved(still, "the cell was told later")
    still.locator("#robot .back a").click()
    open_robot(still, "arm-1")
    button = still.locator(".stop-cell")
    picture(still, f"stop-cell-{still.viewport_size['width']}")
    button.click()
    scopes = served.feed.controller.scopes
    eventually(lambda: [str(each) for each in scopes] == ["cell cell-1 and robots without a cell"], what="its stop")
    still.locator("#stop").click()
    eventually(lambda: len(scopes) == 2 and scopes[1].everything, what="the big button is that of all")


def test_halt_ends_the_motion_of_one_robot_alone(still: Any, served: ServedPage) -> None:
    for name in ("arm-1", "arm-2"):
        served.robot(name)
    button = card(still, "arm-2").get_by_role("button", name="Halt arm-2")
    button.wait_for()
    button.click()
    card(still, "arm-2").get_by_text("Halted at").wait_for()
    assert served.feed.stops == 1 and served.feed.controller.presses == []
    stop = card(still, "arm-2").locator(".stop-one")
    assert stop.bounding_box()["y"] > button.bounding_box()["y"] + 100
    radius = "getComputedStyle(document.querySelector('.card .{}')).borderRadius"
    assert still.evaluate(radius.format("halt")) != still.evaluate(radius.format("stop-one"))
    served.feed.stop_answer = error("the bus is silent.", stopped=None)
    button.click()
    said = card(still, "arm-2").get_by_text("NOT HALTED: press STOP. the bus is silent.")
    said.wait_for()
    box, around = said.bounding_box(), card(still, "arm-2").bounding_box()
    assert box["y"] + box["height"] <= around["y"] + around["height"], "the answer is inside of the card"
    picture(still, f"not-halted-{still.viewport_size['width']}")
    assert served.feed.controller.presses == []
    open_robot(still, "arm-2")
    box = still.locator("#robot .halt").bounding_box()
    assert box["y"] + box["height"] < still.viewport_size["height"], "on the first screen"
    if still.viewport_size["width"] == 360:
        assert still.evaluate("getComputedStyle(document.querySelector('.jog'), '::after').content") == "none"
        assert still.evaluate("document.documentElement.scrollWidth") <= 360


@pytest.mark.parametrize("where", [".halt", "button.jog:enabled", ".take", "form[data-verb='execute'] button", "#stop"])
def test_space_stops_all_on_any_control_that_moves_a_robot(page: Any, served: ServedPage, where: str) -> None:
    served.robot("arm-1")
    served.model.observe("dc", "arm-1", {"pan": 0.1})
    take(page)
    verb_form(page, "execute")
    page.locator(where).first.focus()
    page.keyboard.press("Space")
    eventually(lambda: len(served.feed.controller.presses) == 1, what="one emergency stop")
    assert not served.feed.asked("moveJoints") and not served.feed.asked("execute")
    assert served.feed.stops == 0, "the button itself was not pressed"
    assert page.locator(".take").inner_text() == "Give control back"


@pytest.mark.parametrize("where", ["#camera-name", "#jog-speed", "#timeline-filter", "#robot .back a"])
def test_space_in_a_text_on_a_list_or_on_a_link_stops_nothing(page: Any, served: ServedPage, where: str) -> None:
    served.robot("arm-1", cameras=("front",))
    open_robot(page)
    shows(page, "!document.getElementById('camera-name').disabled")
    page.locator(where).focus()
    page.keyboard.press("Space")
    settle(page)
    page.keyboard.press("Escape")
    page.locator("#theme").focus()
    page.keyboard.press("Space")
    eventually(lambda: len(served.feed.controller.presses) == 1, what="the press elsewhere, and no other")


# Units.


def test_joints_are_told_in_degrees_with_their_ranges(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", limits={"pan": (-1.5708, 1.5708)}, units={"pan": "radians"})
    served.model.observe("dc", "arm-1", {"pan": 0.7854})
    open_robot(page)
    bar = page.locator(".bar")
    assert bar.locator(".value").inner_text() == "45.0\u00b0"
    assert bar.locator(".end").all_inner_texts() == ["-90", "90"]
    assert page.locator(".legend li").all_inner_texts() == ["pan"]


def test_joints_of_a_motion_are_asked_for_in_their_units(page: Any, served: ServedPage) -> None:
    described = {
        "joints": {"type": "object", "description": "Degrees by joint name, metres for a slide; joints left out stay"}
    }
    moves = {"name": "moveJoints", "labels": {"direction": "write"}}
    joints = forms_of([{**moves, "parameters": {"properties": described, "required": ["joints"]}}])
    served.robot("arm-1", forms=(*joints, *READS), units={"pan": "radians", "lift": "radians", "rail": "metres"})
    served.model.observe("dc", "arm-1", {"pan": 0.7854})
    served.feed.answers["getPose"] = [success("here", joints={"pan": 45.0, "lift": 0.0, "rail": 0.1234})]
    open_robot(page)
    form = verb_form(page, "moveJoints")
    assert form.get_by_label("rail, m").get_attribute("placeholder") == "stays at 0.123"
    form.get_by_label("lift, \u00b0").fill("12.5")
    form.get_by_role("button", name="Run").click()
    eventually(lambda: served.feed.asked("moveJoints"), what="the motion")
    assert served.feed.asked("moveJoints")[0]["joints"] == {"lift": 12.5}


def test_takeovers_are_among_the_events(page: Any, served: ServedPage) -> None:
    from strands_robots.fleet.adapter import LockoutReport  # noqa: PLC0415 - this test alone

    served.robot("arm-1")
    for holder in ("", "agent-a", "agent-b", ""):
        facts = {"control": {"held": bool(holder), "holder": holder, "kind": "agent"}}
        served.model.report("dc", LockoutReport("arm-1", facts=facts))
    open_robot(page)
    wanted = ["Control acquired", "Control taken over", "Control given back"]
    eventually(lambda: page.locator(".events strong").all_inner_texts() == wanted, what="the changes of control")
