"""The operator's page in Chromium: from the press to the last write, jogs, first paint, and a hundred robots.

Times are those of the input event in the browser and of the last write in the robots' process, on one machine, whose
processes share the clock. Nothing is compared: the bare framework has no page.
"""

from __future__ import annotations

import os
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
from fixtures.child import Child
from fixtures.command_line import Machine
from fixtures.network_lab import NetworkLab, missing
from fixtures.page_lab import page_beyond
from fixtures.page_site import PageServer, browser, shows
from fixtures.stop_robots import robots
from fixtures.waiting import eventually

from benchmarks.table import Row
from strands_robots.dashboard.server import STATIC
from strands_robots.device_connect.backends import loopback_config

FOUR = tuple(f"arm-{number}" for number in range(1, 5))
APART_S = 1.2
"""Between two presses: closer ones are one stop."""

NOTE_INPUT = """
window.pressedAt = 0;
for (const name of ["pointerdown", "pointerup"]) window.addEventListener(name, (event) => {
  window[name === "pointerdown" ? "pressedAt" : "releasedAt"] = performance.timeOrigin + event.timeStamp;
}, true);
new MutationObserver(() => {
  const alarm = document.getElementById("alarm");
  if (alarm && alarm.hidden) window.alarmedAt = 0;
  else if (alarm && !window.alarmedAt) window.alarmedAt = performance.timeOrigin + performance.now();
  if (!window.paintedAt && document.querySelectorAll(".card").length >= 4) {
    const painted = () => { window.paintedAt = window.paintedAt || performance.now(); };
    requestAnimationFrame(() => requestAnimationFrame(painted));
  }
}).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["hidden"] });
"""


class Bench:
    """Robots in a process, a page's server in another, and Chromium."""

    def __init__(self, stack: ExitStack, names: tuple[str, ...], hz: float, **settings: str) -> None:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in ("robots", "server"):
            (folder / name).mkdir(mode=0o700)
        machine = Machine(folder / "server")
        link = loopback_config(int(machine.environment["STRANDS_DC_PORT"]))
        state = {
            "STRANDS_STATE_DIR": str(folder / "robots"),
            "DEVICE_CONNECT_RPC_ALLOW": "dashboard",
            "STRANDS_ROBOT_COMMAND_ALLOW": "execute,moveJoints,acquireControl",
            **settings,
        }
        self.count = len(names)
        self.arms: Child = robots(link, *names, hz=hz, environment=state)
        stack.callback(self.arms.close)
        eventually(lambda: self.arms.ask("ready"), 60.0, what="the robots' e-stop links")
        self.server = PageServer(machine)
        stack.callback(self.server.close)

    @contextmanager
    def page(self) -> Iterator[Any]:
        """A page that could stop every robot, in a Chromium of its own."""
        with browser() as chrome:
            opened = chrome.new_page()
            opened.add_init_script(NOTE_INPUT)
            opened.goto(self.server.url)
            ready = (
                f"document.querySelectorAll('.card').length >= {self.count} && document.body.dataset.canStop === 'yes'"
            )
            shows(opened, ready, 60.0)
            yield opened

    def last_write(self, name: str = "arm-1") -> float:
        """Wait until an arm stands; monotonic seconds of its last write."""
        eventually(lambda: not self.arms.ask("facts")[name]["moving"], what="the arm stands")
        return float(self.arms.ask("facts")[name]["last"])


def _monotonic(wall_ms: float) -> float:
    """Return wall-clock milliseconds of the browser in monotonic seconds."""
    return wall_ms / 1000 - time.time() + time.monotonic()


def _row(what: str, samples: list[float], bound_ms: float) -> Row:
    ordered = sorted(samples)
    worst = ordered[max(0, round(0.99 * len(ordered)) - 1)]
    ours = f"p50 {statistics.median(ordered):.1f} p99 {worst:.1f} max {ordered[-1]:.1f} ms, {len(ordered)} times"
    return Row(what, ours, "", None, f"p99 ≤ {bound_ms:g} ms", worst <= bound_ms)


