"""Simulated robots in MuJoCo: arms, a rover, and any MJCF or URDF model.

Importing this package alone loads neither numpy nor MuJoCo; :class:`Simulation` is loaded when it is first used, and
without the ``sim`` extra that raises one sentence. The scenes are the objects that a simulated robot has in front of it
from the start.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import is_error
from strands_robots.utils import ValidationError, choice, missing_extra

if TYPE_CHECKING:
    from strands_robots.simulation.world import Simulation

__all__ = ["CUBE", "PLATE", "SCENES", "TABLETOP", "Simulation", "furnish"]

_EXTRA = ("mujoco", "numpy", "PIL")


def __getattr__(name: str) -> Any:
    if name != "Simulation":
        return import_module("strands_robots.moved").moved_name(__name__, name)
    try:
        # Before another module imports MuJoCo, which would load its default backend as well as the chosen one.
        import_module("strands_robots.simulation.engine")
        from strands_robots.simulation.world import Simulation  # noqa: PLC0415 - heavy, so only when asked for
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] in _EXTRA:
            raise missing_extra("Simulation", "sim") from exc
        raise
    return Simulation


TABLETOP = "tabletop"

CUBE, PLATE = "red_cube", "plate"

SCENES: dict[str, tuple[dict[str, Any], ...]] = {
    TABLETOP: (
        # Its top is a millimetre above the floor, on which the arm stands too.
        {
            "name": "table",
            "size": (0.18, 0.22, 0.001),
            "position": (0.22, 0.0, 0.0),
            "color": (0.66, 0.50, 0.34),
            "fixed": True,
        },
        {
            "name": PLATE,
            "shape": "cylinder",
            "size": (0.05, 0.004),
            "position": (0.20, -0.14, 0.005),
            "color": (0.93, 0.94, 0.96),
            "mass": 0.3,
        },
        {
            "name": CUBE,
            "size": 0.0125,
            "position": (0.24, 0.09, 0.0135),
            "color": (0.85, 0.12, 0.10),
            "mass": 0.03,
            "yaw": 0.4,
        },
    ),
}
"""Objects by scene, as arguments of :meth:`Simulation.add_object`, before a robot that stands at the origin."""


def furnish(world: Simulation, scene: object) -> None:
    """Put the objects of a scene into a world.

    Raises:
        ValidationError: no such scene, or an object of its name is there already.
    """
    for item in SCENES[choice("scene", scene, tuple(SCENES))]:
        answer = world.add_object(**item)
        if is_error(answer):
            raise ValidationError(str(answer["reason"]))
