"""An id on a real Zenoh mesh after a join that failed."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually, free_port

from strands_robots.mesh import init_mesh
from strands_robots.mesh.core import Mesh
from strands_robots.utils import ValidationError


def test_robot_joins_by_its_id_after_a_join_with_a_certificate_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    with ExitStack() as stack:
        with monkeypatch.context() as broken:
            for name in ("CA", "CERT", "KEY"):
                broken.setenv(f"STRANDS_MESH_TLS_{name}", str(tmp_path / f"{name}.pem"))
            failed = init_mesh(Arm(), "arm-1")
            assert failed is not None
            assert not failed.alive
        stack.callback(Mesh(Arm(), "arm-1").close)
        joined, console = init_mesh(Arm(), "arm-1"), init_mesh(None, "console")
        assert joined is not None
        assert console is not None
        for mesh in (joined, console):
            stack.callback(mesh.close)
        assert joined.alive
        eventually(lambda: (console.get_peer("arm-1") or {}).get("reachable"), what="the arm")
        assert console.ping("arm-1", timeout=20)["status"] == "ok"
        for late in (lambda: init_mesh(Arm(), "arm-1"), failed.start):
            with pytest.raises(ValidationError, match=r"arm-1.*taken by another robot"):
                late()
        assert console.ping("arm-1", timeout=20)["status"] == "ok"
