"""The fleet over time, the grid of cameras and the filter, in a real browser."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.page_feed import PageFeed, forms_of
from fixtures.page_site import picture, shows
from fixtures.served_page import FORMS, ServedPage
from fixtures.waiting import eventually
from PIL import Image

from strands_robots.envelope import success

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

ROOT = Path(__file__).parents[3]
SEES = (*FORMS, *forms_of([{"name": "getPicture", "labels": {"direction": "read"}}]))
UNITS = {f"j{number}": "radians" for number in range(5)} | {"j5": "percent"}

SHIFTS = """
window.shifts = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.shifts.push([entry.value, entry.hadRecentInput,
    entry.sources.map((each) => each.node && (each.node.id || each.node.className))]);
}).observe({ type: "layout-shift", buffered: true });
"""


@contextmanager
def past(served: ServedPage, seconds: float = 280.0) -> Iterator[None]:
    """Let a past of five arms and one base go by on the model's clock, then let them go on."""
    model, real = served.model, served.model.clock
    began = real()
    behind = {"s": seconds}
    model.clock = lambda: real() - behind["s"]
    for number in range(6):
        served.robot(
            f"arm-{number}" if number < 5 else "base-1", units=UNITS, kind="strands_sim" if number else "mobile_base"
        )
    locked = {"epoch": "e" * 32, "source": "desk-1", "since": 1.0, "reason": ""}
    for step in range(int(seconds)):
        behind["s"] = seconds - step
        for number, row in enumerate(model.rows()):
            if number == 3 and 90 < step < 150:
                continue
            model.sign_of_life("dc", row.id, 4.0 + number)
            moves = (step + 40 * number) % 120 < 55 and not (number in (1, 2) and step > 180)
            model.task("dc", row.id, state="running" if moves else "idle", instruction="stack the cups")
            if number in (1, 2):
                model.update("dc", row.id, locked=step > 180, lockouts=[locked] if step > 180 else [])
            value = {f"j{joint}": 0.3 * joint + (step % 50) / 50 * moves for joint in range(5)} | {"j5": 40.0}
            model.observe("dc", row.id, value)
        if step % 2 == 0:
            model.sample(model.begin_sample())
    assert real() - began < 60
    model.clock = real
    with served.moving(4, 5.0):
        yield


def axe(page: Any) -> list[Any]:
    """Every violation that axe finds, in a world of its own: the page's policy forbids foreign scripts."""
    scripts = sorted((ROOT / ".axe").glob("axe-*.min.js"))
    assert scripts, "axe-core is missing; run: make system"
    client = page.context.new_cdp_session(page)
    client.send("Page.enable")
    frame = client.send("Page.getFrameTree")["frameTree"]["frame"]["id"]
    world = client.send("Page.createIsolatedWorld", {"frameId": frame})["executionContextId"]
    client.send("Runtime.evaluate", {"expression": scripts[-1].read_text(encoding="utf-8"), "contextId": world})
    run = (
        "axe.run(document).then((r) => JSON.stringify(r.violations.map("
        "(v) => [v.impact, v.id, v.nodes.map((n) => n.html).slice(0, 3)])))"
    )
    told = client.send("Runtime.evaluate", {"expression": run, "contextId": world, "awaitPromise": True})
    found: list[Any] = json.loads(told["result"]["value"])
    return found


def opened(page: Any, view: str) -> None:
    page.locator("#views a", has_text=view).click()
    page.locator(f"#{view.lower()}").wait_for()


def saved(page: Any, file: str) -> str:
    with page.expect_download() as told:
        page.locator(f"button[data-file={file}]").click()
    return Path(told.value.path()).read_text(encoding="utf-8")


