"""A program that connects a Reachy Mini by itself knows afterwards whether there is a link."""

from __future__ import annotations

import asyncio
import logging

import pytest
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import free_port

from strands_robots.device_connect import ReachyMiniDriver


async def test_look_works_right_after_connect() -> None:
    with await asyncio.to_thread(Daemon, Kind("1.13.0")) as daemon:
        driver = ReachyMiniDriver("127.0.0.1", api_port=daemon.port)
        await driver.connect()
        try:
            assert driver.status.availability != "unavailable"
        finally:
            await driver.disconnect()


async def test_connect_without_a_daemon_says_so_once_and_returns(caplog: pytest.LogCaptureFixture) -> None:
    driver = ReachyMiniDriver("127.0.0.1", api_port=free_port())
    with caplog.at_level(logging.WARNING, "strands_robots.device_connect"):
        await driver.connect()
    await driver.disconnect()
    (said,) = (each for each in caplog.messages if each.startswith("No link"))
    assert said.startswith("No link to the Reachy Mini at 127.0.0.1:")
