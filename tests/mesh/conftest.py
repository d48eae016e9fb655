"""Fixtures of the mesh's unit tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.mesh.peers import Fleet, fleet

from strands_robots.mesh import input as input_module
from strands_robots.mesh import input_receiver, safety


@pytest.fixture(autouse=True)
def patient_followers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A leader that a busy machine keeps from its beat is not silent; a test of silence sets its own windows."""
    monkeypatch.setattr(input_receiver, "HOLD_S", 600.0)
    monkeypatch.setattr(input_receiver, "LOST_S", 600.0)


@pytest.fixture
def peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> Iterator[Fleet]:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(tmp_path / "audit"))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path / "state"))
    # A peer answers when a busy machine lets it; a test with a peer that never does shortens this.
    monkeypatch.setattr(safety, "COLLECT_S", 20.0)
    monkeypatch.setattr(input_module, "_INPUT_JOIN_TIMEOUT_S", 20.0)
    with fleet(tmp_path) as joined:
        yield joined