def test_history_shows_labelled_states_and_charts_and_gives_them_as_files(page: Any, served: ServedPage) -> None:
    page.add_init_script(SHIFTS)
    with past(served):
        page.reload()
        shows(page, "document.querySelectorAll('.card').length === 6")
        opened(page, "History")
        shows(page, "document.querySelectorAll('.lane').length === 6")
        lane = page.locator(".lane[data-key='dc:arm-1']")
        label = lane.locator("canvas").get_attribute
        eventually(lambda: all(each in label("aria-label") for each in ("moving", "still", "locked")), what="states")
        page.locator(".lane[data-key='dc:arm-3'] canvas[aria-label*='silent']").wait_for()
        lane.locator("button").click()
        shows(page, "document.querySelector('#chart-joints canvas').ariaLabel.includes('j4: from')")
        assert "in degrees" in page.locator("#chart-joints canvas").get_attribute("aria-label")
        assert "j5" in page.locator("#chart-others canvas").get_attribute("aria-label")
        assert "states no load" in page.locator(".load-note").inner_text()
        for width, height in ((1280, 1500), (360, 800)):
            for scheme in ("light", "dark"):
                page.set_viewport_size({"width": width, "height": height})
                page.emulate_media(color_scheme=scheme)
                page.wait_for_timeout(1500)
                assert page.evaluate("document.documentElement.scrollWidth") <= width
                assert axe(page) == []
                picture(page, f"history-{width}-{scheme}")
        page.set_viewport_size({"width": 1280, "height": 1500})
        rows = list(csv.DictReader(io.StringIO(saved(page, "states"))))
        assert {row["robot"] for row in rows} == {f"arm-{number}" for number in range(5)} | {"base-1"}
        assert {"moving", "still", "locked", "silent"} <= {row["state"] for row in rows}
        assert all(float(row["duration (s)"]) > 0 and row["from (ISO 8601, UTC)"].endswith("Z") for row in rows)
        charts = list(csv.DictReader(io.StringIO(saved(page, "charts"))))
        assert {"j1 (degrees)", "j5 (percent)", "messages (messages a second)"} <= set(charts[0])
        assert any(row["j1 (degrees)"] == "17.189" for row in charts), "0.3 rad"
        both = json.loads(saved(page, "json"))
        assert len(both["states"]) >= len(rows) and both["charts"]["robot"] == "arm-1"
        # Nothing moves by itself, nor after a press.
        page.wait_for_timeout(1000)
        page.evaluate("window.shifts = []")
        for seconds in ("900", "3600", "300"):
            page.locator(f"button[data-seconds='{seconds}']").click()
        page.locator(".lane[data-key='dc:arm-2'] button").click()
        served.robot("zebra-1")
        shows(page, "document.querySelectorAll('.lane').length === 7")
        page.keyboard.press("Space")
        eventually(lambda: served.feed.controller.presses, what="Space stops")
        shows(page, "document.querySelector('#chart-joints canvas').ariaLabel.includes('j4: from')")
        page.wait_for_timeout(2500)
        own = [each for each in page.evaluate("window.shifts") if "stop-said" not in str(each[2])]
        assert not [
            each for each in own if any(str(name).startswith(("lane", "chart", "tile", "tools")) for name in each[2])
        ]
        page.reload()
        page.locator(".lane[data-key='dc:arm-1'] canvas[aria-label*='moving']").wait_for()


def test_filter_never_hides_a_red_row_nor_stop(page: Any, served: ServedPage) -> None:
    for number in range(8):
        served.robot(f"arm-{number}", model="so101" if number % 2 else "so100", locked=number == 4)
    verdict = {"id": "e" * 32, "state": "not_stopped", "why": "no brakes", "ms": 9.0, "signed": True}
    served.model.verdict("dc", "arm-6", verdict)
    shows(page, "document.querySelectorAll('.card').length === 8")
    page.fill("#search", "arm-1")
    shows(page, "document.querySelectorAll('.card').length === 2")
    assert page.locator(".card .name").all_text_contents() == ["arm-6", "arm-1"]
    assert page.locator("#hidden-count").inner_text() == "6 hidden"
    assert page.locator("#stop").is_visible()
    page.fill("#search", "")
    page.select_option("#filter-kind", "so101 · robot · Device Connect")
    shows(page, "document.querySelectorAll('.card').length === 5")
    page.select_option("#filter", "locked")
    shows(page, "document.querySelectorAll('.card').length === 1")
    opened(page, "History")
    shows(page, "document.querySelectorAll('.lane').length === 1")
    assert page.locator(".lane").get_attribute("data-key") == "dc:arm-6"
    assert page.locator("#history-hidden-count").inner_text() == "7 hidden"


