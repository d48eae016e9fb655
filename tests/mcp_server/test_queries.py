"""Turns of the reads of one client."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.envelope import Envelope, is_error, success, text_of
from strands_robots.fleet.networks import Networks
from strands_robots.mcp import caller as calls
from strands_robots.mcp import caller as module
from strands_robots.mcp.caller import AT_ONCE, Caller, NoTurnError, Queries


class Robots(ScriptedNetwork):
    """Robots that answer once they may, and count the reads that they have at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.may_answer = asyncio.Event()
        self.waiting, self.most = 0, 0

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        self.waiting += 1
        self.most = max(self.most, self.waiting)
        await self.may_answer.wait()
        self.waiting -= 1
        return success("here", robot=robot)


def client_of(robots: Robots) -> Caller:
    networks = Networks([robots])
    networks.open()
    return Caller(networks)


async def until_waiting(robots: Robots, number: int) -> None:
    async with asyncio.timeout(30):
        while robots.waiting < number:  # noqa: ASYNC110 - the robots stand for many events
            await asyncio.sleep(0)


async def test_burst_of_reads_is_answered_a_few_at_a_time() -> None:
    robots = Robots()
    client = client_of(robots)
    burst = [asyncio.ensure_future(client.query("arm-1", "getPose")) for _ in range(100)]
    await until_waiting(robots, AT_ONCE)
    robots.may_answer.set()
    assert not any(is_error(each) for each in await asyncio.gather(*burst))
    assert robots.most == AT_ONCE


async def test_robot_that_hangs_keeps_no_other_one_from_being_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calls, "ANSWER_S", 0.05)
    robots = Robots()
    client = client_of(robots)
    hung = [asyncio.ensure_future(client.query("arm-1", "getPose")) for _ in range(AT_ONCE)]
    await until_waiting(robots, AT_ONCE)
    refused = await client.query("arm-1", "getPose")
    assert is_error(refused) and "earlier reads" in text_of(refused)
    other = asyncio.ensure_future(client.query("arm-2", "getPose"))
    await until_waiting(robots, AT_ONCE + 1)
    # What a motion and a lease ask goes the direct way.
    direct = asyncio.ensure_future(client.call("arm-1", "getStatus"))
    await until_waiting(robots, AT_ONCE + 2)
    robots.may_answer.set()
    assert not any(is_error(each) for each in await asyncio.gather(*hung, other, direct))


async def test_cancelled_read_frees_its_turn_and_its_name() -> None:
    robots, queries = Robots(), Queries()

    async def read() -> None:
        async with queries.turn("arm-1", 30.0):
            await robots.call_async("arm-1", "getPose", {}, 1.0)

    reads = [asyncio.ensure_future(read()) for _ in range(AT_ONCE + 1)]
    await until_waiting(robots, AT_ONCE)
    for each in reads:
        each.cancel()
    await asyncio.gather(*reads, return_exceptions=True)
    async with queries.turn("arm-1", 0.0):
        pass
    assert queries._robots == {} and queries._waiting == 0


async def test_reads_beyond_the_bound_are_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WAITING_MAX", 0)
    with pytest.raises(NoTurnError, match="try again later"):
        async with Queries().turn("arm-1", 30.0):
            pass
