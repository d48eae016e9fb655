"""``demo``: an agent puts a cube on a plate, through a stop and a lockout."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from strands_robots.cli.command import command
from strands_robots.cli.output import CliError, Screen

if TYPE_CHECKING:
    from strands_robots.cli.demo.output import DemoScreen
    from strands_robots.cli.demo.steps import DemoReport

ROBOT, PEER = "so100", "demo-arm"


def register(app: typer.Typer) -> None:
    """Add ``demo`` to the application."""
    command(app, "demo")(demo)


def demo(
    screen: Screen,
    *,
    output: Annotated[Path, typer.Option("--output", help="Folder for the pictures.")] = Path("demo-output"),
    record: Annotated[Path | None, typer.Option("--record", help="Write the terminal output as SVG.")] = None,
) -> None:
    """An agent in another process looks at a table and has a simulated arm put the red cube on the plate. A stop halts
    it; an emergency stop locks it until an operator's key frees it. Nothing leaves this machine.

    Exits with 1 when any step did not happen, or the cube is not on the plate.
    """
    from strands_robots.cli.demo.output import DemoScreen  # noqa: PLC0415 - loaded by the demo only
    from strands_robots.cli.demo.steps import DemoReport  # noqa: PLC0415 - as above

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
    from strands_robots.cli.demo.output import draw_motion  # noqa: PLC0415 - as above
    from strands_robots.cli.demo.processes import TENANT, connected_agent, served_robot  # noqa: PLC0415
    from strands_robots.cli.demo.steps import CONTROLLER, DriveSteps, SafetySteps, demo_operator  # noqa: PLC0415
    from strands_robots.device_connect.backends import loopback_config  # noqa: PLC0415
    from strands_robots.device_connect.safety_controller import safety_controller  # noqa: PLC0415
    from strands_robots.safety.ed25519 import load_signing_key  # noqa: PLC0415
    from strands_robots.simulation import TABLETOP  # noqa: PLC0415

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