def test_halt_is_marked_in_the_lane_of_its_robot(page: Any, served: ServedPage) -> None:
    for name in ("arm-1", "arm-2"):
        served.robot(name)
    page.get_by_role("button", name="Halt arm-1").click()
    page.get_by_text("Halted at").wait_for()
    served.model.note("dc", "arm-2", "halted here", {"stopped": True})
    opened(page, "History")
    page.locator(".lane[data-key='dc:arm-1'] canvas[aria-label$=', 1 halt']").wait_for()
    picture(page, "history-halt")
    assert "halt" not in page.locator(".lane[data-key='dc:arm-2'] canvas").get_attribute("aria-label")


def test_kind_that_is_chosen_is_listed_once_without_a_robot_of_it(page: Any, served: ServedPage) -> None:
    served.robot("arm-1", model="so101")
    served.robot("arm-2")
    shows(page, "document.querySelectorAll('.card').length === 2")
    page.select_option("#filter-kind", "so101 · robot · Device Connect")
    shows(page, "document.querySelectorAll('.card').length === 1")
    assert served.model.forget("dc:arm-1", -1.0)
    page.get_by_text("No robot matches.").wait_for()
    page.wait_for_timeout(1000)
    assert page.locator("#filter-kind option[value^='so101']").count() == 1


def test_cameras_show_twelve_at_a_time_and_rest_while_nobody_looks(page: Any, served: ServedPage) -> None:
    encoded = io.BytesIO()
    Image.new("RGB", (320, 240), (40, 120, 160)).save(encoded, "JPEG")
    shot = success("a picture", jpeg=base64.b64encode(encoded.getvalue()).decode())
    feed: PageFeed = served.feed
    feed.answers["getPicture"] = [shot]
    for number in range(20):
        served.robot(f"arm-{number}", forms=SEES if number != 5 else FORMS)
    shows(page, "document.querySelectorAll('.card').length === 20")
    opened(page, "Cameras")
    shows(page, "[...document.querySelectorAll('.tile-picture')].filter((i) => i.naturalWidth === 320).length === 12")
    assert page.locator(".page-of").inner_text() == "1 to 12 of 19 cameras"
    asked = {name for name, verb, _ in feed.calls if verb == "getPicture"}
    assert "arm-5" not in asked
    for width, scheme in ((1280, "light"), (1280, "dark"), (360, "light"), (360, "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        assert axe(page) == []
        picture(page, f"cameras-{width}-{scheme}")
    page.set_viewport_size({"width": 1280, "height": 900})
    page.get_by_role("button", name="Next").click()
    shows(page, "document.querySelector('.tile .name').textContent === 'arm-13'")
    shows(page, "[...document.querySelectorAll('.tile-picture')].filter((i) => i.naturalWidth === 320).length === 7")

    def rests() -> bool:
        before = len(feed.asked("getPicture"))
        page.wait_for_timeout(1500)
        return len(feed.asked("getPicture")) == before

    page.locator("button.pause").click()
    eventually(rests, 30.0, what="no picture is asked for while it is paused")
    assert "paused" in page.locator(".tile-said").first.inner_text()
    page.locator("button.pause").click()
    shows(page, "document.querySelector('.tile-said').textContent.startsWith('live')")
    feed.answers["getPicture"] = [success("no picture")]
    shows(page, "document.querySelector('.tile-said').textContent.startsWith('OLD: no picture since')", 30.0)
    opened(page, "History")
    eventually(rests, 30.0, what="no picture is asked for in another view")
