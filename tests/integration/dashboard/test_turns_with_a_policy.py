"""The page takes over from a policy and gives back, in a real browser, at a simulated arm of another process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.page_driving import answer, hold_until, take
from fixtures.page_site import PageServer, picture, shows
from fixtures.waiting import eventually

from strands_robots.device_connect import FleetClient, loopback_config

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

STATE = ".turn-said"


@pytest.fixture(scope="module")
def site(chrome: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, FleetClient]]:
    """A page, and a client that reads the arm."""
    machine = Machine(tmp_path_factory.mktemp("turns"))
    line = ["serve", "so100", "--peer-id", "arm-1", "--json", "--until-stdin-closes"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    arm = subprocess.Popen([sys.executable, "-m", "strands_robots.cli", *line], env=machine.environment, **pipes)
    with ExitStack() as stack:
        stack.callback(arm.kill)
        stack.callback(arm.communicate, timeout=60)
        assert arm.stdout is not None
        assert json.loads(arm.stdout.readline())["event"] == "serving"
        server = PageServer(machine)
        stack.callback(server.close)
        page = chrome.new_page(viewport={"width": 1280, "height": 1000})
        page.goto(server.url)
        page.locator(".card").wait_for(timeout=60_000)
        client = stack.enter_context(
            FleetClient(loopback_config(int(machine.environment["STRANDS_DC_PORT"])), "reader")
        )
        yield page, client


def said(page: Any, words: str) -> None:
    page.locator(STATE, has_text=words).wait_for(timeout=30_000)


def test_push_takes_over_from_the_policy_and_a_button_gives_back(site: tuple[Any, FleetClient]) -> None:
    page, client = site

    def pan() -> float:
        return float(client.call("arm-1", "getPose")["joints"]["shoulder_pan"])

    button = take(page, "shoulder_pan +")
    start = pan()
    page.fill("#turn-task", "wave")
    page.get_by_role("button", name="Let the policy drive").click()
    said(page, "THE POLICY DRIVES")
    picture(page, "turn-policy")
    eventually(lambda: abs(pan() - start) > 1, what="the policy moves the arm")

    before = pan()
    hold_until(page, button, lambda: "YOU LEAD" in page.locator(STATE).inner_text(), "the page leads")
    hold_until(page, button, lambda: pan() > before + 3, "the arm goes where it is pushed")
    page.mouse.up()
    picture(page, "turn-led")
    page.locator(".drive .said", has_text="Let go (released)").wait_for()

    page.get_by_role("button", name="Give back to the policy").click()
    said(page, "THE POLICY DRIVES")
    page.get_by_role("button", name="End", exact=True).click()
    said(page, "Over: it stands")


def test_hand_that_drives_by_pictures_is_held_where_they_show_nothing_new(site: tuple[Any, FleetClient]) -> None:
    page, _ = site
    page.select_option("#turn-camera", "front")
    page.get_by_role("button", name="Let the policy drive").click()
    said(page, "THE POLICY DRIVES")
    shows(page, "document.querySelector('.pictures .camera').src.startsWith('blob:')")
    button = page.locator("button.jog[aria-label='shoulder_pan +']")
    hold_until(page, button, lambda: "YOU LEAD" in page.locator(STATE).inner_text(), "the page leads by pictures")
    page.mouse.up()
    # It stands, so its camera has nothing new.
    said(page, "HELD: the newest picture of page is")
    picture(page, "turn-held")
    page.get_by_role("button", name="Give back to the policy").click()
    said(page, "THE POLICY DRIVES")
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped")
    said(page, "Over")
    shows(page, "!document.querySelector('.pictures .camera').src.startsWith('blob:')")
