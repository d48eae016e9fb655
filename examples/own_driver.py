"""A robot of your own: give it LeRobot's five verbs, and agents find it, drive it and stop it.

It counts as real hardware: it moves only for callers that you allow, and only with your approval. Without a trained
policy it is moved by ``mock``, in slow waves, which you allow as well::

    export DEVICE_CONNECT_RPC_ALLOW=strands-robots STRANDS_ROBOT_COMMAND_ALLOW=execute STRANDS_ALLOW_MOCK=true
    .venv/bin/python examples/own_driver.py
    strands-robots call pan-tilt execute instruction="look around" duration=5      # in another terminal
"""

from __future__ import annotations

import logging
import sys

from strands_robots.hardware import HardwareRobot
from strands_robots.robot import run


class PanTilt:
    """Two servos, in degrees. Put your own bus where the dictionary is."""

    observation_features = action_features = {"pan.pos": float, "tilt.pos": float}  # noqa: RUF012 - as below
    joint_ranges = {"pan.pos": (-90.0, 90.0), "tilt.pos": (-30.0, 60.0)}  # noqa: RUF012 - read, never written

    def __init__(self) -> None:
        self.is_connected = False
        self._servos = {"pan.pos": 0.0, "tilt.pos": 0.0}

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, float]:
        return dict(self._servos)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self._servos |= action
        return action  # what was really sent: a servo that clips returns what it clipped to


def main() -> int:
    logging.basicConfig(format="%(message)s")
    logging.getLogger("strands_robots").setLevel(logging.INFO)
    robot = HardwareRobot(PanTilt(), tool_name="pan-tilt")
    robot.connect()
    verdict = run(robot, peer_id="pan-tilt")
    robot.cleanup()
    return 0 if verdict.stopped else 1


if __name__ == "__main__":
    sys.exit(main())
