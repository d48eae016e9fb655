"""Native mesh: robots that find, drive and stop one another over Zenoh.

Every name is loaded when it is first used, so the package imports with no extra installed.
"""

from __future__ import annotations

TYPE_CHECKING = False  # importing typing would be most of this import's time
if TYPE_CHECKING:
    from typing import Any

    from strands_robots.mesh.core import Mesh, get_local_robots, init_mesh, mesh_disabled_by_env

__all__ = ["Mesh", "get_local_robots", "init_mesh", "mesh_disabled_by_env"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        from strands_robots.moved import moved_name  # noqa: PLC0415 - the point of this function

        return moved_name(__name__, name)
    from strands_robots.mesh import core  # noqa: PLC0415 - the point of this function

    return getattr(core, name)
