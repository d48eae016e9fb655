"""Requests to peers of the mesh from an event loop, on threads of their own."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

from strands_robots.envelope import Envelope, error
from strands_robots.errors import NoAnswerError, RefusalError
from strands_robots.fleet.adapter import CLOSED
from strands_robots.fleet.cached_keys import CachedKeys
from strands_robots.fleet.lockout_report import LockoutReport
from strands_robots.fleet.mesh.lockouts import ask_peer
from strands_robots.fleet.mesh.stops import stop_peer
from strands_robots.safety.statements import enrolled_peers
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

IN_FLIGHT = 64
"""Requests of one kind that wait for an answer at a time; threads are started as they are needed."""

STOPS_IN_FLIGHT = 1024
"""The same of stops: as many as a page has robots, so that the last one begins as soon as the first."""

T = TypeVar("T")


class PeerRequests:
    """Calls, stops and questions of one peer; none waits for one of another kind."""

    def __init__(self) -> None:
        self._calls = ThreadPoolExecutor(IN_FLIGHT, "mesh call")
        self._stops = ThreadPoolExecutor(STOPS_IN_FLIGHT, "mesh stop")
        self._questions = ThreadPoolExecutor(IN_FLIGHT, "mesh question")
        self._keys = CachedKeys(enrolled_peers)

    async def call(self, work: Callable[[], Envelope]) -> Envelope:
        """Return what ``work`` answers.

        Raises:
            RefusalError: as ``work``; no answer for whatever else it raises.
        """

        def refused() -> Envelope | RefusalError:
            try:
                return work()
            except RefusalError as refusal:
                return refusal

        answer = await _done(self._calls, refused, NoAnswerError)
        if isinstance(answer, RefusalError):
            raise answer
        return answer

    async def stop(self, mesh: Mesh, robot: str, seconds: float, robot_name: str = "") -> Envelope:
        """Stop a peer; *stopped* counts only where an enrolled robot has signed it."""
        return await _done(
            self._stops,
            lambda: stop_peer(mesh, robot, seconds, robot_name),
            lambda why: error(why, stopped=None),
        )

    async def lockout(self, mesh: Mesh, robot: str, seconds: float) -> LockoutReport:
        """Ask a peer for its status."""
        return await _done(
            self._questions,
            lambda: ask_peer(mesh, robot, seconds, self._keys.read()),
            lambda why: LockoutReport(robot, problem=why),
        )

    def close(self) -> None:
        """Begin no more requests."""
        for pool in (self._calls, self._stops, self._questions):
            pool.shutdown(wait=False, cancel_futures=True)


async def _done(pool: ThreadPoolExecutor, work: Callable[[], T], failed: Callable[[str], T]) -> T:
    """Return what ``work`` returns on a thread of the pool.

    Where it does not, return what ``failed`` makes of the reason.
    """
    try:
        begun = pool.submit(work)
    except RuntimeError:
        return failed(CLOSED)
    try:
        return await asyncio.wrap_future(begun)
    except asyncio.CancelledError:
        # Of the pool that is closed, not of the task that waits.
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        return failed(CLOSED)
    except Exception as exc:  # noqa: BLE001 - a request that fails is answered, whatever it raised
        return failed(plain_text(str(exc)) or type(exc).__name__)
