"""The page's hand takes over from a policy, pushes, gives back, and ends with a stop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from strands_robots.cli.far_hand import LeadableHere
from strands_robots.dashboard.page_lead import PageLead
from strands_robots.simulation import Simulation


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("state", ["policy", "led"])
def test_hand_takes_over_and_a_stop_ends_it_in_each_state(state: str) -> None:
    world = Simulation(tool_name="desk")
    world.add_robot("so100")
    told: list[str] = []
    ends: list[str] = []

    async def run() -> None:
        lead = LeadableHere(world).lead("page", policy_provider="mock", instruction="wave", guide="positions")
        hand = PageLead(lead, told=lambda state, why: told.append(state), ended=ends.append)
        await until(lambda: told[-1:] == ["policy"])
        if state == "led":
            start = hand.state.joints["shoulder_pan"]
            assert hand.push("shoulder_pan", 1, 1.0) == ""
            await until(lambda: told[-1:] == ["led"])
            # The page gives no beat: the push ends after 200 ms.
            await until(lambda: hand._push is None)
            assert hand.state.joints["shoulder_pan"] - start < 1.0
            hand.give_back()
            await until(lambda: told[-1:] == ["policy"])
            assert hand.push("shoulder_pan", -1, 0.2) == ""
            await until(lambda: told[-1:] == ["led"])
        world.halt("stop")
        await until(lambda: bool(ends))
        assert not world.teleoperating()
        await hand.end()

    try:
        asyncio.run(run())
    finally:
        world.halt("test over")
        world.cleanup()
