"""The page's connections over a slow network, after an outage, and to a server that hangs."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.page_driving import card
from fixtures.page_site import shows
from fixtures.served_page import ServedPage

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

CAN_STOP = "document.body.dataset.canStop === '{}'"

SLOW = """
const Real = window.WebSocket;
window.WebSocket = class extends Real {
  set onmessage(take) { super.onmessage = (event) => setTimeout(() => { if (!window.hangs) take(event); }, 150); }
  close() { if (!window.hangs) super.close(); }
};
"""
"""A network that brings each message 150 ms late, and a server that says nothing while ``hangs`` is set."""


@pytest.fixture
def slow(page: Any, served: ServedPage) -> Any:
    page.add_init_script(SLOW)
    page.reload()
    served.robot("arm-1")
    card(page, "arm-1").wait_for()
    shows(page, CAN_STOP.format("yes"))
    return page


def test_stop_comes_back_after_an_outage_on_a_slow_network(slow: Any, served: ServedPage) -> None:
    served.stop_serving()
    shows(slow, CAN_STOP.format("no"))
    slow.wait_for_timeout(4000)
    with ServedPage(served.port) as again:
        again.robot("arm-1")
        shows(slow, CAN_STOP.format("yes"), 10.0)


def test_halt_is_told_as_not_sent_where_the_server_hangs(slow: Any) -> None:
    slow.evaluate("window.hangs = true")
    card(slow, "arm-1").get_by_role("button", name="Halt arm-1").click()
    card(slow, "arm-1").get_by_text("NOT HALTED: the page is not connected").wait_for(timeout=15_000)


def test_socket_that_does_not_open_is_given_up_after_ten_seconds(slow: Any) -> None:
    slow.evaluate(
        "() => { window.hangs = true; window.dead = 0; window.WebSocket = class extends EventTarget {"
        " static CONNECTING = 0; static OPEN = 1; readyState = 0; close() { this.readyState = 3; }"
        " constructor() { super(); window.dead += 1; } }; }"
    )
    shows(slow, "window.dead >= 2", 10.0)
    slow.wait_for_timeout(5000)
    assert slow.evaluate("window.dead") == 2, "each has its time"
    shows(slow, "window.dead >= 4", 20.0)
