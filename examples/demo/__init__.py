"""An agent puts a cube on a plate, through a stop and a lockout; ``strands-robots demo`` runs it.

The wheel has this folder as ``strands_robots._demo``.
"""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType

from strands_robots.cli.output import CliError, Screen
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.safety.ed25519 import load_signing_key
from strands_robots.simulation import TABLETOP

from .output import DemoScreen, draw_motion
from .processes import TENANT, connected_agent, served_robot
from .steps import CONTROLLER, DemoReport, DriveSteps, SafetySteps, demo_operator

ROBOT, PEER = "so100", "demo-arm"


def run(screen: Screen, output: Path, record: Path | None) -> None:
    """Run every step.

    Args:
        screen: where it is printed.
        output: folder for the pictures.
        record: file of the terminal's recording as SVG, or None.

    Raises:
        CliError: a step did not happen.
    """
    demo_screen, report = DemoScreen(screen, record is not None), DemoReport()
    started = time.monotonic()
    try:
        with _interrupted_by_sigterm():
            _run(demo_screen, report, output)
            seconds = time.monotonic() - started
            demo_screen.say("")
            demo_screen.say(f"Every step happened, in {seconds:.1f} s.", "green")
            if record is not None:
                demo_screen.save(record)
    except CliError as failure:
        failure.fields.update(_facts(report))
        raise
    screen.data({"status": "success", "seconds": round(seconds, 2), **_facts(report)})
    if record is not None:
        screen.say(f"Recorded in {record}.")


def _run(screen: DemoScreen, report: DemoReport, output: Path) -> None:
    port = free_port()
    screen.head(f"Another process serves a simulated {ROBOT} at a table; this one is the agent, by a script")
    with ExitStack() as stack:
        # A safety controller of the user's own takes no part.
        key = load_signing_key(*stack.enter_context(demo_operator(CONTROLLER)))
        with report.step("serve"):
            robot = stack.enter_context(served_robot(ROBOT, TABLETOP, PEER, port, TENANT))
        screen.done(f"{PEER} is on the network at 127.0.0.1:{port}, in process {robot.process.pid}")
        controller = stack.enter_context(closing(safety_controller(CONTROLLER, loopback_config(port, TENANT))))
        with connected_agent(port) as agent:
            drive = DriveSteps(screen, agent, robot, PEER, report)
            safety = SafetySteps(screen, agent, drive, peer_id=PEER, controller=controller, key=key)
            drive.discover()
            drive.look(output)
            for step in (drive.stop, drive.pick, *safety.steps):
                step()
        screen.head("The robot leaves")
        with report.step("leave"):
            robot.leave()
        screen.done("its process stopped it, left the network and ended")
    screen.head("The motion in pictures")
    with report.step("pictures") as row:
        files, row["how"] = draw_motion(ROBOT, TABLETOP, report.setpoints, output)
        report.files = [str(output / "table.jpg"), *(str(file) for file in files)]
    how = "rendered with OpenGL" if row["how"] == "opengl" else "projected without OpenGL"
    screen.done(f"the gripper's path and an animation, replayed and {how}: {', '.join(map(str, files))}")


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """Let SIGTERM unwind like Ctrl-C, so that the robot's process ends too."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _facts(report: DemoReport) -> dict[str, object]:
    return {"steps": report.steps, "stop_ms": report.stop_ms, "files": report.files}
