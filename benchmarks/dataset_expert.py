"""An arm with a cube that a scripted expert pushes, served for a recorder elsewhere.

``python -m benchmarks.dataset_expert ORDER`` is its process, for :mod:`benchmarks.dataset_training`: ``link``.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from fixtures.child import serve
from fixtures.stop_robots import link_of

from strands_robots.device_connect import init_device_connect_sync, stop_device_connect
from strands_robots.evaluation import HZ, ROBOT, SUCCESS_STEPS, ExpertPolicy, task_of
from strands_robots.hardware import HardwareRobot
from strands_robots.policies.base import PolicyError
from strands_robots.simulation.world import Simulation

TASK = "push_cube"
PEER = "arm-1"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CUBE = ("red_cube.x", "red_cube.y", "red_cube.z")


class CubeArm:
    """LeRobot's robot interface of a simulated arm that also senses where its cube is.

    Its time is the wall clock's: each read and each action computes the physics until now.
    """

    name = "cube_arm"

    def __init__(self, seed: int = 0) -> None:
        self.is_connected = False
        self._turn = threading.RLock()
        self._world: Any = Simulation("bench", realtime=False)
        self.set_up(seed)
        body = self._world.body(ROBOT)
        self.joint_ranges: Mapping[str, tuple[float, float]] = dict(body.bounds)
        self.action_features = dict.fromkeys(JOINTS, float)
        self.observation_features = dict.fromkeys((*JOINTS, *CUBE), float)

    def set_up(self, seed: int, hz: float = HZ) -> None:
        """Put the cube where the seed of an episode has it, and the arm where it begins."""
        with self._turn:
            self._world.cleanup()
            self._world = Simulation("bench", realtime=False, stop_level="hold")
            self._world.add_robot(ROBOT, "so100")
            self._task = task_of(TASK)
            self._task.set_up(self._world, np.random.default_rng(seed))
            self._expert = ExpertPolicy(self._task, self._world, hz)
            self._permit = self._world.gate.permit("bench")
            self._told: dict[str, float] = {}
            self._began, self._stepped, self._good = time.monotonic(), 0, 0
            self.over = self.success = False

    def connect(self, calibrate: bool = True) -> None:
        """Be there."""
        self.is_connected = True

    def disconnect(self) -> None:
        """Be gone."""
        self.is_connected = False

    def get_observation(self) -> dict[str, float]:
        """Return joints in radians, and the cube's place in metres."""
        with self._turn:
            self._advance()
            return {**self._world.body(ROBOT).get_joints(), **self._task.observed(self._world)}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Take targets in radians."""
        with self._turn:
            self._advance()
            return dict(self._world.body(ROBOT).send_action(action, self._permit))

    def expert_action(self) -> dict[str, float]:
        """Return what the expert does now: a target for each joint."""
        with self._turn:
            seen = self.get_observation()
            try:
                action = None if self.over else self._expert.act(seen)
            except PolicyError:
                # It met something: the episode ends here, in both recordings.
                action = None
            self._good = self._good + 1 if self._task.achieved(self._world) else 0
            self.success = self.success or self._good >= SUCCESS_STEPS
            self.over = self.over or action is None or self.success
            joints = {key: seen[key] for key in JOINTS}
            self._told = {**joints, **self._told, **dict(action or {})}
            return dict(self._told)

    def _advance(self) -> None:
        due = int((time.monotonic() - self._began) / self._world.physics.compiled.scene.timestep)
        if due > self._stepped:
            self._world.step(due - self._stepped)
            self._stepped = due


class ExpertLeader:
    """The expert as a leader of its arm."""

    keys = JOINTS

    def __init__(self, arm: CubeArm) -> None:
        self._arm = arm

    def get_action(self) -> dict[str, float]:
        """Return what it does now."""
        return self._arm.expert_action()


class ServedExpert:
    """The arm on Device Connect, led by its expert."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        self._arm = CubeArm()
        self._robot = HardwareRobot(self._arm, PEER)
        self._robot.connect()
        link = link_of(order["link"])
        self._runtime = init_device_connect_sync(self._robot, peer_id=PEER, link=link, allow_insecure=True)
        self._robot.attach_teleop(ExpertLeader(self._arm), "expert")

    def begin(self, seed: int) -> None:
        """Set an episode up, and let the expert lead."""
        self._arm.set_up(seed)
        self._robot.teleoperate("expert", hz=HZ)

    def ended(self) -> dict[str, bool]:
        """Return whether the episode is over, and a success."""
        return {"over": self._arm.over, "success": self._arm.success}

    def close(self) -> None:
        """Leave the network."""
        stop_device_connect(self._runtime)
        self._robot.cleanup()


def main() -> None:
    """Obey until standard input closes."""
    logging.disable(logging.ERROR)
    served = ServedExpert(json.loads(sys.argv[1]))
    serve({name: getattr(served, name) for name in ("begin", "ended")})
    served.close()


if __name__ == "__main__":
    main()