def _presses(bench: Bench, times: int) -> list[float]:
    took = []
    with bench.page() as page:
        box = page.locator("#stop").bounding_box()
        page.mouse.move(box["x"] + 20, box["y"] + 20)
        for _ in range(times):
            bench.arms.ask("move")
            time.sleep(APART_S)
            page.mouse.down()
            page.mouse.up()
            last = max(bench.last_write(name) for name in FOUR)
            took.append((last - _monotonic(page.evaluate("window.pressedAt"))) * 1000)
            bench.arms.ask("clear")
    return took


def _jogs(bench: Bench, times: int, let_go: Callable[[Any], float]) -> list[float]:
    took = []
    with bench.page() as page:
        button = _controlled(page)
        for _ in range(times):
            _hold(page, button)
            eventually(lambda: bench.arms.ask("facts")["arm-1"]["moving"], what="the arm moves")
            time.sleep(0.3)
            at = let_go(page)
            took.append((bench.last_write() - at) * 1000)
            page.mouse.up()
            shows(page, "document.querySelector('.drive .said').dataset.tone !== 'warn'")
    return took


def _kills(bench: Bench, times: int) -> list[float]:
    took = []
    for _ in range(times):
        with browser() as chrome:
            page = chrome.new_page()
            page.goto(bench.server.url)
            shows(page, f"document.querySelectorAll('.card').length >= {bench.count}")
            _hold(page, _controlled(page))
            eventually(lambda: bench.arms.ask("facts")["arm-1"]["moving"], what="the arm moves")
            time.sleep(0.3)
            info = chrome.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
            began = time.monotonic()
            for each in info:
                if psutil.pid_exists(each["id"]):
                    os.kill(each["id"], signal.SIGKILL)
            took.append((bench.last_write() - began) * 1000)
        eventually(lambda: not bench.arms.ask("facts")["arm-1"]["moving"])
        time.sleep(APART_S)
    return took


def _controlled(page: Any) -> Any:
    """Open the first robot, take control, and return the button of its first joint."""
    page.locator(".card[data-key='dc:arm-1'] a.name").click()
    page.get_by_role("button", name="Take control").click()
    shows(page, "document.querySelector(\"button.jog[aria-label='pan +']\")?.disabled === false")
    button = page.locator("button.jog[aria-label='pan +']")
    button.scroll_into_view_if_needed()
    return button


def _hold(page: Any, button: Any) -> None:
    box = button.bounding_box()
    page.mouse.move(box["x"] + 10, box["y"] + 10)
    page.mouse.down()


def _release(page: Any) -> float:
    page.mouse.up()
    return _monotonic(page.evaluate("window.releasedAt"))


def _hide(page: Any) -> float:
    hidden: float = page.evaluate(
        "() => { Object.defineProperty(document, 'hidden', {get: () => true, configurable: true});"
        " const at = Date.now(); document.dispatchEvent(new Event('visibilitychange'));"
        " delete document.hidden; return at; }"
    )
    return _monotonic(hidden)


def _silences(page: Any, times: int, gone: Callable[[bool], object]) -> list[float]:
    """Milliseconds from when something is gone until the page says that it cannot stop."""
    took = []
    for _ in range(times):
        shows(page, "document.body.dataset.canStop === 'yes' && window.alarmedAt === 0", 60.0)
        began = time.monotonic()
        gone(True)
        try:
            shows(page, "window.alarmedAt > 0", 60.0)
            # Before it comes back, which ends the alarm.
            took.append((_monotonic(page.evaluate("window.alarmedAt")) - began) * 1000)
        finally:
            gone(False)
    return took


def _hangs(bench: Bench, times: int, process: Any) -> list[float]:
    with bench.page() as page:
        return _silences(page, times, lambda gone: os.kill(process.pid, signal.SIGSTOP if gone else signal.SIGCONT))


def _cuts(times: int) -> list[Row]:
    """Cut the network between the page's server and the robots, which needs root."""
    rows = []
    for transport in () if missing() else ("zenoh", "nats"):
        with NetworkLab() as lab, tempfile.TemporaryDirectory() as folder:

            def cut(gone: bool, lab: NetworkLab = lab) -> None:
                lab.weather.parted = gone

            with page_beyond(lab, Path(folder), transport, NOTE_INPUT) as (_, page):
                rows.append(_row(f"network cut until the page says so, {transport}", _silences(page, times, cut), 1000))
    return rows


