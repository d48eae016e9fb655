"""Program that draws arms as their joints are.

``python -m strands_robots.dashboard.pose_process`` reads one JSON object a line and answers each with one, ``jpeg`` in
base64 or ``error``; it ends with its input. It is a process of its own, so that neither MuJoCo nor OpenGL can hold up,
or take down, the server that sends stops.
"""

from __future__ import annotations

import base64
import json
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import IO, Any

from strands_robots.utils import ValidationError, choice, mapping, number, optional_module

MODELS = ("so100", "so101")
"""Built-in arms; the name comes from a robot, so no other is looked up."""

NICE = 10
_ARM = "arm"


class PosePainter:
    """One model in a world of its own, and what draws it."""

    def __init__(self, model: str) -> None:
        optional_module("mujoco", what="The 3-D pose", extra="sim")
        from strands_robots.kinematics.chain import built_in  # noqa: PLC0415 - MuJoCo may be missing
        from strands_robots.simulation.model import compile_scene  # noqa: PLC0415 - as above
        from strands_robots.simulation.physics import Physics  # noqa: PLC0415 - as above
        from strands_robots.simulation.rendering import Renderer  # noqa: PLC0415 - as above
        from strands_robots.simulation.scene import Scene, SceneRobot, find  # noqa: PLC0415 - as above

        self._chain = built_in(model)
        self._snapshot = Physics(compile_scene(Scene().with_robot(SceneRobot(_ARM, find(model))))).snapshot
        self._renderer = Renderer()

    def positions(self, joints: object, gripper: object) -> dict[str, float]:
        """Return the model's joint positions (rad) by name.

        ``joints`` are degrees by name, ``gripper`` is an opening from 0 to 1 or None.

        Raises:
            ValidationError: a joint is missing or no number.
        """
        degrees = mapping("joints", joints)
        found = {}
        for joint in self._chain.joints:
            if joint.name not in degrees:
                raise ValidationError(f"The robot does not report its joint {joint.name}.")
            found[joint.name] = math.radians(number(joint.name, degrees[joint.name], low=-7200, high=7200))
        jaw = self._chain.gripper
        if jaw is not None and gripper is not None:
            opening = number("gripper", gripper, low=0, high=1)
            found[jaw.joint.name] = jaw.joint.low + (jaw.joint.high - jaw.joint.low) * opening
        return found

    def close(self) -> None:
        """Free what OpenGL has; another thread may not."""
        self._renderer.close()

    def draw(self, joints: object, gripper: object, width: int, height: int) -> bytes:
        """Draw the arm as a JPEG, without OpenGL too. Raises as :meth:`positions`."""
        from strands_robots.recording.cameras import jpeg  # noqa: PLC0415 - as above
        from strands_robots.simulation import rendering  # noqa: PLC0415 - as above
        from strands_robots.simulation.rendering import OVERVIEW, RenderingError, camera_view  # noqa: PLC0415 - as above

        snapshot = self._snapshot
        places, qpos = snapshot.compiled.robots[_ARM].joints, snapshot.qpos.copy()
        for name, position in self.positions(joints, gripper).items():
            qpos[places[name].qpos] = position
        posed = replace(snapshot, qpos=qpos)
        try:
            picture = self._renderer.render(posed, OVERVIEW, width, height, quality=False)
        except RenderingError:
            data = posed.data()
            picture = rendering.draw(posed.compiled, data, camera_view(posed.compiled, data, OVERVIEW), width, height)
        return jpeg(OVERVIEW, picture)


def main(orders: IO[str], answers: IO[str]) -> None:
    """Answer orders, each with a model, joints, a gripper and a size, to their end."""
    painters: dict[str, PosePainter] = {}
    try:
        for line in orders:
            json.dump(_answer(json.loads(line), painters), answers)
            answers.write("\n")
            answers.flush()
    finally:
        for painter in painters.values():
            painter.close()


def _answer(order: Mapping[str, Any], painters: dict[str, PosePainter]) -> dict[str, str]:
    try:
        model = choice("model", order.get("model"), MODELS)
        if model not in painters:
            painters[model] = PosePainter(model)
        drawn = painters[model].draw(order.get("joints"), order.get("gripper"), order["width"], order["height"])
    except Exception as exc:  # noqa: BLE001 - OpenGL and MuJoCo may raise anything; the page shows what
        return {"error": str(exc) or type(exc).__name__}
    return {"jpeg": base64.b64encode(drawn).decode("ascii")}


if __name__ == "__main__":
    os.nice(NICE)
    main(sys.stdin, sys.stdout)
