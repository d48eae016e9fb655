"""Another page in the same browser, a rebound name, a robot with a hostile name, and axe."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.page_driving import open_robot
from fixtures.page_site import picture, shows
from fixtures.served_page import ServedPage

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
ROOT = Path(__file__).parents[3]

ATTACK = (ROOT / "fixtures" / "hostile_page.html").read_bytes()


@contextmanager
def hostile_site() -> Iterator[str]:
    """Another site on this machine."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(ATTACK)

        def log_message(self, *args: Any) -> None:
            """Keep quiet."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def test_names_that_every_object_has_are_only_names(page: Any, served: ServedPage) -> None:
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    served.robot("arm-1", kind="constructor", model="toString")
    served.model.observe("dc", "arm-1", {"constructor": 0.5, "valueOf": 0.25})
    served.model.note("dc", "arm-1", "constructor", {"hasOwnProperty": "x"})
    open_robot(page)
    page.locator(".bar").first.wait_for()
    assert page.locator("#robot .kind").inner_text() == "toString \u00b7 constructor \u00b7 Device Connect"
    page.locator(".events li", has_text="constructor").wait_for()
    assert "native code" not in page.locator("#robot").inner_text()
    page.locator("#views a", has_text="History").click()
    page.locator("button[data-file=charts]:enabled").wait_for()
    shows(page, "document.querySelector('#chart-others canvas').ariaLabel.includes('valueOf')")
    assert problems == []


def test_hostile_page_in_the_same_browser_reaches_nothing(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    page.locator(".card").wait_for()
    with hostile_site() as evil:
        other = page.context.new_page()
        other.goto(evil)
        found = other.evaluate(f"attack({served.url.rstrip('/')!r})")
        picture(other, "hostile-page")
    blind = found.pop("blind post")
    assert blind in ("sent", "refused"), "it cannot read the answer, which is 403"
    assert set(found.values()) == {"refused"}, found
    assert served.feed.controller.presses == []
    assert served.feed.calls == []


def test_rebound_name_reaches_nothing(page: Any, served: ServedPage) -> None:
    other = page.context.new_page()
    answer = other.goto(f"http://rebound.example:{served.port}/")
    assert answer.status == 403
    opened = other.evaluate(
        f"""() => new Promise((yes) => {{
          const socket = new WebSocket("ws://rebound.example:{served.port}/stop");
          socket.onopen = () => yes("open"); socket.onclose = () => yes("refused");
        }})"""
    )
    picture(other, "rebound")
    assert opened == "refused"
    assert served.feed.controller.presses == []


def test_robot_with_a_hostile_name_is_text(page: Any, served: ServedPage) -> None:
    name = "<img src=x onerror=window.owned=1>"
    served.robot(name, model="<script>window.owned=1</script>", kind="javascript:window.owned=1")
    served.model.task("dc", name, state="running", instruction="</style><svg onload=window.owned=1>")
    served.model.note("dc", name, name, {name: name})
    served.model.verdict("dc", name, {"id": "e" * 32, "state": "not_stopped", "why": name, "ms": 1.0, "signed": False})
    page.locator(".card .name").wait_for()
    assert page.locator(".card .name").inner_text() == name
    assert page.locator(".card img[onerror], .card script, .card svg").count() == 0
    picture(page, "hostile-name")
    page.locator(".card .name").click()
    page.locator("#robot-title").get_by_text(name).wait_for()
    assert page.evaluate("window.owned") is None


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(page: Any, served: ServedPage, scheme: Any) -> None:
    page.emulate_media(color_scheme=scheme)
    states = ("stopped", "claimed", "not_stopped", "silent", "alarm")
    for state in states:
        served.robot(f"arm-{state}")
        served.model.verdict(
            "dc", f"arm-{state}", {"id": "e" * 32, "state": state, "why": "", "ms": 9.0, "signed": True}
        )
        served.model.observe("dc", f"arm-{state}", {"pan": 0.1, "lift": 0.2})
    shows(page, f"document.querySelectorAll('.card').length === {len(states)}")
    scripts = sorted((ROOT / ".axe").glob("axe-*.min.js"))
    assert scripts, "axe-core is missing; run: make system"
    client = page.context.new_cdp_session(page)
    client.send("Page.enable")
    source = scripts[-1].read_text(encoding="utf-8")
    for view in ("fleet", "robot"):
        if view == "robot":
            page.locator(".card .name").first.click()
            page.locator("#robot-title").wait_for()
        # The page's own policy forbids foreign scripts, so axe runs in a world of its own.
        frame = client.send("Page.getFrameTree")["frameTree"]["frame"]["id"]
        world = client.send("Page.createIsolatedWorld", {"frameId": frame})["executionContextId"]
        client.send("Runtime.evaluate", {"expression": source, "contextId": world})
        result = client.send(
            "Runtime.evaluate",
            {
                "expression": "axe.run(document).then((r) => JSON.stringify(r.violations.map("
                "(v) => [v.impact, v.id, v.nodes.map((n) => n.html).slice(0, 5)])))",
                "contextId": world,
                "awaitPromise": True,
            },
        )
        violations = json.loads(result["result"]["value"])
        picture(page, f"{view}-{scheme}")
        assert [each for each in violations if each[0] in ("serious", "critical")] == []


def test_page_fits_a_phone_and_keeps_stop_in_reach(page: Any, served: ServedPage) -> None:
    for number in range(20):
        served.robot(f"arm-with-a-rather-long-name-{number}")
    page.set_viewport_size({"width": 360, "height": 740})
    shows(page, "document.querySelectorAll('.card').length === 20")
    page.evaluate("window.scrollTo(0, 2000)")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    box = page.locator("#stop").bounding_box()
    assert 0 <= box["y"] < 740 - box["height"] and box["height"] >= 48
    picture(page, "phone")
    page.locator(".card .name").first.click()
    page.locator("#robot-title").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_page_works_by_keyboard_alone(page: Any, served: ServedPage) -> None:
    served.robot("arm-1")
    page.locator(".card").wait_for()
    reached = set()
    for _ in range(20):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
    assert {"stop", "search", "filter", "sort", "name", "halt", "stop-one"} <= reached
    page.locator("#stop").focus()
    page.keyboard.press("Enter")
    shows(page, "document.getElementById('stop-said').textContent.includes('STOP pressed')")
    assert len(served.feed.controller.presses) == 1


def test_hundred_robots_at_ten_hertz_are_all_shown(page: Any, served: ServedPage) -> None:
    with served.moving(100, 10.0):
        shows(page, "document.querySelectorAll('.card').length === 100", 20.0)
        shows(page, "[...document.querySelectorAll('.task')].filter((t) => t.textContent.includes('step')).length > 90")
        picture(page, "hundred-robots")
        page.keyboard.press("Space")
        shows(page, "document.getElementById('stop-said').textContent.includes('stopped')")