def _paint(bench: Bench) -> list[float]:
    took = []
    for _ in range(5):
        with bench.page() as page:
            shows(page, "window.paintedAt > 0")
            took.append(float(page.evaluate("window.paintedAt")))
    return took


def _weight(bench: Bench) -> Row:
    with bench.page() as page:
        origins = page.evaluate(
            "[...new Set(performance.getEntriesByType('resource').map((each) => new URL(each.name).origin))]"
        )
    weight = sum(path.stat().st_size for path in STATIC.iterdir()) / 1000
    one = origins == [bench.server.url.rstrip("/")]
    return Row(
        "page weight, and origins",
        f"{weight:.0f} kB, {len(origins)} origin",
        "",
        None,
        "≤ 300 kB, one",
        one and weight <= 300,
    )


def hundred(seconds: float, robots_: int = 100) -> list[Row]:
    """Measure a server and a page with so many robots at 10 Hz; also the soak."""
    names = tuple(f"arm-{number}" for number in range(1, robots_ + 1))
    quiet = {"STRANDS_DC_STREAM_HZ": "10", "STRANDS_DC_STATE_BUSY_HZ": "1", "STRANDS_DC_STATE_HZ": "0.2"}
    with ExitStack() as stack:
        bench = Bench(stack, names, 10.0, **quiet)
        bench.arms.ask("move")
        with bench.page() as page:
            process = psutil.Process(bench.server.process.pid)
            before, memory = sum(process.cpu_times()[:2]), process.memory_info().rss
            began = time.monotonic()
            count = (
                "(ms) => new Promise((yes) => { let n = 0; const began = performance.now();"
                " const next = () => { n += 1; const took = performance.now() - began;"
                " took < ms ? requestAnimationFrame(next) : yes(1000 * n / took); }; requestAnimationFrame(next); })"
            )
            frames = float(page.evaluate(count, seconds * 1000))
            passed = time.monotonic() - began
            share = 100 * (sum(process.cpu_times()[:2]) - before) / passed
            grown = (process.memory_info().rss - memory) / 2**20
            page.keyboard.press("Space")
            shows(page, "document.querySelector('.stop-head')?.dataset.tone === 'good'", 60.0)
            stopped = page.evaluate("document.querySelectorAll('.card .verdict[data-tone=good]').length")
            stopped = min(stopped, sum(not each["moving"] for each in bench.arms.ask("facts").values()))
    told = f"{robots_} robots at 10 Hz for {passed:.0f} s"
    return [
        Row(f"{told}: the server's CPU", f"{share:.0f} % of a core", "", None, "≤ 40 %", share <= 40),
        Row(
            f"{told}: frames of the page, software rendering", f"{frames:.0f} a second", "", None, "≥ 20", frames >= 20
        ),
        Row(
            f"{told}: the server's memory, and the robots that a press then stopped",
            f"{grown:+.0f} MiB, {stopped} robots",
            "",
            None,
            f"≤ 50 MiB, {robots_}",
            grown <= 50 and stopped == robots_,
        ),
    ]


def run(*, quick: bool = False) -> list[Row]:
    """Return the rows of the table."""
    presses, jogs, kills, silences = (8, 6, 2, 2) if quick else (60, 25, 5, 5)
    with ExitStack() as stack:
        bench = Bench(stack, FOUR, 500.0 / len(FOUR), STRANDS_DC_STREAM_HZ="10", STRANDS_DC_STATE_BUSY_HZ="5")
        rows = [
            _row("click on STOP to the last write, four robots", _presses(bench, presses), 40),
            _row("jog released to the last write", _jogs(bench, jogs, _release), 300),
            _row("tab hidden during a jog to the last write", _jogs(bench, jogs, _hide), 300),
            _row("browser killed during a jog to the last write", _kills(bench, kills), 500),
            _row("first useful paint, four robots", _paint(bench), 1500),
            _row("server hangs until the page says so", _hangs(bench, silences, bench.server.process), 1000),
            _row("network silent until the page says so", _hangs(bench, silences, bench.arms), 1000),
            _weight(bench),
        ]
    return [*rows, *_cuts(silences), *hundred(10.0 if quick else 60.0)]
