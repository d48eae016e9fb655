"""Joining of the native mesh for the length of a block."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots.errors import StrandsRobotsError

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh


class MeshUnavailableError(StrandsRobotsError, RuntimeError):
    """The native mesh is switched off, or has no session."""


@contextmanager
def joined_mesh(robot: Any, peer_id: str | None, peer_type: str) -> Iterator[Mesh]:
    """Join the native mesh for the length of the block.

    Raises:
        MeshUnavailableError: the mesh is off, or no session could be opened.
        ValueError: ``peer_id`` is refused.
    """
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - the network is loaded when it is used

    mesh = init_mesh(robot, peer_id, peer_type)
    if mesh is None:
        raise MeshUnavailableError("The native mesh is off: STRANDS_MESH switches it off.")
    try:
        if not mesh.alive:
            raise MeshUnavailableError("The native mesh has no session; the log says why.")
        yield mesh
    finally:
        mesh.close()
