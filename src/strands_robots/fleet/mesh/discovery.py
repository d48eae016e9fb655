"""Peers of the mesh in reach, and the wait until they are known."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

LOOK_S = 0.05


def in_reach(mesh: Mesh) -> list[str]:
    """Return the ids of the peers in reach, without a robot or with one."""
    return [row["peer_id"] for row in mesh.peers if row["reachable"]]


def discover(mesh: Mesh, meanwhile: Callable[[], object] = lambda: None, *, since: float | None = None) -> None:
    """Wait until the peers in reach are known, calling ``meanwhile`` repeatedly.

    A link to a stated endpoint that failed is retried with back-off, so such a peer may be silent for up to 8 s.

    Args:
        mesh: the peer that waits.
        meanwhile: called each time it has looked.
        since: when it joined, in monotonic seconds; just now by default.
    """
    from strands_robots.mesh.transport.zenoh_config import (  # noqa: PLC0415 - loaded when it is used
        DISCOVERY_S,
        LINK_DISCOVERY_S,
        stated_endpoints,
    )

    began, found = time.monotonic() if since is None else since, math.inf
    connects, listens = stated_endpoints()
    while (now := time.monotonic()) < began + LINK_DISCOVERY_S:
        if in_reach(mesh):
            found = min(found, now)
        known = now >= found + DISCOVERY_S if connects else now >= began + DISCOVERY_S
        if known and not listens:
            return
        meanwhile()
        time.sleep(LOOK_S)
