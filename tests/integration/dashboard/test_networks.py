"""The page on other networks and addresses: signed stops, the mesh, a phone's address, a broker that dies, the demo."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import psutil
import pytest
from fixtures.nats_server import NatsServer
from fixtures.page_driving import answer, card, hold_until, moving, open_robot, take, verb_form
from fixtures.page_site import picture, shows
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.ed25519 import keygen

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
PASSPHRASE = "Plenty of 4 different words"


def test_stop_is_signed_with_the_key_and_shown_so(cell: Any, tmp_path: Path) -> None:
    key, secret = tmp_path / "stop.pem", tmp_path / "passphrase"
    secret.write_text(PASSPHRASE, encoding="utf-8")
    arms = cell.serve_arms(DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=keygen(key, PASSPHRASE))
    assert cell.machine.run("enroll", "--json").returncode == 0
    unsigned = cell.open(cell.serve_page())
    arms.ask("move")
    unsigned.keyboard.press("Space")
    answer(unsigned, "arm-1", "silent")
    assert moving(arms), "these robots stop for a signature only"
    unsigned.close()
    page = cell.open(cell.serve_page("--key", str(key), "--passphrase-file", str(secret), "--as", "desk-1"))
    assert page.locator("#stop-hint").inner_text() == "all robots (Space), signed"
    page.keyboard.press("Space")
    for name in ("arm-1", "arm-2", "arm-3"):
        assert "signed by the robot" in answer(page, name, "stopped").inner_text()
    assert not any(each["moving"] for each in arms.ask("facts").values())
    picture(page, "signed-stop")


def test_robot_of_the_mesh_is_shown_driven_and_stopped(cell: Any) -> None:
    cell.machine.environment["STRANDS_MESH_PORT"] = str(free_port())
    cell.stack.enter_context(cell.machine.serving("sim-1", "--mesh"))
    page = cell.open(cell.serve_page("--mesh"), robots=1)
    shown = card(page, "sim-1", "mesh")
    shown.get_by_text("mesh", exact=False).first.wait_for()
    shown.get_by_text("not locked").wait_for(timeout=30_000)
    shown.locator("a.name").click()
    start = verb_form(page, "start")
    start.locator("#p-start-instruction").fill("wave")
    start.locator("#p-start-policy_provider").fill("mock")
    start.locator(".more summary").click()
    start.locator("#p-start-duration").fill("300")
    start.get_by_role("button", name="Run").click()
    page.locator("#robot .task", has_text="running").wait_for(timeout=30_000)
    picture(page, "mesh-robot")
    page.keyboard.press("Space")
    answer(page, "sim-1", "stopped", "mesh")
    page.locator("#robot .lock", has_text=re.compile("LOCKED by")).wait_for()
    page.locator("#robot .task", has_text="idle").or_(page.locator("#robot .task", has_text="stopped")).wait_for()


def own_address() -> str:
    """Return an address of this machine that other machines could use."""
    for rows in psutil.net_if_addrs().values():
        for row in rows:
            if row.family is socket.AF_INET and not row.address.startswith("127."):
                return str(row.address)
    pytest.skip("this machine has no address besides loopback")


def test_other_address_asks_for_a_token_over_tls_and_gives_its_role(cell: Any) -> None:
    arms = cell.serve_arms()
    server = cell.serve_page("--listen", own_address())
    remote = server.events["serving"]["remote"]
    assert all(each.startswith("https://") for each in remote.values())
    bare = remote["viewer"].partition("#")[0]

    def opened(url: str) -> Any:
        context = cell.chrome.new_context(ignore_https_errors=True, viewport={"width": 360, "height": 740})
        cell.stack.callback(context.close)
        page = context.new_page()
        page.goto(url)
        return page

    stranger = opened(bare)
    shows(stranger, "document.getElementById('alarm').textContent.includes('needs its token')", 30.0)
    assert stranger.locator(".card").count() == 0
    picture(stranger, "no-token")
    viewer = opened(remote["viewer"])
    shows(viewer, "document.querySelectorAll('.card').length === 3 && document.body.dataset.canStop === 'yes'", 30.0)
    assert "token" not in viewer.url, "the token leaves the address bar"
    open_robot(viewer)
    viewer.locator(".drive").get_by_text("You are a viewer").wait_for()
    assert viewer.get_by_role("button", name="Take control").is_disabled()
    operator = opened(remote["operator"])
    shows(operator, "document.querySelectorAll('.card').length === 3 && document.body.dataset.canStop === 'yes'", 30.0)
    hold_until(operator, take(operator), lambda: moving(arms), "the arm moves")
    operator.mouse.up()
    eventually(lambda: not moving(arms), what="the arm stands")
    viewer.locator("#stop").click()
    for name in ("arm-1", "arm-2", "arm-3"):
        answer(operator, name, "stopped")
    operator.locator("#resume summary").click()
    operator.get_by_text("possible only on the machine").wait_for()
    picture(operator, "phone-remote")


def test_page_says_that_it_cannot_stop_when_the_broker_dies_and_a_press_arrives_when_it_is_back(cell: Any) -> None:
    server = cell.stack.enter_context(NatsServer())
    cell.link = LinkConfig(transport="nats", connect=(server.url,))
    arms = cell.serve_arms()
    page = cell.open(cell.serve_page("--nats", server.url))
    arms.ask("move")
    server.kill()
    shows(page, "document.body.dataset.canStop === 'no'", 20.0)
    said = page.locator("#alarm").inner_text()
    assert re.search("THE NETWORK DOES NOT ANSWER|NO ROBOT HAS BEEN HEARD", said) and "hardware emergency stop" in said
    picture(page, "broker-dead")
    page.locator("#stop").click()
    assert moving(arms)
    server.start()
    for name in ("arm-1", "arm-2", "arm-3"):
        answer(page, name, "stopped")
    assert not any(each["moving"] for each in arms.ask("facts").values())
    shows(page, "document.body.dataset.canStop === 'yes'", 30.0)


def test_newcomer_drives_stops_and_frees_a_robot_of_the_demo(cell: Any) -> None:
    server = cell.serve_page("--demo")
    page = cell.open(server, robots=0)
    shows(page, "document.querySelectorAll('.card').length === 4", 100.0)
    shows(page, "document.body.dataset.canStop === 'yes'", 60.0)
    picture(page, "demo-fleet")
    button = take(page, "shoulder_pan +")
    mark = "document.querySelector('#robot .mark').style.left"
    shows(page, f"{mark} !== ''", 30.0)
    before = page.evaluate(mark)
    hold_until(page, button, lambda: page.evaluate(f"{mark} !== {before!r}"), "the arm moves")
    picture(page, "demo-robot")
    page.mouse.up()
    page.locator(".drive .said", has_text="Stopped (").wait_for(timeout=30_000)
    page.keyboard.press("Space")
    for name in ("arm-1", "arm-2", "arm-3", "arm-4"):
        answer(page, name, "stopped")
    page.locator("#robot .lock", has_text=re.compile("LOCKED by")).wait_for(timeout=30_000)
    page.locator(".drive").get_by_text("It is LOCKED").wait_for()
    shows(page, "document.querySelector(\"button.jog[aria-label='shoulder_pan +']\").disabled")
    picture(page, "demo-stopped")
    page.locator("#resume summary").click()
    page.fill("#resume-passphrase", server.events["demo"]["passphrase"])
    page.keyboard.press("Enter")
    page.locator("#resume .said[data-tone='good']").wait_for(timeout=60_000)
    page.locator("#robot .lock", has_text=re.compile("^not locked")).wait_for(timeout=30_000)
    assert page.problems == []
