"""Simulated robots in MuJoCo: arms, a rover, and any MJCF or URDF model.

Importing this package alone loads neither numpy nor MuJoCo; :class:`Simulation` is loaded when it is first used, and
without the ``sim`` extra that raises one sentence.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from strands_robots.utils import missing_extra

if TYPE_CHECKING:
    from strands_robots.simulation.world import Simulation

__all__ = ["Simulation"]

_EXTRA = ("mujoco", "numpy", "PIL")


def __getattr__(name: str) -> Any:
    if name != "Simulation":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        # Before another module imports MuJoCo, which would load its default backend as well as the chosen one.
        import_module("strands_robots.simulation.engine")
        from strands_robots.simulation.world import Simulation  # noqa: PLC0415 - heavy, so only when asked for
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] in _EXTRA:
            raise missing_extra("Simulation", "sim") from exc
        raise
    return Simulation
