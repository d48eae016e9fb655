"""A peer that cannot receive emergency stops says so and does not move."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from strands_robots.envelope import Envelope, error
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context

logger = logging.getLogger(__name__)


class Hearing:
    """Latch on motion while the network refuses us the topic of emergency stops.

    Args:
        halt: stops what moves, with the reason; called when the topic is refused.
    """

    def __init__(self, context: Context, halt: Callable[[str], None]) -> None:
        self._context = context
        self._halt = halt
        self._problem = ""

    def refusal(self, verb: str) -> Envelope | None:
        """Return the refusal of ``verb`` while no emergency stop can arrive, or None."""
        if not self._problem:
            return None
        peer = self._context.peer_id
        return error(f"{verb} is refused: {peer} cannot receive emergency stops: {self._problem}.", robot=peer)

    def facts(self) -> dict[str, Any]:
        """Return ``estop_unheard`` with the reason while there is one."""
        return {"estop_unheard": self._problem} if self._problem else {}

    def look(self) -> None:
        """Compare with the transport; try a refused subscription again."""
        transport = self._context.transport
        if transport is None:
            return
        problem = transport.refusals().get(topics.estop(), "")
        known, self._problem = self._problem, problem
        peer = self._context.peer_id
        if problem and not known:
            logger.critical("%s CANNOT RECEIVE EMERGENCY STOPS and does not move: %s.", peer, problem)
            self._context.audit.always("estop_unheard", reason=problem)
            self._halt("it cannot receive emergency stops")
        elif known and not problem:
            logger.warning("%s receives emergency stops again.", peer)
            self._context.audit.always("estop_heard")
        transport.subscribe_again()
