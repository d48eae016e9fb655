"""The demo's pictures: the path that the agent saw, replayed by a twin of the arm and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from strands_robots.cli.demo.story import Joints
from strands_robots.cli.output import Failure
from strands_robots.simulation import Simulation
from strands_robots.simulation.scene import Recording
from strands_robots.utils import ValidationError

POSES_A_SECOND = 32.0
POSES_A_FRAME = 4
FRAMES_MOST = 40
SIZE = (360, 270)
"""Pixels of the animation; it stays below a megabyte."""

_TIMESTEP_S = 0.002
_SETTLED_S = 1.0


def draw(robot: str, path: Sequence[tuple[float, Joints]], folder: Path) -> tuple[list[Path], str]:
    """Write ``arm-path.png`` and ``demo.gif`` into ``folder``; the files, and how they were drawn.

    Args:
        robot: the model that the agent drove.
        path: joints by name (rad) and when they were seen (s), as the events told them.
        folder: made where it is not there.

    Raises:
        Failure: nothing to draw, or the folder cannot be written.
    """
    seen = evenly(path, POSES_A_SECOND, FRAMES_MOST * POSES_A_FRAME)
    if len(seen) < 2:
        raise Failure("The agent saw too little of the motion to draw it.")
    twin = Simulation("twin", timestep=_TIMESTEP_S, realtime=False)
    try:
        twin.add_robot(robot)
        actuators = set(twin.body().action_features)
        recording = Recording(twin, width=SIZE[0], height=SIZE[1])

        def follow(joints: Joints, seconds: float) -> None:
            twin.send_action({name: value for name, value in joints.items() if name in actuators})
            twin.step(round(seconds / _TIMESTEP_S))

        follow(seen[0], _SETTLED_S)
        for number, joints in enumerate(seen):
            follow(joints, 1 / POSES_A_SECOND)
            if number % POSES_A_FRAME:
                recording.trace()
            else:
                recording.capture()
        folder.mkdir(parents=True, exist_ok=True)
        files = [
            recording.save_picture(folder / "arm-path.png"),
            recording.save_animation(folder / "demo.gif", POSES_A_SECOND / POSES_A_FRAME),
        ]
    except (OSError, ValidationError) as exc:
        raise Failure(f"The pictures could not be written to {folder}: {exc}") from exc
    finally:
        twin.cleanup()
    empty = [str(file) for file in files if not file.is_file() or not file.stat().st_size]
    if empty:
        raise Failure(f"Nothing was written to {', '.join(empty)}.")
    return files, recording.how


def evenly(path: Sequence[tuple[float, Joints]], hz: float, most: int) -> list[Joints]:
    """One pose for each 1/``hz`` seconds in which something was seen, at most ``most``; pauses are left out."""
    chosen: list[Joints] = []
    beat = -1
    for at, joints in path:
        now = int((at - path[0][0]) * hz)
        if now != beat:
            chosen.append(joints)
            beat = now
    return chosen[:most]
