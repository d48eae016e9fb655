"""Peers of the mesh: waited for, and their verbs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

LOOK_S = 0.05

CALLER, CONSOLE = "tool", "controller"
"""Types of peers of ours that call robots, or stop them, and have none."""


def has_robot(row: Mapping[str, Any]) -> bool:
    """Return whether a peer states that it has a robot."""
    return "locked" in row or "tool_name" in row or "robot_kind" in row


def only_calls(row: Mapping[str, Any]) -> bool:
    """Return whether a peer is a program that has no robot; such ones come and go."""
    return row.get("type") in (CALLER, CONSOLE) and not has_robot(row)


def must_answer(mesh: Mesh) -> list[str]:
    """Return the peers in reach that have to answer a stop."""
    return [row["peer_id"] for row in mesh.peers if row["reachable"] and not only_calls(row)]


def in_reach(mesh: Mesh) -> list[str]:
    """Return the ids of the peers in reach, without a robot or with one."""
    return [row["peer_id"] for row in mesh.peers if row["reachable"]]


def discover(
    mesh: Mesh,
    meanwhile: Callable[[], object] = lambda: None,
    *,
    since: float | None = None,
    within: float = math.inf,
) -> None:
    """Wait until the peers in reach are known, calling ``meanwhile`` repeatedly.

    A link to a stated endpoint that failed is retried with back-off, so such a peer may be silent for up to 8 s.

    Args:
        mesh: the peer that waits.
        meanwhile: called each time it has looked.
        since: when it joined, in monotonic seconds; just now by default.
        within: seconds from now that are waited at most for such links.
    """
    from strands_robots.mesh.transport.config import (  # noqa: PLC0415 - loaded when it is used
        DISCOVERY_S,
        LINK_DISCOVERY_S,
        stated_endpoints,
    )

    now, patient = time.monotonic(), math.isinf(within)
    began = now if since is None else since
    ends = min(began + LINK_DISCOVERY_S, max(began + DISCOVERY_S, now + within))
    connects, listens = stated_endpoints()
    found = began if in_reach(mesh) and not patient else math.inf
    while (now := time.monotonic()) < ends:
        if in_reach(mesh):
            found = min(found, now)
        # A listener cannot know how many will still connect to it.
        known = now >= found + DISCOVERY_S if connects or (listens and not patient) else now >= began + DISCOVERY_S
        if known and not (listens and patient):
            return
        meanwhile()
        time.sleep(LOOK_S)


def awaited(mesh: Mesh, peer: str, until: float) -> bool:
    """Wait for a peer until a monotonic time; return whether it is in reach."""
    while not is_in_reach(mesh, peer):
        if time.monotonic() >= until:
            return False
        time.sleep(LOOK_S)
    return True


def is_in_reach(mesh: Mesh, peer: str) -> bool:
    """Return whether a peer is in reach."""
    row = mesh.get_peer(peer)
    return row is not None and bool(row["reachable"])


LIST_S, LISTED_AT_ONCE = 1.0, 32
"""Seconds in which many peers have to describe their verbs, and how many are asked at once."""


def functions_of(mesh: Mesh, peer: str, seconds: float) -> list[Any] | None:
    """Return the functions that a peer describes; None if it does not."""
    result = mesh.send(peer, {"action": "describe"}, seconds).get("result")
    functions = result.get("functions") if isinstance(result, Mapping) else None
    return functions if isinstance(functions, list) else None


def functions_of_each(mesh: Mesh, peers: Collection[str]) -> dict[str, list[Any]]:
    """Return the functions of the peers that describe them in time."""
    ends, found = time.monotonic() + LIST_S, dict[str, list[Any]]()

    def described(peer: str) -> None:
        left = ends - time.monotonic()
        functions = functions_of(mesh, peer, left) if left > 0 else None
        if functions is not None:
            found[peer] = functions

    if peers:
        with ThreadPoolExecutor(min(len(peers), LISTED_AT_ONCE), "describe") as pool:
            list(pool.map(described, peers))
    return found


def functions_of_kind(row: Mapping[str, Any], usual: str = "") -> list[Any]:
    """Return the functions of a peer by its presence alone.

    Args:
        row: its presence.
        usual: the kind where it states none that is known; without one it has its own verbs alone.
    """
    from strands_robots.serving.peer_verbs import KINDS, PEER_VERBS  # noqa: PLC0415 - loaded when it is used
    from strands_robots.serving.verbs import described  # noqa: PLC0415 - as above

    kind, own = row.get("robot_kind"), row.get("own_verbs")
    actions = KINDS.get(kind if isinstance(kind, str) else "", KINDS.get(usual, ()))
    named = [{"name": name, "labels": {"own": "true"}} for name in own] if isinstance(own, list) else []
    return [*(described(PEER_VERBS[name]) for name in actions), *named]
