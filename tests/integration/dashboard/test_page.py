"""The operator's page in a real browser."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.answering_stranger import Stranger, claimed_verdict
from fixtures.page_driving import answer, card, hold_until, moving, open_robot, take, verb_form
from fixtures.page_site import picture, shows
from fixtures.waiting import eventually, signalled

from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.identity import ROBOTS, KeyFile
from strands_robots.safety.statements import Purpose, signed

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
PASSPHRASE = "Plenty of 4 different words"
APART_S = 5.0
"""Seconds between two presses, which are thus two stops, and in which the first is answered."""


def alarm(page: Any) -> str:
    return str(page.locator("#alarm").inner_text()) if page.locator("#alarm").is_visible() else ""


def alarms(page: Any, what: str) -> None:
    """Wait until the page says so; benchmarks.dashboard measures how soon."""
    shows(page, f"document.getElementById('alarm').textContent.includes({what!r})", 30.0)


# One cell.


def test_button_of_a_cell_stops_its_robots_and_no_other(cell: Any) -> None:
    first, second = (cell.serve_arms(f"arm-{each}", STRANDS_CELL=f"cell-{each}") for each in (1, 2))
    page = cell.open(cell.serve_page(), robots=2)
    for arms in (first, second):
        arms.ask("move")
    open_robot(page)
    button = page.locator("#robot .stop-cell")
    button.wait_for()
    assert "cell-1" in button.get_attribute("aria-label")
    picture(page, "stop-cell")
    button.click()
    answer(page, "arm-1", "stopped")
    page.locator("#stop-said", has_text="for cell cell-1 and robots without a cell").wait_for()
    assert not moving(first) and moving(second, "arm-2")
    page.keyboard.press("Space")
    answer(page, "arm-2", "stopped")
    assert not moving(second, "arm-2")
    assert page.problems == []


# Looking.


def test_robots_are_found_and_shown_by_name(cell: Any) -> None:
    cell.serve_arms()
    page = cell.open(cell.serve_page())
    assert page.locator(".card .name").all_inner_texts() == ["arm-1", "arm-2", "arm-3"]
    for name in ("arm-1", "arm-2", "arm-3"):
        card(page, name).get_by_text("not locked").wait_for()
        assert "Device Connect" in card(page, name).inner_text()
    picture(page, "discovery")
    page.fill("#search", "arm-2")
    shows(page, "document.querySelectorAll('.card').length === 1")
    assert page.problems == []


def test_verb_is_called_by_its_form(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    open_robot(page)
    form = verb_form(page, "execute")
    form.get_by_role("button", name="Run").click()
    assert "instruction is missing" in form.locator(".said").inner_text()
    form.locator("#p-execute-instruction").fill("wave")
    form.get_by_role("button", name="Run").click()
    eventually(lambda: moving(arms), what="the arm moves")
    form.locator(".said[data-tone='good']").wait_for()
    picture(page, "form")


# Driving.


def test_jog_moves_while_it_is_held_and_stops_when_it_is_released(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    button = take(page)
    hold_until(page, button, lambda: moving(arms), "the arm moves")
    picture(page, "jog")
    page.mouse.up()
    eventually(lambda: not moving(arms), what="the arm stands")
    page.locator(".drive .said", has_text="Stopped (").wait_for()
    assert not arms.ask("facts")["arm-1"]["locked"], "a released jog locks nothing"


@pytest.mark.parametrize("how", ["hidden", "blur", "frozen", "closed", "left", "key"])
def test_jog_ends_with_every_way_of_letting_go(cell: Any, how: str) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    button = take(page)
    hold_until(page, button, lambda: moving(arms), "the arm moves", "q" if how == "key" else "")
    if how == "hidden":
        page.evaluate(
            "Object.defineProperty(document, 'hidden', {get: () => true});"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
    elif how == "blur":
        page.evaluate("window.dispatchEvent(new Event('blur'))")
    elif how == "frozen":
        # The page's own thread hangs: no beat leaves it, and nothing else.
        page.evaluate("setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end); }, 0)")
    elif how == "closed":
        page.close()
    elif how == "key":
        page.keyboard.up("q")
    else:
        page.goto("about:blank")
    eventually(lambda: not moving(arms), what="the arm stands")


def test_second_tab_sees_who_drives_and_cannot_drive_and_both_can_stop(cell: Any) -> None:
    arms = cell.serve_arms()
    server = cell.serve_page()
    first, second = cell.open(server), cell.open(server)
    take(first)
    card(second, "arm-1").get_by_text("holds control").wait_for()
    open_robot(second)
    assert second.locator("button.jog").first.is_disabled()
    picture(second, "second-tab")
    second.keyboard.press("Space")
    for page in (first, second):
        for name in ("arm-1", "arm-2", "arm-3"):
            answer(page, name, "stopped")
    assert all(each["locked"] for each in arms.ask("facts").values())


# Stopping.


@pytest.mark.parametrize("how", ["button", "space", "card", "touch"])
def test_stop_in_motion_stops_every_robot_and_names_each_answer(cell: Any, how: str) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page(), has_touch=how == "touch")
    arms.ask("move")
    card(page, "arm-2").get_by_text("running").wait_for()
    if how == "button":
        page.locator("#stop").click()
    elif how == "space":
        page.keyboard.press("Space")
    elif how == "touch":
        page.locator("#stop").tap()
    else:
        card(page, "arm-3").locator(".stop-one").click()
    for name in ("arm-1", "arm-2", "arm-3"):
        assert " ms" in answer(page, name, "stopped").inner_text()
    assert not any(each["moving"] for each in arms.ask("facts").values())
    shows(page, "document.getElementById('stop-said').textContent.includes('All 3 stopped')")
    card(page, "arm-1").get_by_text("LOCKED by dashboard").wait_for()
    picture(page, f"stop-{how}")
    assert {each["halts"] for each in arms.ask("facts").values()} == {1}, "one press is one stop"


def test_space_stops_with_any_button_focused_and_types_in_a_text_field(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    page.locator("#search").focus()
    page.keyboard.type("arm 1")
    assert page.locator("#search").input_value() == "arm 1"
    assert not any(each["locked"] for each in arms.ask("facts").values())
    page.keyboard.press("Escape")
    page.locator("#theme").focus()
    before = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped")
    assert page.evaluate("document.documentElement.dataset.theme") == before, "the focused button was not pressed"


def test_robot_that_refuses_to_stop_stays_red_and_is_named(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    arms.ask("refuse", "arm-2")
    arms.ask("move")
    page.locator("#stop").click()
    answer(page, "arm-1", "stopped")
    said = answer(page, "arm-2", "not_stopped")
    assert "DID NOT STOP" in said.inner_text() and "no brakes" in said.inner_text()
    text = page.locator(".stop-head").inner_text()
    assert "1 DID NOT STOP" in text and "All" not in text
    assert page.locator(".stop-head").get_attribute("data-tone") == "bad"
    assert "arm-2" in text, "the one that did not stop is named"
    names = page.locator(".card .name")
    assert names.all_inner_texts() == ["arm-1", "arm-2", "arm-3"], "no card moves by itself"
    page.get_by_role("button", name="Sort").click()
    eventually(lambda: names.first.inner_text() == "arm-2", what="the worst comes first where it is asked for")
    picture(page, "refuses-to-stop")
    arms.ask("refuse", "arm-2", False)


def test_silent_robot_is_red_until_it_answers_itself(cell: Any) -> None:
    arms, other = cell.serve_arms("arm-1"), cell.serve_arms("arm-2")
    page = cell.open(cell.serve_page(), robots=2)
    other.signal(signal.SIGSTOP)
    page.locator("#stop").click()
    answer(page, "arm-1", "stopped")
    assert "NO ANSWER" in answer(page, "arm-2", "silent").inner_text()
    assert "All" not in page.locator(".stop-head").inner_text()
    picture(page, "silent")
    other.signal(signal.SIGCONT)
    answer(page, "arm-2", "stopped")
    assert not moving(arms)


@pytest.mark.parametrize(("forged", "state"), [("claim", "claimed"), ("wrong key", "alarm")])
def test_forged_verdict_turns_no_robot_green(cell: Any, tmp_path: Path, forged: str, state: str) -> None:
    arms = cell.serve_arms()
    cell.machine.run("enroll", "--json")
    page = cell.open(cell.serve_page())
    stranger = Stranger(cell.link)
    cell.stack.callback(stranger.link.close)
    if forged == "wrong key":
        key = KeyFile(ROBOTS, "arm-1", tmp_path / "stranger").load_or_make()
        stranger.forge = lambda estop_id: signed(key, Purpose.STOP_VERDICT, "arm-1", claimed_verdict(estop_id))
    eventually(lambda: stranger.link.up, what="the stranger's link")
    forge, heard = stranger.forge, set()

    def forged_verdict(estop_id: str) -> dict[str, Any]:
        heard.add(estop_id)
        return forge(estop_id)

    stranger.forge = forged_verdict

    def press_until(condition: Callable[[], object], what: str) -> None:
        due = 0.0

        def pressed() -> bool:
            nonlocal due
            if condition():
                return True
            if time.monotonic() >= due:
                page.locator("#stop").click()
                due = time.monotonic() + APART_S
            return False

        eventually(pressed, 60.0, what=what)

    def shown() -> bool:
        return page.locator(f"#stop-said li[data-key='dc:arm-1'][data-state='{state}']").count() > 0

    # The stranger reaches the page without the arms once it has heard the page itself.
    press_until(lambda: heard, "a stop is heard by the stranger")
    answer(page, "arm-1", "stopped")
    arms.signal(signal.SIGSTOP)
    # A press before this one may be heard late, and the arms may have answered it.
    press_until(shown, f"the forged verdict is {state}")
    assert answer(page, "arm-1", state).get_attribute("data-tone") in ("warn", "bad")
    answer(page, "arm-2", "silent")
    assert page.locator("#stop-said li[data-tone='good']").count() == 0
    picture(page, f"forged-{state}")
    arms.signal(signal.SIGCONT)
    assert "signed by the robot" in answer(page, "arm-1", "stopped").inner_text()


def test_robot_is_resumed_at_the_bottom_with_the_passphrase_alone(cell: Any, tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    arms = cell.serve_arms(STRANDS_MESH_RESUME_PUBLIC_KEY=keygen(key, PASSPHRASE))
    page = cell.open(cell.serve_page("--operator-key", str(key)))
    page.locator("#stop").click()
    answer(page, "arm-1", "stopped")
    page.locator("#resume summary").click()
    stop, resume = page.locator("#stop").bounding_box(), page.locator("#resume").bounding_box()
    assert resume["y"] > stop["y"] + stop["height"] + 100
    page.fill("#resume-passphrase", "wrong")
    page.keyboard.press("Enter")
    page.locator("#resume .said[data-tone='bad']").wait_for()
    assert all(each["locked"] for each in arms.ask("facts").values())
    page.fill("#resume-passphrase", PASSPHRASE)
    picture(page, "resume")
    page.keyboard.press("Enter")
    page.locator("#resume .said[data-tone='good']").wait_for(timeout=20_000)
    assert not any(each["locked"] for each in arms.ask("facts").values())
    shows(page, "document.querySelector('.stop-head').textContent.includes('None is locked')")
    assert page.locator("#stop-said li[data-tone='good']").count() == 0, "a freed robot is no longer said to be stopped"


# Not connected.


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_page_says_that_its_server_is_gone_and_what_to_do(cell: Any, number: signal.Signals) -> None:
    cell.serve_arms()
    server = cell.serve_page()
    page = cell.open(server)
    signalled(server.process, number)
    alarms(page, "cannot stop")
    picture(page, f"server-{number.name.lower()}")
    assert "hardware emergency stop" in alarm(page)
    if number == signal.SIGKILL:
        page.locator("#stop").click()
        shows(page, "document.getElementById('alarm').textContent.includes('NOT SENT')")
    assert page.locator("#stop-word").inner_text() == "STOP"


def test_page_says_that_the_network_is_silent(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    arms.signal(signal.SIGSTOP)
    alarms(page, "NO ROBOT HAS BEEN HEARD")
    picture(page, "network-silent")
    arms.signal(signal.SIGCONT)
    shows(page, "document.body.dataset.canStop === 'yes'", 20.0)


def test_press_while_the_network_is_silent_stops_when_it_is_back(cell: Any) -> None:
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page())
    arms.ask("move")
    arms.signal(signal.SIGSTOP)
    page.locator("#stop").click()
    answer(page, "arm-1", "silent")
    arms.signal(signal.SIGCONT)
    answer(page, "arm-1", "stopped")
    assert not moving(arms)
