"""Emergency stops of one robot or one cell on the mesh.

A stop of robots by name goes to each of them in a ``stop`` command, whose ``estop`` is the envelope that locks it; no
other peer gets it. A stop of a cell is also published for all, with its scope. A peer of a 0.5 release refuses a
command with a key that it does not know, so it gets the plain ``stop``, which does not lock it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from strands_robots.mesh.context import Context
from strands_robots.mesh.rpc import Requester
from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S
from strands_robots.safety.scope import KnownRobots, Remembers, Scope, report_widened
from strands_robots.utils import RESERVED_IDS

ESTOP = "estop"
"""Field of a ``stop`` that holds the envelope of an emergency stop."""

Replies = list[dict[str, Any]]


def cells_of(row: Mapping[str, Any] | None) -> frozenset[str]:
    """Return the cell that a peer states, as a set; empty for none."""
    cell = (row or {}).get("cell")
    return frozenset({cell} if isinstance(cell, str) and cell else ())


@dataclass(slots=True)
class ScopedStop:
    """One stop of some robots by a peer of the mesh.

    Args:
        scope: the robots that it is for.
        body: the envelope, signed where stops are.
        publish: publishes the envelope, for a cell.
        spacing_s: seconds between two of these.
    """

    context: Context
    requester: Requester
    epoch: str
    scope: Scope
    body: Mapping[str, Any]
    publish: Callable[[], None]
    spacing_s: float
    widened: bool = False

    def targets(self) -> set[str]:
        """Return the peers that have to answer now."""
        own = {self.context.peer_id}
        if self.scope.only:
            return {*self.scope.only} - own - {*RESERVED_IDS}
        rows = (row for row in self.context.registry.all() if row["reachable"])
        return {row["peer_id"] for row in rows if self.scope.covers(row["peer_id"], cells_of(row))} - own

    def command(self, peer: str) -> dict[str, Any]:
        """Return the command that stops a peer, and locks all but 0.5 releases."""
        plain = {"action": "stop"}
        return plain if peer in self.context.registry.older() else {**plain, ESTOP: dict(self.body)}

    def send(self, seconds: float, on_answers: Callable[[Replies], None], remembers: Remembers) -> Replies:
        """Send the stop until all have answered; ``widened`` where nobody in it is there."""
        now = time.monotonic()
        # Until then a peer that is linked to us may not be in the registry yet.
        known_at = now + max(0.0, DISCOVERY_S - self.context.age_s)
        publish_at, told, inside = now, {("", "")}, False
        known = KnownRobots(self.scope, remembers)

        def goes_on(replies: Replies) -> bool:
            nonlocal publish_at, told, inside
            now = time.monotonic()
            if self.scope.cell and now >= publish_at:
                publish_at = now + self.spacing_s
                self.publish()
            received = {(str(each["responder_id"]), str(each["type"])) for each in replies}
            if received != told:
                told = received
                on_answers([each for each in replies if each["type"] == "response"])
                inside = any(kind == "response" and self._means(name) for name, kind in received)
            if now >= known_at + known.widens_after_s and not inside:
                self.widened = True
                report_widened(self.epoch, self.scope)
                return False
            missing = self.targets() - {name for name, _ in received}
            return bool(missing) or (now < known_at and not self.scope.only) or not inside

        def stops() -> dict[str, dict[str, Any]]:
            return {peer: self.command(peer) for peer in sorted(self.targets())}

        return self.requester.stop_each(stops, seconds + known_at - now, goes_on)

    def _means(self, peer: str) -> bool:
        row = self.context.registry.get(peer)
        return self.scope.names(peer, next(iter(cells_of(row)), ""))
