"""Stops of a world: its halt waits for no listing of what runs in it."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.stops import WorldStop


def test_each_stop_halts_a_world_whose_listing_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "30")
    listed, halts = threading.Event(), list[str]()

    class Hung:
        """A stranger's world, which does not note its motion."""

        tool_name_str = "hung"

        def list_policies_running(self) -> list[dict[str, Any]]:
            listed.wait(120)
            return []

        def halt(self, reason: str = "") -> StopVerdict:
            halts.append(reason)
            return StopVerdict()

    world: Any = Hung()
    try:
        stops = []
        for number in range(1, 11):
            stops.append(stop_executor().submit(WorldStop(world), "world", f"stop {number}", within=60))
            eventually(lambda number=number: len(halts) == number, what="its halt")  # type: ignore[misc]
        assert not any(each.done() for each in stops)
        listed.set()
        assert all(each.result(20).stopped for each in stops)
    finally:
        listed.set()
