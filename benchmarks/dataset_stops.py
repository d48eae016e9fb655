"""An arm that is served and recorded while it is stopped again and again, for :mod:`benchmarks.dataset`.

``python -m benchmarks.dataset_stops ORDER`` is its process: ``link`` and ``folder``.
"""

from __future__ import annotations

import json
import logging
import random
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fixtures.child import Child, serve
from fixtures.replayed_cameras import ReplayedCamera
from fixtures.stop_controller import controller
from fixtures.stop_robots import link_of
from fixtures.waiting import eventually, free_port

from benchmarks.dataset_children import FPS, TASK, RecordedArm, stored_pictures
from benchmarks.dataset_writers import CAMERAS, device
from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.datasets.session import RecordingSession
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.hardware import HardwareRobot

PEER = "arm-1"
BEAT_S = 0.02
SETTLED_S = 0.06
"""After a stop: a write that came as late as this is still its last one."""


@dataclass
class LastingTask:
    """Task that outlasts each stop, so that one attempt has them all."""

    running: bool = True
    voided: bool = False
    error: str = ""


class ServedArm:
    """The arm, and the recording of it."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        robot = HardwareRobot(device(), PEER)
        robot.device.cameras = {name: ReplayedCamera() for name in CAMERAS}
        robot.connect()
        self._arm, self._robot = RecordedArm(robot, Path(order["folder"]) / "set"), robot
        self._runtime = init_device_connect_sync(robot, peer_id=PEER, link=link_of(order["link"]), allow_insecure=True)
        self._task, self._thread = LastingTask(), threading.Thread(target=self._record)

    def record(self) -> None:
        """Begin to record."""
        self._thread.start()

    def _record(self) -> None:
        with RecordingSession(self._arm.folder, FPS, TASK, "arm", lambda said: None) as session:

            def begin() -> LastingTask:
                return self._task

            attempts = Attempts(1, begin, FPS, None, 0.0, success=False)
            local = self._arm.attempts(self._robot.camera_frames, begin)
            record_attempts(self._arm.screen, local, session, attempts)

    def ready(self) -> bool:
        """Return True when its e-stop link is up."""
        from strands_robots.safety.estop_listener import estop_listener  # noqa: PLC0415 - of this process

        return all(each.link.up for each in estop_listener().registrations)

    def move(self) -> None:
        """Free it, and lead it until it moves."""
        from strands_robots.safety.plane import plane  # noqa: PLC0415 - of this process

        plane().clear_local("bench")
        eventually(lambda: not self._robot.teleoperating())
        before = len(self._robot.device.writes)
        self._arm.lead()
        eventually(lambda: len(self._robot.device.writes) > before + 5)

    def last_write(self) -> float:
        """Return when its last write was over, in monotonic seconds."""
        return float(self._robot.device.writes[-1].at)

    def end(self) -> dict[str, int]:
        """End the recording, and leave the network; return what is stored."""
        self._robot.halt("bench")
        self._task.running = False
        if self._thread.ident is not None:
            self._thread.join()
        stop_device_connect(self._runtime)
        self._robot.cleanup()
        return stored_pictures(self._arm.folder) if self._thread.ident is not None else {}


def stops_ms(count: int, *, recorded: bool) -> tuple[list[float], dict[str, int]]:
    """Stop the arm in motion so often; return from each press to the last write, and what was stored meanwhile."""
    moments, took = random.Random(7), list[float]()
    link = loopback_config(free_port())
    with tempfile.TemporaryDirectory(prefix="bench-stops-") as folder, ExitStack() as stack:
        Path(folder).chmod(0o700)
        environment = {"STRANDS_STATE_DIR": folder}
        order = {"link": asdict(link), "folder": folder}
        arm = stack.enter_context(Child("benchmarks.dataset_stops", order, environment, forked=False))
        hand = stack.enter_context(controller(link, environment=environment))
        eventually(lambda: hand.ask("up") and arm.ask("ready"), 20, "every link")
        if recorded:
            arm.ask("record")
        for _ in range(count):
            arm.ask("move")
            time.sleep(moments.uniform(0, BEAT_S))
            report = hand.ask("stop", [PEER])
            assert report["ok"], report
            time.sleep(SETTLED_S)
            took.append(max(0.0, 1000 * (arm.ask("last_write") - report["at"])))
        return took, arm.ask("end")


def main() -> None:
    """Obey until standard input closes."""
    logging.disable(logging.ERROR)
    arm = ServedArm(json.loads(sys.argv[1]))
    serve({name: getattr(arm, name) for name in ("record", "ready", "move", "last_write", "end")})


if __name__ == "__main__":
    main()
