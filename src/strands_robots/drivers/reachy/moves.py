"""The moves that the daemon plays: which run, and stopping them."""

from __future__ import annotations

import time

from strands_robots.drivers.reachy.connection import RUNNING_PATH, Connection, running_moves
from strands_robots.drivers.reachy.rest import DaemonFault

STOP_PATH = "/api/move/stop"


class DaemonMoves:
    """Asked over the stop's own connection; ``deadline`` is a moment of ``time.monotonic``."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def running(self, deadline: float) -> frozenset[str]:
        """The uuids that run now. Raises :class:`DaemonError`."""
        return running_moves(self._connection.stop_rest.get(RUNNING_PATH, deadline - time.monotonic()))

    def stop(self, uuid: str, deadline: float) -> None:
        """Stop one; a move that has ended meanwhile is answered with a bare 500. Raises :class:`DaemonError`."""
        try:
            self._connection.stop_rest.post(STOP_PATH, {"uuid": uuid}, deadline - time.monotonic())
        except DaemonFault:
            if uuid in self.running(deadline):
                raise

    def stop_all(self, ours: str, deadline: float) -> tuple[frozenset[str], frozenset[str]]:
        """Stop ``ours`` (may be empty) first, then every other one, and list again.

        Returns:
            The uuids that were asked to stop, and those that still run.
        """
        asked = frozenset({ours} if ours else ())
        if ours:
            self.stop(ours, deadline)
        others = self.running(deadline) - asked
        for uuid in others:
            self.stop(uuid, deadline)
        if self._connection.alive:
            self._connection.link().stop_move()
        asked |= others
        return asked, self.running(deadline) if asked else frozenset()
