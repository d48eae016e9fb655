"""Importing the mesh loads next to nothing."""

from __future__ import annotations

import json
import subprocess
import sys

ADDED = {"strands_robots", "strands_robots.mesh"}
"""Besides these, only modules of Python's own."""

HEAVY = {"asyncio", "dataclasses", "inspect", "json", "logging", "re", "socket", "threading", "typing"}
"""Modules of Python's own that take milliseconds each."""


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys; before = set(sys.modules); {statement}; loaded = set(sys.modules) - before; "
    # Isolated and without site, so that what the environment preloads hides nothing.
    path = json.dumps(sys.path)
    told = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys; sys.path[:] = {path}; {code}print(*loaded)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(told.stdout.split())


def test_importing_the_mesh_loads_nothing_but_two_small_packages() -> None:
    loaded = _loaded_by("import strands_robots.mesh")
    foreign = {name for name in loaded if name.partition(".")[0] not in sys.stdlib_module_names}
    assert foreign == ADDED
    assert not loaded & HEAVY


def test_importing_the_mesh_by_name_of_a_part_loads_no_zenoh() -> None:
    loaded = {name.partition(".")[0] for name in _loaded_by("from strands_robots.mesh import init_mesh")}
    assert not loaded & {"zenoh", "numpy", "mujoco", "awscrt", "awsiot", "cryptography", "cv2", "PIL"}
