"""Verbs of a robot's own on the page: bounds, choices, and nothing that looks like the page's own buttons."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest
from fixtures.page_driving import card, open_robot, verb_form
from fixtures.page_feed import PageController
from fixtures.page_site import picture
from fixtures.served_page import FORMS, ServedPage
from fixtures.waiting import eventually

pytest.importorskip("playwright.sync_api")

from fixtures.page_feed import forms_of

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

ATTACK = "<img src=x onerror=\"document.title='owned'\">\x1b[2J"
OWN = {"direction": "write", "own": "true"}
OWN_FORMS = forms_of(
    [
        {
            "name": "brewCoffee",
            "description": f"Brew coffee. {ATTACK}",
            "parameters": {
                "properties": {
                    "cups": {"type": "integer", "minimum": 1, "maximum": 8, "unit": "cups", "description": ATTACK},
                    "strength": {"enum": ["mild", "strong"], "default": "mild"},
                    "sugar": {"enum": [0, 0.5, 1]},
                },
                "required": ["cups", "sugar"],
            },
            "labels": OWN,
        },
        {"name": "halt", "description": "Halt everything.", "labels": OWN},
        {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}},
    ]
)


def test_own_verb_is_filled_in_within_its_bounds_and_sent_with_its_types(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", forms=(*FORMS, *OWN_FORMS))
    open_robot(page)
    form = verb_form(page, "brewCoffee")
    cups = form.get_by_label("cups, cups (required)")
    form.get_by_label("sugar (required)").select_option("0.5")
    for wrong, said in (("9", "cups must be 1 to 8 cups."), ("1.5", "cups is no whole number.")):
        cups.fill(wrong)
        form.get_by_role("button", name="Run").click()
        eventually(lambda said=said: said in form.locator(".said").inner_text(), what=said)  # type: ignore[misc]
    assert served.feed.asked("brewCoffee") == []
    assert "(1 to 8 cups)" in form.inner_text()
    cups.fill("2")
    form.get_by_label("strength").evaluate("each => { each.closest('details').open = true; }")
    form.get_by_label("strength").select_option("strong")
    form.get_by_role("button", name="Run").click()
    eventually(lambda: served.feed.asked("brewCoffee"), what="the call")
    assert served.feed.asked("brewCoffee")[0] == {"cups": 2, "sugar": 0.5, "strength": "strong"}


def test_device_of_others_says_on_the_page_what_it_lacks(page: Any, served: ServedPage) -> None:
    lacking = "no lockout, no lease, no stop"
    served.robot("kettle", locked=None, lacking=lacking, forms=OWN_FORMS)
    card(page, "kettle").locator(".lock", has_text=lacking).wait_for(timeout=30_000)
    assert "nobody holds control" not in card(page, "kettle").inner_text()
    card(page, "kettle").locator("a.name").click()
    page.locator("#robot .lock", has_text=lacking).wait_for(timeout=30_000)
    picture(page, "bare-device")
    verb_form(page, "brewCoffee")


STATUS = forms_of([{"name": "getStatus", "labels": {"direction": "read"}}, {"name": "stop"}])


def test_robot_without_joints_is_held_by_the_page_whose_calls_send_the_lease(page: Any, served: ServedPage) -> None:
    served.robot("kiln", forms=(*STATUS, *OWN_FORMS), holdable=True)
    card(page, "kiln").locator("a.name").click()
    taking = page.get_by_role("button", name="Take control")
    taking.wait_for(timeout=30_000)
    assert [page.locator(f".panel.{each}").is_visible() for each in ("pose", "joints", "pictures")] == [False] * 3
    assert not page.get_by_label("Speed").is_visible()
    taking.click()
    page.get_by_text("You hold control").wait_for(timeout=30_000)
    picture(page, "held-robot-without-joints")
    form = verb_form(page, "brewCoffee")
    form.get_by_label("cups, cups (required)").fill("2")
    form.get_by_role("button", name="Run").click()
    eventually(lambda: served.feed.asked("brewCoffee"), what="the call")
    assert served.feed.asked("brewCoffee")[0]["lease_id"] == "lease-1"
    page.get_by_role("button", name="Give control back").click()
    eventually(lambda: served.feed.asked("releaseControl") == [{"lease_id": "lease-1"}], what="the release")
    served.model.observe("dc", "kiln", {"door": 10.0})
    page.locator(".panel.joints", has_text="door").wait_for(timeout=30_000)


def test_robot_without_a_lease_has_no_control_to_take(page: Any, served: ServedPage) -> None:
    served.robot("kiln", forms=(*STATUS, *OWN_FORMS))
    card(page, "kiln").locator("a.name").click()
    verb_form(page, "brewCoffee")
    assert not page.locator(".panel.drive").is_visible()


def test_times_of_an_emergency_stop_are_shown_as_a_clock_shows_them(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    at = time.time()
    served.model.note("dc", "arm-1", "remote_estop_engaged", {"issued": at, "pressed_at": at}, audit=True)
    open_robot(page)
    said = page.locator(".events li", has_text="issued").inner_text(timeout=30_000)
    assert re.search(r"issued: \d\d:\d\d:\d\d · pressed at: \d\d:\d\d:\d\d", said), said


def test_silence_is_named_beside_a_network_that_is_gone(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    served.model.update("mesh", "sim-1")
    gone = PageController()
    gone.link_up = False
    served.feeds.add_button("mesh", gone)
    alarm = page.locator("#alarm", has_text="MESH DOES NOT ANSWER.")
    alarm.wait_for(timeout=30_000)
    page.locator("#alarm", has_text=re.compile("NO ROBOT HAS BEEN HEARD SINCE.*MESH DOES NOT ANSWER")).wait_for()
    served.model.sign_of_life("dc", "arm-1", 1.0)
    eventually(lambda: "NO ROBOT" not in alarm.inner_text(), what="the robot that is heard again")


def test_own_verb_is_plain_text_and_says_that_it_is_the_robots(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", forms=(*FORMS, *OWN_FORMS))
    open_robot(page)
    form = verb_form(page, "brewCoffee")
    assert "<img src=x" in form.inner_text()
    assert form.locator("img").count() == 0
    assert "owned" not in page.title()
    halt = page.locator("button.verb[data-verb='halt']")
    assert halt.inner_text().split("\n") == ["halt", "own, moves"]
    form = verb_form(page, "halt")
    assert "The robot's own verb" in form.inner_text()
    assert form.get_by_role("button").all_inner_texts() == ["Run"]
