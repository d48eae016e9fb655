"""Turns of the reads that one client sends to a robot.

A robot has room for a few dozen reads of all its callers together and refuses the next one. A client that asks a
hundred at once therefore has them sent a few at a time, and leaves the rest of the room to others.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from strands_robots.errors import StrandsRobotsError

AT_ONCE = 8
"""Reads of one client that a robot has at a time; it carries out four."""

WAITING_MAX = 1024
"""Reads of one client that wait for a turn, of all robots together."""


class NoTurnError(StrandsRobotsError, RuntimeError):
    """A read got no turn in its time, or too many wait; the text says which."""


@dataclass(slots=True)
class _Robot:
    turns: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(AT_ONCE))
    reads: int = 0


class Queries:
    """Reads of one client that run or wait."""

    def __init__(self) -> None:
        self._robots: dict[str, _Robot] = {}
        self._waiting = 0

    @asynccontextmanager
    async def turn(self, robot: str, within: float) -> AsyncIterator[None]:
        """Wait for a turn at a robot, and keep it for the length of the block.

        Raises:
            NoTurnError: none within ``within`` seconds, or too many reads wait.
        """
        if self._waiting >= WAITING_MAX:
            raise NoTurnError(f"{WAITING_MAX} reads of this client wait already; try again later.")
        # A name is forgotten with its last read, so that made-up ones take no memory.
        own = self._robots.setdefault(robot, _Robot())
        own.reads += 1
        try:
            await self._turn_of(own, within)
            try:
                yield
            finally:
                own.turns.release()
        finally:
            own.reads -= 1
            if not own.reads:
                del self._robots[robot]

    async def _turn_of(self, own: _Robot, within: float) -> None:
        self._waiting += 1
        try:
            async with asyncio.timeout(within):
                await own.turns.acquire()
        except TimeoutError:
            raise NoTurnError(f"The robot did not answer this client's earlier reads within {within:g} s.") from None
        finally:
            self._waiting -= 1
