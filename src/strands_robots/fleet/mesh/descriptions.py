"""Verbs of mesh peers: as they describe them, else those of their kind."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

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
