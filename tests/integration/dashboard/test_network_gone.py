"""The network between the page's server and the robots is cut: two namespaces, and frames that no one forwards."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.network_lab import NetworkLab, missing
from fixtures.page_driving import answer, moving
from fixtures.page_lab import page_beyond
from fixtures.page_site import chromium, picture, shows

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


@pytest.fixture
def lab() -> Iterator[NetworkLab]:
    pytest.importorskip("playwright.sync_api")
    assert chromium(), "Chromium is not installed; run: make system"
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    with NetworkLab() as made:
        yield made


@pytest.mark.parametrize("transport", ["zenoh", "nats"])
def test_page_says_that_the_network_is_cut_and_a_press_arrives_when_it_heals(
    lab: NetworkLab, tmp_path: Path, transport: str
) -> None:
    with page_beyond(lab, tmp_path, transport) as (arms, page):
        arms.ask("move")
        lab.weather.parted = True
        shows(page, "document.body.dataset.canStop === 'no'", 30.0)
        said = page.locator("#alarm").inner_text()
        assert re.search("THE NETWORK DOES NOT ANSWER|NO ROBOT HAS BEEN HEARD", said), said
        assert "hardware emergency stop" in said
        picture(page, f"network-cut-{transport}")
        page.locator("#stop").click()
        answer(page, "arm-1", "silent")
        assert moving(arms), "the press is still under way"
        lab.weather.parted = False
        answer(page, "arm-1", "stopped")
        assert not moving(arms)
        shows(page, "document.body.dataset.canStop === 'yes'", 60.0)
