"""The page on both networks at once: robots of each, one on both, two of one id, and a network that comes later."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from fixtures.nats_server import NatsServer
from fixtures.page_driving import answer, card, hold_until, moving, open_robot, take, verb_form
from fixtures.page_site import picture
from fixtures.waiting import accepts, eventually

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.safety.ed25519 import keygen

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
PASSPHRASE = "Plenty of 4 different words"
PAGE_NAMES = {DEVICE_CONNECT: "dc", MESH: "mesh"}


def keys(page: Any) -> list[str]:
    """Return the keys of the cards."""
    return sorted(page.evaluate("[...document.querySelectorAll('.card')].map((each) => each.dataset.key)"))


def start(page: Any, verb: str) -> Any:
    """Start a task by its form; return what the page says of it."""
    form = verb_form(page, verb)
    form.locator(f"#p-{verb}-instruction").fill("wave")
    if form.locator(f"#p-{verb}-policy_provider").is_visible():
        form.locator(f"#p-{verb}-policy_provider").fill("mock")
    form.get_by_role("button", name="Run").click()
    return form.locator(".said")


def halt(page: Any, *arms: Any) -> None:
    """Halt the robot that is open, and wait until the arms stand."""
    page.locator("#robot .halt").click()
    page.locator("#robot .halt-said[data-tone='good']").wait_for(timeout=30_000)
    for each in arms:
        eventually(lambda each=each: not moving(each), what="the arm stands")  # type: ignore[misc]


@pytest.mark.parametrize("network", [DEVICE_CONNECT, MESH])
def test_robot_of_each_network_is_called_driven_stopped_and_freed(cell: Any, tmp_path: Path, network: str) -> None:
    key, name = tmp_path / "operator.pem", PAGE_NAMES[network]
    arms = cell.serve_arms("arm-1", networks=[network], STRANDS_MESH_RESUME_PUBLIC_KEY=keygen(key, PASSPHRASE))
    page = cell.open(cell.serve_page("--operator-key", str(key)), robots=1)
    button = take(page, network=name)
    form = verb_form(page, "wipe")
    form.locator("#p-wipe-strokes").fill("2")
    form.get_by_role("button", name="Run").click()
    form.locator(".said[data-tone='good']").wait_for(timeout=30_000)
    assert arms.ask("facts")["arm-1"]["wiped"] == 2
    hold_until(page, button, lambda: moving(arms), "the arm moves")
    page.mouse.up()
    page.locator(".drive .said", has_text="Stopped (").wait_for(timeout=30_000)
    eventually(lambda: not moving(arms), what="the arm stands")
    arms.ask("move")
    halt(page, arms)
    form.locator("#p-wipe-strokes").fill("9")
    form.get_by_role("button", name="Run").click()
    eventually(lambda: arms.ask("facts")["arm-1"]["wiped"] > 2, what="it wipes")
    page.locator("#robot-title").click()
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped", name)
    page.locator("#robot .lock", has_text=re.compile("^LOCKED by")).wait_for(timeout=30_000)
    assert button.is_disabled()
    page.locator("#resume summary").click()
    page.fill("#resume-passphrase", PASSPHRASE)
    page.keyboard.press("Enter")
    page.locator("#robot .lock", has_text=re.compile("^not locked")).wait_for(timeout=60_000)
    assert arms.ask("facts")["arm-1"]["epochs"] == []
    assert page.problems == []


def test_robot_on_both_networks_has_one_row_and_a_second_one_where_the_first_is_cut_off(cell: Any) -> None:
    server = cell.stack.enter_context(NatsServer())
    cell.link = LinkConfig(transport="nats", connect=(server.url,))
    arms = cell.serve_arms("arm-1", networks=[DEVICE_CONNECT, MESH])
    page = cell.open(cell.serve_page("--nats", server.url), robots=1)
    eventually(lambda: keys(page) == ["dc:arm-1"], 30.0, "one row")
    open_robot(page)
    start(page, "execute")
    eventually(lambda: moving(arms), what="the arm moves")
    halt(page, arms)
    page.locator("a", has_text="All robots").click()
    eventually(lambda: keys(page) == ["dc:arm-1"], 30.0, "one row")
    server.kill()
    eventually(lambda: keys(page) == ["dc:arm-1", "mesh:arm-1"], 60.0, "its row of the mesh")
    card(page, "arm-1", "mesh").locator(".name").get_by_text("arm-1 (mesh)").wait_for(timeout=30_000)
    picture(page, "one-robot-cut-off-on-one-network")
    open_robot(page, network="mesh")
    said = start(page, "start")
    eventually(lambda: moving(arms), 30.0, f"the arm moves: {said.inner_text()}")
    halt(page, arms)
    page.locator("a", has_text="All robots").click()
    server.start()
    eventually(lambda: keys(page) == ["dc:arm-1"], 60.0, "one row")


def test_two_robots_of_one_id_have_two_rows_are_moved_by_none_and_stopped_by_either(cell: Any) -> None:
    first = cell.serve_arms("arm-1")
    other = cell.folder / "others"
    other.mkdir(mode=0o700)
    second = cell.serve_arms("arm-1", networks=[MESH], STRANDS_STATE_DIR=str(other))
    page = cell.open(cell.serve_page(), robots=2)
    names = [card(page, "arm-1", each).locator(".name") for each in ("dc", "mesh")]
    names[0].get_by_text("arm-1 (Device Connect)").wait_for(timeout=30_000)
    names[1].get_by_text("arm-1 (mesh)").wait_for(timeout=30_000)
    picture(page, "two-robots-of-one-id")
    open_robot(page)
    said = start(page, "execute")
    said.get_by_text("device_connect and mesh both have a robot of this id").wait_for(timeout=30_000)
    page.get_by_role("button", name="Take control").click()
    page.locator(".drive .said", has_text="device_connect and mesh").wait_for(timeout=30_000)
    assert not moving(first) and not moving(second)
    for arms in (first, second):
        arms.ask("move")
    halt(page, first, second)
    for arms in (first, second):
        arms.ask("move")
    page.get_by_role("button", name="STOP this one").click()
    for network in ("dc", "mesh"):
        answer(page, "arm-1", "stopped", network)
    eventually(lambda: not moving(first) and not moving(second), what="both arms stand")


LINKS = """() => new Promise((tell) => {
  const socket = new WebSocket(`ws://${location.host}/stop`);
  socket.onopen = () => socket.send('{"type": "hello"}');
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.type === "link") { socket.close(); tell(Object.keys(message.links)); }
  };
})"""
"""The networks that a stop would leave on."""


@pytest.mark.parametrize("network", [DEVICE_CONNECT, MESH])
def test_network_without_a_robot_spoils_no_verdict(cell: Any, network: str) -> None:
    # By default both networks of a machine meet at one port.
    environment = cell.machine.environment
    environment["STRANDS_MESH_PORT"] = cell.settings["STRANDS_MESH_PORT"] = environment["STRANDS_DC_PORT"]
    arms = cell.serve_arms("arm-1", networks=[network])
    page = cell.open(cell.serve_page("--mesh"), robots=1)
    eventually(lambda: page.evaluate(LINKS) == ["dc", "mesh"], 30.0, "both networks")
    arms.ask("move")
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped", PAGE_NAMES[network])
    page.locator(".stop-head[data-tone='good']", has_text="The robot stopped.").wait_for(timeout=30_000)
    assert "The roster has no robot" not in page.locator("#stop-said").inner_text()


def test_page_starts_without_its_broker_and_a_press_leaves_there_once_it_comes(cell: Any) -> None:
    server = cell.stack.enter_context(NatsServer())
    cell.link = LinkConfig(transport="nats", connect=(server.url,))
    arms, sim = cell.serve_arms("arm-1"), cell.serve_arms("sim-1", networks=[MESH])
    server.kill()
    page = cell.open(cell.serve_page("--nats", server.url), robots=1)
    assert keys(page) == ["mesh:sim-1"]
    page.locator("#missing", has_text="Device Connect is missing: ").wait_for(timeout=60_000)
    picture(page, "device-connect-missing")
    for each in (arms, sim):
        each.ask("move")
    page.keyboard.press("Space")
    answer(page, "sim-1", "stopped", "mesh")
    eventually(lambda: not moving(sim, "sim-1"), what="the arm of the mesh stands")
    assert moving(arms)
    server.start()
    answer(page, "arm-1", "stopped")
    eventually(lambda: not moving(arms), what="the other arm stands")
    page.locator("#missing").wait_for(state="hidden")


def test_robots_of_the_roster_on_a_network_that_is_gone_are_named_by_a_stop(cell: Any) -> None:
    server = cell.stack.enter_context(NatsServer())
    cell.link = LinkConfig(transport="nats", connect=(server.url,))
    arms, sim = cell.serve_arms("arm-1"), cell.serve_arms("sim-1", networks=[MESH])
    before = cell.serve_page("--nats", server.url)
    cell.open(before, robots=2)
    before.close()
    server.kill()
    page = cell.open(cell.serve_page("--nats", server.url), robots=1)
    page.locator("#missing").wait_for(timeout=60_000)
    arms.ask("move")
    page.keyboard.press("Space")
    answer(page, "sim-1", "stopped", "mesh")
    answer(page, "arm-1", "silent")
    page.locator("#alarm", has_text="DEVICE CONNECT DOES NOT ANSWER").wait_for(timeout=30_000)
    assert "nothing listens there" in page.locator("#alarm").inner_text()
    picture(page, "stop-without-device-connect")
    server.start()
    answer(page, "arm-1", "stopped")
    eventually(lambda: not moving(arms), what="the arm stands")
    sim.kill()
    page = cell.open(cell.serve_page("--nats", server.url), robots=1)
    page.keyboard.press("Space")
    answer(page, "arm-1", "stopped")
    assert "the stop did not leave: no mesh answers" in answer(page, "sim-1", "silent", "mesh").get_attribute("title")
    page.locator("#stop-said", has_text="mesh: It did not leave on mesh").wait_for(timeout=30_000)
    picture(page, "stop-without-the-mesh")


def test_mesh_that_comes_later_is_shown_and_the_page_is_not_its_hub(cell: Any) -> None:
    port = int(cell.machine.environment["STRANDS_MESH_PORT"])
    page, told = cell.open(cell.serve_page(), robots=0), cell.open(cell.serve_page("--mesh"), robots=0)
    told.locator("#missing", has_text="mesh is missing: no mesh answers").wait_for(timeout=30_000)
    assert page.locator("#missing").is_hidden(), "no one asked for a mesh"
    assert not accepts(port)
    cell.serve_arms("sim-1", networks=[MESH])
    for each in (page, told):
        card(each, "sim-1", "mesh").get_by_text("not locked").wait_for(timeout=30_000)
        each.locator("#missing").wait_for(state="hidden")
