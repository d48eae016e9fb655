"""Reading the page: the timeline's filter, the 3-D pose of an arm without a picture, and what a screen reader is told.

A screen reader reads Chromium's accessibility tree, which these tests read in its place.
"""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import pytest
from fixtures.page_driving import open_robot, verb_form
from fixtures.page_feed import forms_of
from fixtures.page_site import picture, shows
from fixtures.served_page import FORMS, ServedPage
from fixtures.waiting import eventually
from PIL import Image

from strands_robots.envelope import error, success
from strands_robots.safety.answers import Answer

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

POSED = {
    "model": "so101",
    "joints": {"shoulder_pan": 20, "shoulder_lift": -30, "elbow_flex": 30, "wrist_flex": 50, "wrist_roll": 0},
    "gripper": 0.5,
}
READS_POSE = (*FORMS, *forms_of([{"name": "getPose", "labels": {"direction": "read"}}]))


def events(page: Any) -> list[str]:
    return [str(text) for text in page.locator(".events strong").all_text_contents()]


def test_timeline_shows_one_robot_and_is_filtered_by_kind_and_by_text(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    served.robot("arm-2")
    served.model.note("dc", "arm-1", "policyStarted", {"instruction": "stack the blue cups"})
    served.model.note("dc", "arm-1", "policyComplete", {"steps": 85, "why": "", "loop": "{}"})
    served.model.note("dc", "arm-2", "collision", {"joint": "lift"})
    served.model.note("audit", "arm-1", "remote_estop_engaged", {"estop_id": "e" * 32}, audit=True)
    served.model.note("", "", "STOP pressed", {"button": "all robots"})
    open_robot(page)
    newest_last = ["Started", "Ended", "Locked by an emergency stop", "STOP pressed"]
    eventually(lambda: events(page) == newest_last, 30.0, what="the events of arm-1 and of all")
    picture(page, "timeline")
    assert "why" not in page.locator(".events").inner_text(), "what is empty is left out"
    for which, wanted in (
        ("audit", ["Locked by an emergency stop"]),
        ("events", ["Started", "Ended", "STOP pressed"]),
        ("all", newest_last),
    ):
        page.select_option("#timeline-which", which)
        eventually(lambda wanted=wanted: events(page) == wanted, 30.0, what=which)
    for text, wanted in (
        ("BLUE cups", ["Started"]),
        ("policy", ["Started", "Ended"]),
        ("collision", []),
        ("", newest_last),
    ):
        page.fill("#timeline-filter", text)
        eventually(lambda wanted=wanted: events(page) == wanted, 30.0, what=text)
    page.fill("#timeline-filter", "blue")
    served.model.note("dc", "arm-1", "taskPaused", {"instruction": "the blue one"})
    served.model.note("dc", "arm-1", "policyStarted", {"instruction": "the red one"})
    eventually(lambda: events(page) == ["Started", "task paused"], 30.0, what="what comes is filtered, too")


def test_timeline_that_somebody_reads_above_is_bounded(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    open_robot(page)

    def note(events: int) -> None:
        for number in range(events):
            served.model.note("dc", "arm-1", "policyComplete", {"steps": number})
        served.model.note("dc", "arm-1", "paused", {"events": events})
        page.locator(".events li", has_text=f"events: {events}").wait_for()

    note(100)
    page.evaluate("document.querySelector('.events').scrollTop = 0")
    for more in (190, 191, 192, 193, 194, 195):
        note(more)
    assert page.locator(".events li").count() == 1000
    page.evaluate("(() => { const list = document.querySelector('.events'); list.scrollTop = list.scrollHeight; })()")
    note(5)
    assert page.locator(".events li").count() == 200


def test_pose_of_an_arm_without_a_picture_of_it_is_drawn_from_its_joints(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", forms=READS_POSE)
    served.feed.answers["getPose"] = [success("here", **POSED)]
    open_robot(page)
    shows(page, "document.querySelector('.pose img').naturalWidth === 640", 60.0)
    assert page.locator(".pose img").get_attribute("alt") == "arm-1 as its joints are, drawn from its model"
    assert not page.locator(".pose p").is_visible()
    picture(page, "pose-of-a-real-arm")
    asked = len(served.feed.asked("getPose"))
    eventually(lambda: len(served.feed.asked("getPose")) > asked, what="it is drawn again")
    served.feed.answers["getPose"] = [error("the bus is lost")]
    page.locator(".pose p", has_text="Not shown: the bus is lost").wait_for(timeout=60_000)
    served.feed.answers["getPose"] = [success("here", **POSED)]
    page.locator(".pose img").wait_for(timeout=60_000)
    leave(page)

    def rests() -> bool:
        before = len(served.feed.asked("getPose"))
        page.wait_for_timeout(1500)
        return len(served.feed.asked("getPose")) == before

    eventually(rests, 60.0, what="nobody looks, so nothing is asked")


@pytest.mark.parametrize(
    ("forms", "why"),
    [(FORMS, "it has no arm that reports joint angles in degrees"), (READS_POSE, "no model of reachy is known")],
)
def test_pose_that_is_not_drawn_is_explained(page: Any, served: ServedPage, forms: Any, why: str) -> None:
    served.robot("arm-1", forms=forms)
    served.feed.answers["getPose"] = [error("no model of reachy is known; give model, an MJCF file of the arm.")]
    open_robot(page)
    page.locator(".pose p", has_text=f"Not shown: {why}").wait_for(timeout=60_000)
    assert not page.locator(".pose img").is_visible()


def leave(page: Any) -> None:
    """Go back to all robots."""
    page.locator("#robot a", has_text="All robots").click()
    page.locator("#cards").wait_for()


def test_view_of_a_base_shows_no_joint_of_the_arm_before(page: Any, served: ServedPage) -> None:
    drives = forms_of([{"name": "drive", "labels": {"direction": "write"}, "parameters": {"properties": {}}}])
    served.robot("arm-1")
    served.robot("base-1", forms=(*FORMS, *drives))
    served.model.observe("dc", "arm-1", {"pan": 0.1, "lift": 0.2})
    open_robot(page)
    page.locator("button.jog[aria-label='pan +']").wait_for(timeout=60_000)
    assert "answers in 1\u00a0ms" in page.locator(".age").inner_text()
    leave(page)
    open_robot(page, "base-1")

    def labels() -> list[str]:
        return [str(each.get_attribute("aria-label")) for each in page.locator("button.jog").all()]

    base = ["back", "forward", "turn right", "turn left"]
    eventually(lambda: labels() == base, 60.0, what="the buttons of a base alone")


def test_pose_is_asked_of_the_server_that_came_after(page: Any, served: ServedPage) -> None:
    encoded = io.BytesIO()
    Image.new("RGB", (64, 48), (200, 0, 0)).save(encoded, "JPEG")
    shot = success("a picture", jpeg=base64.b64encode(encoded.getvalue()).decode())
    served.feed.answers["getPicture"] = [shot]
    served.robot("arm-1", cameras=("overview",))
    open_robot(page)

    def address() -> str:
        return str(page.locator(".pose img").get_attribute("src") or "")

    eventually(address, 60.0, what="the first stream")
    before = address()
    served.end_without_cutting_off()
    with ServedPage(served.port) as again:
        again.feed.answers["getPicture"] = [shot]
        again.robot("arm-1", cameras=("overview",))
        eventually(lambda: address() not in ("", before), 60.0, what="a stream of the new server")


# What a screen reader is told.

CONTROLS = {"button", "link", "textbox", "searchbox", "combobox", "DisclosureTriangle", "image", "meter"}


class Reader:
    """Everything that a screen reader reaches of a page."""

    def __init__(self, page: Any) -> None:
        self._client = page.context.new_cdp_session(page)
        self._client.send("Accessibility.enable")

    def nodes(self) -> dict[str, Any]:
        found = self._client.send("Accessibility.getFullAXTree")["nodes"]
        return {node["nodeId"]: node for node in found}

    def controls(self) -> list[tuple[str, str]]:
        """The role and the name of every control."""
        shown = [node for node in self.nodes().values() if not node["ignored"]]
        pairs = [(node["role"]["value"], node.get("name", {}).get("value", "").strip()) for node in shown]
        return [pair for pair in pairs if pair[0] in CONTROLS]

    def stop(self) -> str:
        """The name of the big button, which is the first one."""
        return next(name for role, name in self.controls() if role == "button")

    def live(self, text: str) -> set[str]:
        """How what contains a text is announced: polite, assertive."""
        nodes, found = self.nodes(), set()
        for node in nodes.values():
            if text not in node.get("name", {}).get("value", ""):
                continue
            above: Any = node
            while above is not None:
                found |= {each["value"]["value"] for each in above.get("properties", []) if each["name"] == "live"}
                above = nodes.get(above.get("parentId", ""))
        return found - {"off"}

    def announces(self, text: str, how: str) -> None:
        eventually(lambda: how in self.live(text), 30.0, what=f"{text} is announced: {how}")


def test_every_control_has_a_name(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", locked=True, lockouts=[{"epoch": "e" * 32, "source": "desk-1", "since": 1.0, "reason": ""}])
    served.model.observe("dc", "arm-1", {"pan": 0.1, "lift": 0.2})
    served.model.update("dc", "arm-1", cameras=("front", "wrist"))
    reader = Reader(page)
    page.locator(".card").wait_for()
    page.locator("#resume summary").click()
    fleet = reader.controls()
    open_robot(page)
    robot = reader.controls()
    for verb in ("execute", "moveJoints"):
        verb_form(page, verb)
        robot += reader.controls()
    unnamed = [control for control in (*fleet, *robot) if not control[1]]
    assert unnamed == []
    buttons = [name for role, name in robot if role == "button"]
    assert {"pan +", "pan \u2212", "Take control", "Light or dark"} <= set(buttons)
    assert "STOP. All robots stop; arm-1 has to answer." in buttons
    assert ("meter", "pan") in robot and ("searchbox", "Search") in fleet
    picture(page, "every-control")


def test_verdicts_and_alarms_are_announced_and_stop_keeps_its_name(page: Any, served: ServedPage) -> None:
    reader, link = Reader(page), served.feed.controller
    with served.moving(2, 10.0):
        reader.announces("Ready: a press stops all 2 robots", "polite")
        names = {reader.stop()}
        link.verdicts["arm-1"] = Answer("arm-1", False, 9.0, "no brakes")
        page.keyboard.press("Space")
        reader.announces("DID NOT STOP", "polite")
        reader.announces("stopped in 9 ms", "polite")
        names.add(reader.stop())
        link.link_up = False
        reader.announces("THE NETWORK DOES NOT ANSWER", "assertive")
        names.add(reader.stop())
        link.link_up = True
        shows(page, "document.getElementById('alarm').hidden", 30.0)
        served.stop_serving()
        reader.announces("NOT CONNECTED", "assertive")
        names.add(reader.stop())
    assert names == {"STOP all robots (Space)"}


def test_alarm_that_lasts_is_read_once(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    page.locator(".card").wait_for()
    # Nobody is heard any more.
    told: list[str] = []

    def told_ten_times() -> bool:
        told.extend(re.findall(r"NO ROBOT HAS BEEN HEARD SINCE [\d:]+", page.locator("#alarm").inner_text()))
        page.wait_for_timeout(250)
        return len(told) >= 10

    eventually(told_ten_times, 60.0, what="the alarm")
    assert len(set(told)) == 1, "a text that counts would be read again and again"
