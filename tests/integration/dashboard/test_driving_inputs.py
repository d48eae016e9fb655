"""Jogs by finger, by gamepad, of the gripper and of a base, and a robot that is taken from an agent.

The finger is Chromium's own touch input and moves arms of another process. A gamepad cannot be plugged in here:
``navigator.getGamepads`` is a stand-in, and the base and the gripper are those of a network that the test writes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.page_driving import answer, card, hold_until, middle, moving, open_robot, take
from fixtures.page_feed import forms_of
from fixtures.page_site import picture, shows
from fixtures.served_page import ServedPage
from fixtures.waiting import eventually

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.ed25519 import keygen

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
PASSPHRASE = "Plenty of 4 different words"

PADS = (
    "window.pads = []; Object.defineProperty(navigator, 'getGamepads', {value: () => window.pads, configurable: true})"
)


def pushed(page: Any, axes: list[float], arms: Any) -> None:
    """Push a stick until the arm moves; again where a busy machine was late with a beat, which ends the jog."""

    def moves() -> bool:
        if moving(arms):
            return True
        if page.locator("button.jog.held").count() == 0:
            page.evaluate("window.pads = []")
            shows(page, "new Promise((yes) => requestAnimationFrame(() => requestAnimationFrame(() => yes(true))))")
            page.evaluate(f"window.pads = [{{axes: {axes}}}]")
        return False

    eventually(moves, 60.0, what="the arm moves")


def test_finger_jogs_while_it_touches(cell: Any) -> None:
    arms = cell.serve_arms("arm-1")
    page = cell.open(
        cell.serve_page(), robots=1, has_touch=True, is_mobile=True, viewport={"width": 360, "height": 740}
    )
    button = take(page)
    x, y = middle(button)
    finger = page.context.new_cdp_session(page)
    finger.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
    eventually(lambda: moving(arms), what="the arm moves")
    picture(page, "jog-touch")
    finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    eventually(lambda: not moving(arms), what="the arm stands")
    page.locator(".drive .said", has_text="Stopped (").wait_for()


def test_stick_of_a_gamepad_jogs_until_it_is_let_go(cell: Any) -> None:
    arms = cell.serve_arms("arm-1")
    page = cell.open(cell.serve_page(), robots=1)
    page.evaluate(PADS)
    take(page)
    pushed(page, [0.9, 0], arms)
    page.evaluate("window.pads = [{axes: [0.1, 0]}]")
    eventually(lambda: not moving(arms), what="the arm stands")
    page.locator(".drive .said", has_text="Stopped (").wait_for()


def test_gamepad_that_is_unplugged_stops_the_jog(cell: Any) -> None:
    arms = cell.serve_arms("arm-1")
    page = cell.open(cell.serve_page(), robots=1)
    page.evaluate(PADS)
    take(page)
    pushed(page, [0, -1], arms)
    page.evaluate("window.pads = []")
    eventually(lambda: not moving(arms), what="the arm stands")


def test_jog_that_is_held_does_not_start_the_arm_again_after_a_halt(cell: Any) -> None:
    arms = cell.serve_arms("arm-1")
    server = cell.serve_page()
    page, other = cell.open(server, robots=1), cell.open(server, robots=1)
    hold_until(page, take(page), lambda: moving(arms), "the arm moves")
    card(other, "arm-1").get_by_role("button", name="Halt arm-1").click()
    card(other, "arm-1").get_by_text("Halted at").wait_for()
    page.locator(".drive .said", has_text="It does not move").wait_for()
    for _ in range(10):
        assert not moving(arms), "the button is still held"
        page.wait_for_timeout(100)
    page.mouse.up()


BASE = forms_of([{"name": name, "labels": {"direction": "write"}} for name in ("acquireControl", "drive", "stop")])


@pytest.mark.parametrize(
    ("label", "key", "speed", "sign"),
    [("forward", "", "linear", 1), ("back", "a", "linear", -1), ("turn left", "w", "angular", 1)],
)
def test_base_is_driven_while_the_button_or_its_key_is_held(
    page: Any, served: ServedPage, label: str, key: str, speed: str, sign: int
) -> None:
    served.robot("base-1", kind="mobile_base", forms=BASE)
    button = take(page, label, "base-1")
    hold_until(page, button, lambda: served.feed.asked("drive"), "the base is driven", key)
    picture(page, "jog-base")
    if key:
        page.keyboard.up(key)
    else:
        page.mouse.up()
    page.locator(".drive .said", has_text="Stopped (").wait_for()
    drives, stops = served.feed.asked("drive"), served.feed.stops
    assert all(each[speed] * sign > 0 and each["lease_id"] for each in drives)
    assert stops >= 1


@pytest.mark.parametrize(
    ("label", "verb", "wanted"),
    [("up", "moveBy", {"dz"}), ("left", "moveBy", {"dy"}), ("open", "setGripper", {"opening"})],
)
def test_gripper_is_moved_by_its_pose_and_opened(
    page: Any, served: ServedPage, label: str, verb: str, wanted: set[str]
) -> None:
    served.robot("arm-1")
    hold_until(page, take(page, label), lambda: served.feed.asked(verb), "the motion")
    called = served.feed.asked(verb)[0]
    assert wanted <= called.keys() and all(called[each] > 0 for each in wanted)
    page.mouse.up()
    page.locator(".drive .said", has_text="Stopped (").wait_for()
    assert served.feed.stops >= 1


@pytest.mark.parametrize("view", ["#/", "#/history", "#/cameras"])
def test_keys_and_sticks_move_nothing_on_another_view(page: Any, served: ServedPage, view: str) -> None:
    served.robot("arm-1")
    served.model.observe("dc", "arm-1", {"pan": 0.1})
    page.evaluate(PADS)
    take(page)
    page.evaluate(f"location.hash = {view!r}")
    page.locator("#robot").wait_for(state="detached")
    page.keyboard.down("q")
    page.evaluate("window.pads = [{axes: [0.9, 0]}]")
    page.wait_for_timeout(500)
    assert not served.feed.asked("moveJoints")
    page.keyboard.up("q")
    page.evaluate("window.pads = []")
    page.evaluate("location.hash = '#/robot/dc:arm-1'")
    button = page.locator("button.jog[aria-label='pan +']")
    hold_until(page, button, lambda: served.feed.asked("moveJoints"), "the key moves it again", "q")
    page.keyboard.up("q")


def test_robot_is_taken_from_an_agent_by_signature_and_given_back(cell: Any, tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    public = keygen(key, PASSPHRASE)
    server = cell.stack.enter_context(NatsServer())
    cell.link = LinkConfig(transport="nats", connect=(server.url,))
    everyone = {"DEVICE_CONNECT_RPC_ALLOW": "dashboard,agent-a", "STRANDS_MESH_RESUME_PUBLIC_KEY": public}
    arms = cell.serve_arms("arm-1", **everyone)
    agent = cell.stack.enter_context(
        Child("fixtures.lease_holder", {"url": server.url, "device": "arm-1", "ttl_s": 300.0})
    )
    page = cell.open(cell.serve_page("--nats", server.url, "--operator-key", str(key)), robots=1)
    assert agent.ask("acquire")["status"] == "success"
    assert agent.ask("execute")["status"] == "success"
    card(page, "arm-1").get_by_text("agent-a (agent) holds control").wait_for()

    open_robot(page)
    page.get_by_role("button", name="Take control").click()
    page.locator(".drive .said[data-tone='bad']").wait_for()
    assert moving(arms), "without the operator's signature the agent goes on"
    picture(page, "take-refused")

    page.fill("#take-passphrase", PASSPHRASE)
    page.get_by_role("button", name="Take control").click()
    page.get_by_text("You hold control").wait_for()
    assert not moving(arms), "the agent's motion is halted"
    assert agent.ask("execute")["code"] == "displaced"
    page.get_by_text("Taken from agent-a, signed with the operator's key.").wait_for()
    taken = page.locator(".events li", has_text="Control taken over, by this page")
    assert "from: agent-a · signed: yes" in taken.inner_text()
    picture(page, "taken-over")

    page.get_by_role("button", name="Give control back").click()
    page.get_by_text("nobody holds control").wait_for()
    assert agent.ask("acquire")["status"] == "success"
    assert agent.ask("execute")["status"] == "success"
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped")
