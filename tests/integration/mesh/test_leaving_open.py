"""A process that ends without closing its mesh ends all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from fixtures.waiting import free_port


def test_a_process_that_leaves_its_mesh_open_ends(tmp_path: Path) -> None:
    code = "from strands_robots.mesh import init_mesh; mesh = init_mesh(None, 'leaver'); assert mesh.alive"
    own = {"STRANDS_MESH_PORT": str(free_port()), "STRANDS_STATE_DIR": str(tmp_path)}
    own["STRANDS_MESH_AUDIT_DIR"] = str(tmp_path / "audit")
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60, env={**os.environ, **own})
