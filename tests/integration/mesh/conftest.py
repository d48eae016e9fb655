"""Peers in processes of their own, on a loopback port of the test's own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import free_port

Join = Callable[..., MeshPeer]


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def join(port: int, tmp_path: Path) -> Iterator[Join]:
    """Start a peer by id, kind of robot and further settings."""
    with ExitStack() as stack:

        def start(peer_id: str, robot: str = "world", **settings: str) -> MeshPeer:
            state = tmp_path / peer_id
            state.mkdir(mode=0o700, exist_ok=True)
            base = {"STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(state)}
            peer = MeshPeer(peer_id, robot, {**base, **settings})
            stack.callback(peer.close)
            return peer

        yield start
