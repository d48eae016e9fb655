"""The page in a real browser moves a real arm's driver: LeRobot's, on emulated servos."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.page_driving import end_turns, hand_leads, hold_until, policy_drives, take
from fixtures.page_site import PageServer, picture, shows
from fixtures.waiting import eventually

from strands_robots.device_connect import FleetClient, loopback_config

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
ROOT = Path(__file__).parents[3]
PYTHON = ROOT / ".venv-lerobot" / "bin" / "python"


def test_joint_buttons_move_an_arm_that_is_served_for_the_page(chrome: Any, tmp_path: Path) -> None:
    assert PYTHON.exists(), "LeRobot's driver is not installed; run: make real-arm"
    machine = Machine(tmp_path)
    line = ["serve", "so101", "--peer-id", "arm-1", "--emulated", "--drive-by-page"]
    line += ["--allow-mock", "--json", "--until-stdin-closes"]
    paths = {"PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT)))}
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    command = [str(PYTHON), "-m", "strands_robots.cli", *line]
    arm = subprocess.Popen(command, env={**machine.environment, **paths}, **pipes)
    server = None
    try:
        assert arm.stdout is not None
        assert json.loads(arm.stdout.readline())["event"] == "serving"
        server = PageServer(machine)
        page = chrome.new_page(viewport={"width": 1280, "height": 800})
        page.goto(server.url)
        page.locator(".card").wait_for(timeout=60_000)
        with FleetClient(loopback_config(int(machine.environment["STRANDS_DC_PORT"])), "reader") as fleet:

            def pan() -> float:
                return float(fleet.call("arm-1", "getPose")["joints"]["shoulder_pan"])

            start = pan()
            button = take(page, "shoulder_pan +")
            hold_until(page, button, lambda: pan() > start + 5, "the arm turns")
            picture(page, "real-arm-driven")
            page.mouse.up()
            page.locator(".drive .said", has_text="Stopped (").wait_for()
            shows(page, "document.querySelector('.bar .joint').textContent === 'shoulder_pan'")
            shown = page.locator(".bar .value").first
            eventually(lambda: re.search(r"\d", shown.inner_text()), what="the joint is shown with its unit")
            eventually(
                lambda: abs(float(shown.inner_text().split("\u00b0")[0]) - pan()) < 2, what="what is shown is so"
            )
            page.fill("#turn-task", "wave")
            policy_drives(page)
            hand_leads(page, button)
            page.mouse.up()
            picture(page, "real-arm-led")
            end_turns(page)
    finally:
        if server is not None:
            server.close()
        arm.communicate(timeout=60)
        arm.kill()
    assert arm.returncode == 0
