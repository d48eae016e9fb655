"""Many robots on the page: search and filter, and a page that moves nothing by itself."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.page_driving import card
from fixtures.page_site import picture, shows
from fixtures.served_page import ServedPage

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

FIVE_HUNDRED = 500


def test_five_hundred_robots_are_searched_and_filtered(page: Any, served: ServedPage) -> None:
    for number in range(FIVE_HUNDRED):
        served.robot(f"arm-{number}", model="so101" if number % 100 == 0 else "so100")
    served.model.task("dc", "arm-7", state="running", instruction="stack the blue cups")
    served.model.update("dc", "arm-499", locked=True, lockouts=[{"epoch": "e" * 32, "source": "desk-1"}])
    shows(page, f"document.querySelectorAll('.card').length === {FIVE_HUNDRED}", 60.0)
    for text, wanted in (
        ("arm-123", ["arm-123"]),
        ("BLUE cups", ["arm-7"]),
        ("so101", ["arm-0", "arm-100", "arm-200", "arm-300", "arm-400"]),
    ):
        page.fill("#search", text)
        shows(page, f"document.querySelectorAll('.card').length === {len(wanted)}")
        assert page.locator(".card .name").all_text_contents() == wanted
        assert page.locator("#count").inner_text() == f"{len(wanted)} of {FIVE_HUNDRED} robots"
    page.fill("#search", "nothing of that name")
    page.get_by_text("No robot matches.").wait_for()
    page.fill("#search", "")
    for which, name in (("locked", "arm-499"), ("moving", "arm-7")):
        page.select_option("#filter", which)
        shows(page, "document.querySelectorAll('.card').length === 1")
        card(page, name).wait_for()
    picture(page, "five-hundred")
    page.keyboard.press("Escape")
    page.locator("#stop").click()
    shows(page, f"document.getElementById('stop-said').textContent.includes('All {FIVE_HUNDRED} stopped')", 60.0)
    page.select_option("#filter", "all")
    shows(page, f"document.querySelectorAll('.card').length === {FIVE_HUNDRED}", 60.0)


def test_reduced_motion_has_no_animation_and_no_transition(page: Any, served: ServedPage) -> None:
    page.emulate_media(reduced_motion="reduce")
    with served.moving(4, 10.0):
        shows(page, "document.querySelectorAll('.card').length === 4")
        page.locator(".card .name").first.click()
        page.locator(".jog").first.wait_for()
        styled = (
            "[...document.querySelectorAll('*')].every((n) => { const s = getComputedStyle(n);"
            " return s.animationName === 'none' && parseFloat(s.transitionDuration) === 0"
            " && s.scrollBehavior === 'auto'; })"
        )
        assert page.evaluate(styled)
        assert page.evaluate("document.getAnimations().length") == 0
        picture(page, "reduced-motion")
