"""The page takes over from a policy and gives back, in a real browser, at a simulated arm of another process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, NamedTuple

import pytest
from fixtures.command_line import Machine
from fixtures.page_driving import answer, end_turns, hand_leads, hold_until, policy_drives, take, turn_said
from fixtures.page_site import PageServer, picture, shows
from fixtures.waiting import eventually

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


class Site(NamedTuple):
    """A page and the network of its arm."""

    page: Any
    network: str


@pytest.fixture(scope="module", params=["dc", "mesh"])
def site(request: pytest.FixtureRequest, chrome: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A page that shows the arm on one of the networks."""
    mesh = ["--mesh"] if request.param == "mesh" else []
    machine = Machine(tmp_path_factory.mktemp("turns"))
    line = ["serve", "so100", "--peer-id", "arm-1", "--json", "--until-stdin-closes", *mesh]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    arm = subprocess.Popen([sys.executable, "-m", "strands_robots.cli", *line], env=machine.environment, **pipes)
    with ExitStack() as stack:
        stack.callback(arm.kill)
        stack.callback(arm.communicate, timeout=60)
        assert arm.stdout is not None
        assert json.loads(arm.stdout.readline())["event"] == "serving"
        server = PageServer(machine, *mesh)
        stack.callback(server.close)
        page = chrome.new_page(viewport={"width": 1280, "height": 1000})
        stack.callback(page.close)
        page.goto(server.url)
        page.locator(".card").wait_for(timeout=60_000)
        yield Site(page, request.param)


def test_push_takes_over_from_the_policy_and_a_button_gives_back(site: Site) -> None:
    page, network = site

    def pan() -> float:
        return float(page.locator(".bar .value").first.inner_text().rstrip("\u00b0"))

    button = take(page, "shoulder_pan +", network=network)
    shows(page, "/\\d/.test(document.querySelector('.bar .value')?.textContent)")
    start = pan()
    page.fill("#turn-task", "wave")
    policy_drives(page)
    picture(page, "turn-policy")
    shows(page, f"Math.abs(parseFloat(document.querySelector('.bar .value').textContent) - {start}) > 0.5")

    hand_leads(page, button)
    before = pan()
    hold_until(page, button, lambda: pan() > before + 3, "the arm goes where it is pushed")
    page.mouse.up()
    picture(page, "turn-led")
    page.locator(".drive .said", has_text="Let go (").wait_for()

    policy_drives(page)
    end_turns(page)


def test_hand_that_drives_by_pictures_is_held_where_they_show_nothing_new(site: Site) -> None:
    page, network = site
    button = page.locator("button.jog[aria-label='shoulder_pan +']")

    def stands_by_old_pictures() -> bool:
        if "the newest picture of page is" not in turn_said(page):
            policy_drives(page)
            hand_leads(page, button)
            # It stands, so its camera has nothing new.
            page.mouse.up()
            page.locator(".turn-said", has_text="HELD").wait_for()
        return "the newest picture of page is" in turn_said(page)

    page.select_option("#turn-camera", "front")
    policy_drives(page)
    shows(page, "document.querySelector('.pictures .camera').src.startsWith('blob:')")
    eventually(stands_by_old_pictures, 90.0, "it is held for its old pictures")
    picture(page, "turn-held")
    policy_drives(page)
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped", network)
    eventually(lambda: turn_said(page).startswith("Over"), 30.0, "the end of the turns")
    shows(page, "!document.querySelector('.pictures .camera').src.startsWith('blob:')")
