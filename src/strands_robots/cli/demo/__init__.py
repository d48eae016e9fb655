"""``demo``: two processes on loopback, an arm that an agent finds, drives and stops, and that a stop holds."""

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
from strands_robots.cli.output import Failure, Screen

if TYPE_CHECKING:
    from strands_robots.cli.demo.show import Show
    from strands_robots.cli.demo.story import Report

ROBOT, PEER = "so100", "demo-arm"


def register(app: typer.Typer) -> None:
    """Add ``demo`` to the application."""
    command(app, "demo")(demo)


def demo(
    screen: Screen,
    *,
    output: Annotated[Path, typer.Option("--output", help="Folder for the pictures.")] = Path("demo-output"),
    record: Annotated[Path | None, typer.Option("--record", help="Write what was shown as SVG.")] = None,
) -> None:
    """A simulated arm, found, driven and stopped by an agent in another process, then locked by an emergency stop
    until an operator's key frees it; nothing leaves this machine.

    Exits with 1 when any step did not happen.
    """
    from strands_robots.cli.demo.show import Show  # noqa: PLC0415 - what the demo draws with is loaded by it alone
    from strands_robots.cli.demo.story import Report  # noqa: PLC0415

    show, report = Show(screen, record is not None), Report()
    started = time.monotonic()
    try:
        with _ended_in_order():
            _tell(show, report, output)
            seconds = time.monotonic() - started
            show.say("")
            show.say(f"Every step happened, in {seconds:.1f} s.", "green")
            if record is not None:
                show.save(record)
    except Failure as failure:
        failure.fields.update(_facts(report))
        raise
    screen.data({"status": "success", "seconds": round(seconds, 2), **_facts(report)})
    if record is not None:
        screen.say(f"Recorded in {record}.")


def _tell(show: Show, report: Report, output: Path) -> None:
    from strands_robots.cli.demo.agent import TENANT, connected  # noqa: PLC0415 - as above
    from strands_robots.cli.demo.child import serving  # noqa: PLC0415
    from strands_robots.cli.demo.ending import CONTROLLER, Ending, operator  # noqa: PLC0415
    from strands_robots.cli.demo.story import Story  # noqa: PLC0415
    from strands_robots.device_connect.backends import loopback_config  # noqa: PLC0415
    from strands_robots.device_connect.safety_controller import safety_controller  # noqa: PLC0415

    port = free_port()
    show.head(f"Another process serves a simulated {ROBOT}; this one is the agent")
    with ExitStack() as stack:
        key = stack.enter_context(operator())
        with report.step("serve"):
            child = stack.enter_context(serving(ROBOT, PEER, port, TENANT))
        show.done(f"{PEER} is on the network at 127.0.0.1:{port}, in process {child.process.pid}")
        controller = stack.enter_context(closing(safety_controller(CONTROLLER, loopback_config(port, TENANT))))
        with connected(port) as agent:
            story = Story(show, agent, child, PEER, report)
            ending = Ending(show, agent, story, peer_id=PEER, controller=controller, key=key)
            for step in (story.discover, story.drive, story.stop, *ending.steps):
                step()
        show.head("The robot leaves")
        with report.step("leave"):
            child.leave()
        show.done("its process stopped it, left the network and ended")
    show.head("What the agent saw")
    with report.step("pictures") as row:
        from strands_robots.cli.demo.pictures import draw  # noqa: PLC0415 - MuJoCo is loaded after the live part

        files, row["how"] = draw(ROBOT, report.path, output)
        report.files = [str(file) for file in files]
    how = "rendered with OpenGL" if row["how"] == "opengl" else "projected without OpenGL"
    show.done(f"the arm's path and an animation, {how}: {', '.join(report.files)}")


def free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody has at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """SIGTERM unwinds like Ctrl-C, so that the robot's process is ended."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _facts(report: Report) -> dict[str, object]:
    return {"steps": report.steps, "stop_ms": report.stop_ms, "files": report.files}
