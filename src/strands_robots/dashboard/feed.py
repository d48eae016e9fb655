"""Feed: the robots of one network, as the page's server reads and drives them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from typing import Any, Protocol

from strands_robots.envelope import Envelope
from strands_robots.fleet.stop_button import StopSender

DEVICE_CONNECT, MESH = "dc", "mesh"

POLL_MIN_S = 0.4
"""Shortest time between two questions to one robot for its lockout and its holder."""

POLLS_PER_S = 30.0
"""Such questions a second, to all robots of a network together."""

ASK_S = 1.5
"""Seconds that a robot has to answer one."""

PARALLEL = 8


class FleetFeed(Protocol):
    """Robots of one network; ``call`` and ``stop`` run on the caller's event loop."""

    network: str

    @property
    def controller(self) -> StopSender:
        """The sender of its emergency stops."""

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        """Call a verb; every failure is an answer of status error."""

    async def stop(self, robot: str) -> Envelope:
        """End a robot's motion without a lockout, as after a jog; graded, never raises."""

    async def look_closer(self, robot: str) -> None:
        """Read the limits and the cameras of a robot that somebody views."""

    def resume(self, robots: list[str], signer: Any, seconds: float) -> dict[str, tuple[bool, str]]:
        """Free robots with the operator's key; blocks, and returns each outcome."""

    def close(self) -> None:
        """Leave the network."""


class LoopThread:
    """An event loop on a thread of its own, ended by :meth:`close`."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Cancel what runs there, and end the thread."""

        async def cancel() -> None:
            tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(cancel(), self.loop).result(5.0)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(5.0)
        self.loop.close()


def poll_interval(robots: int) -> float:
    """Return the seconds between two questions to one of so many robots."""
    return max(POLL_MIN_S, robots / POLLS_PER_S)
