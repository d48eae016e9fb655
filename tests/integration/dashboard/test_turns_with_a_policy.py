"""The page takes over from a policy and gives back, in a real browser, at a simulated arm of another process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from fixtures.command_line import Machine
from fixtures.page_driving import answer, card, end_turns, hand_leads, hold_until, policy_drives, take, turn_said
from fixtures.page_site import PageServer, picture, shows
from fixtures.waiting import eventually

from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file
from strands_robots.datasets.recorded import ACTORS

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


class Site(NamedTuple):
    """A page and the network of its arm."""

    page: Any
    url: str
    network: str
    machine: Machine


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
        yield Site(page, server.url, request.param, machine)


def test_turns_of_the_page_are_one_episode_that_tells_the_policy_from_the_hand(site: Site, tmp_path: Path) -> None:
    page, url, network, machine = site
    page.goto(url)
    folder, mesh = tmp_path / "set", ["--mesh"] if network == "mesh" else []
    line = ["dataset", "record", str(folder), "--robot", "arm-1", "--task", "wave", "--leader", "page", "--json"]

    def word(name: str) -> None:
        card(page, "recorder-arm-1", network).locator("a.name").click(timeout=60_000)
        page.locator(".recorder").get_by_role("button", name=name, exact=True).click(timeout=30_000)

    with machine.start(*line, "--cameras", "none", "--episodes", "1", *mesh) as recorder, ExitStack() as stack:
        stack.callback(recorder.kill)
        word("Begin")
        page.go_back()
        button = take(page, "shoulder_pan +", network=network)
        # A jog that is let go is a halt as well.
        hold_until(page, button, lambda: "held" in button.get_attribute("class").split(), "the arm is jogged")
        page.mouse.up()
        page.fill("#turn-task", "wave")
        for _ in range(2):
            policy_drives(page)
            hand_leads(page, button)
            page.mouse.up()
        policy_drives(page)
        end_turns(page)
        page.go_back()
        word("Keep as success")
        told, _ = recorder.communicate(timeout=60)
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (1, []), told
    frames = tables.read_frames(folder / data_file(0))
    by_hand = frames["intervention"]
    assert by_hand.any() and not by_hand.all()
    assert set(frames["actor"][by_hand].tolist()) == {ACTORS.index("leader")}
    assert ACTORS.index("policy") in frames["actor"][~by_hand].tolist()
    assert set(frames["stop"].tolist()) <= {0, 1}, "no emergency stop"
    assert frames["next.success"][-1]


def test_push_takes_over_from_the_policy_and_a_button_gives_back(site: Site) -> None:
    page, url, network, _ = site
    page.goto(url)

    def pan() -> float:
        return float(page.locator(".bar .value").first.inner_text().rstrip("\u00b0"))

    button = take(page, "shoulder_pan +", network=network)
    shows(page, "/\\d/.test(document.querySelector('.bar .value')?.textContent)")
    start = pan()
    page.fill("#turn-task", "wave")
    policy_drives(page)
    picture(page, "turn-policy")

    def moves() -> bool:
        policy_drives(page)
        return abs(pan() - start) > 0.5

    eventually(moves, 90.0, "the policy moves the arm")

    hand_leads(page, button)
    before = pan()
    hold_until(page, button, lambda: pan() > before + 3, "the arm goes where it is pushed")
    page.mouse.up()
    picture(page, "turn-led")
    page.locator(".drive .said", has_text="Let go (").wait_for()

    policy_drives(page)
    end_turns(page)


def test_hand_that_drives_by_pictures_is_held_where_they_show_nothing_new(site: Site) -> None:
    page, _, network, _ = site
    button, old = page.locator("button.jog[aria-label='shoulder_pan +']"), "the newest picture of page is"

    def stands_by_old_pictures() -> bool:
        if old not in turn_said(page):
            policy_drives(page)
            # On a busy machine its pictures are old at once.
            hold_until(page, button, lambda: not turn_said(page).startswith("THE POLICY"), "the hand takes over")
            # It stands, so its camera has nothing new.
            page.mouse.up()
            eventually(lambda: turn_said(page).startswith(("HELD", "Over")), 30.0, "it is held")
        return old in turn_said(page)

    page.select_option("#turn-camera", "front")
    policy_drives(page)
    shows(page, "document.querySelector('.pictures .camera').src.startsWith('blob:')")
    eventually(stands_by_old_pictures, 90.0, "its old pictures hold it")
    picture(page, "turn-held")
    policy_drives(page)
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped", network)
    eventually(lambda: turn_said(page).startswith("Over"), 30.0, "the end of the turns")
    shows(page, "!document.querySelector('.pictures .camera').src.startsWith('blob:')")
