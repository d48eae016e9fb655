"""``safety-controller``: a full-screen terminal whose space bar stops everything."""

from __future__ import annotations

import contextlib
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from strands_robots.cli.button import Button
from strands_robots.cli.command import command
from strands_robots.cli.console import Board
from strands_robots.cli.keyboard import keys
from strands_robots.cli.network import Network
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.cli.passphrase import PASSPHRASE_FILE, signing_key
from strands_robots.cli.quiet import kept_log
from strands_robots.utils import device_id, number

if TYPE_CHECKING:
    from strands_robots.safety.controller import SafetyController

DRAW_S = 0.1


def register(app: typer.Typer) -> None:
    """Add ``safety-controller`` to the application."""
    command(app, "safety-controller", network=True)(safety_controller)


def safety_controller(
    screen: Screen,
    network: Network,
    *,
    source: Annotated[str, typer.Option("--id", help="The source that robots see.")] = "safety-1",
    check_in: Annotated[
        float | None, typer.Option("--check-in", help="Seconds between check-ins; robots may need them to move.")
    ] = None,
    reason: Annotated[str, typer.Option("--reason", help="Told to the robots and their audit.")] = "space bar",
    key: Annotated[Path | None, typer.Option("--key", help="Sign stops and check-ins with it.")] = None,
    passphrase_file: Annotated[Path | None, PASSPHRASE_FILE] = None,
) -> None:
    """The SPACE bar stops every robot at once; shows each one, its lockout, its answers and its check-in."""
    if screen.machine or not (sys.stdin.isatty() and screen.out.is_terminal):
        raise Failure(
            "safety-controller needs a terminal, for its keys and its screen; in a script use strands-robots estop.",
            Exit.USAGE,
        )
    source = device_id("--id", source)
    every = None if check_in is None else number("--check-in", check_in, low=0.02, high=60)
    link = network.link()
    signer = None if key is None else signing_key(key, passphrase_file)
    from strands_robots.device_connect import safety_controller as network_side  # noqa: PLC0415 - loaded when it is used

    controller = network_side.safety_controller(source, link, signing_key=signer)
    with contextlib.closing(controller):
        if every is not None:
            controller.check_in_every(every)
        board = Board(controller, link, every)
        _run(screen, controller, board, reason)
    screen.say(f"{source} is off. What it stopped stays locked.")


def _run(screen: Screen, controller: SafetyController, board: Board, reason: str) -> None:
    from rich.live import Live  # noqa: PLC0415 - Rich is loaded when something is shown

    done = threading.Event()
    button = Button(controller, board.expected, reason)

    def pressed(key: str) -> None:
        if key == " ":
            button.press()
        elif key in "qQ":
            done.set()
        elif key in "fF":
            board.forget()

    with kept_log() as lines, board.looking(), keys(pressed, done.set):
        try:
            with Live(board.draw(button, lines), console=screen.out, screen=True, auto_refresh=False) as live:
                while not done.wait(DRAW_S):
                    live.update(board.draw(button, lines), refresh=True)
        finally:
            button.close()
