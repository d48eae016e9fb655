"""Motions of one MCP client, and what halts them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest
from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.client import DeviceTimeoutError, NoSuchDeviceError
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.mcp import caller as module
from strands_robots.mcp.caller import Caller

RUNNING = success("under way", task_id="moveTo-1", task_status="running")


class FakeFleet:
    """A connection that gives the answers, or raises the errors, that a test sets."""

    def __init__(self, **answers: Envelope | Exception) -> None:
        self.answers = answers
        self.stop_answers = [success("Stopped.", stopped=True)]
        self.stops = 0

    async def call_async(self, robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        """Answer a call."""
        answer = self.answers[verb]
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def stop_async(self, robot: str, within: float = 5.0, robot_name: str = "") -> Envelope:
        """Count the stop; the last answer is given again and again."""
        self.stops += 1
        return self.stop_answers.pop(0) if len(self.stop_answers) > 1 else self.stop_answers[0]


def client_of(fleet: FakeFleet) -> Caller:
    connection: Any = fleet
    return Caller(connection)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SETTLE_S", 0.01)
    monkeypatch.setattr(module, "POLL_S", 0.01)


LOST = [
    MessagingError("the connection is lost"),
    NoSuchDeviceError("No device 'arm-1'."),
    DeviceTimeoutError("arm-1 did not answer."),
]


@pytest.mark.parametrize("lost", LOST)
async def test_motion_that_is_out_of_sight_is_halted(lost: Exception) -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=lost)
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert is_error(answer) and "told to stop." in text_of(answer)
    assert fleet.stops == 1


@pytest.mark.parametrize("lost", LOST)
async def test_policy_that_is_out_of_sight_is_halted(lost: Exception) -> None:
    fleet = FakeFleet(execute=success("under way"), getStatus=lost)
    answer = await client_of(fleet).run_policy("arm-1", {}, wait=True)
    assert is_error(answer)
    assert fleet.stops == 1


async def test_stop_of_a_lost_motion_is_repeated_until_it_is_confirmed() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=MessagingError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None), success("Stopped.", stopped=True)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert fleet.stops == 2
    assert "not confirmed" not in text_of(answer)


async def test_stop_that_is_not_confirmed_is_told() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=MessagingError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert fleet.stops == module.STOPS_MAX
    assert "not confirmed: no link" in text_of(answer)


async def test_motion_that_ended_by_itself_is_not_stopped() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=success("there", task_status="completed"))
    assert not is_error(await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True))
    await asyncio.sleep(0)
    assert fleet.stops == 0
