"""Robots to try the operator's page with: ``strands-robots dashboard --demo``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from strands_robots import settings
from strands_robots.cli.output import Screen

from . import free_port
from .processes import RobotProcess, started_robot
from .steps import demo_operator

ROBOTS = {"arm-1": "tabletop", "arm-2": "tabletop", "arm-3": "", "arm-4": ""}
TENANT = "dashboard-demo"


class PageRobots:
    """Robots to try the page with, and their operator's key.

    Args:
        key: file of the operator's key.
        port: loopback port where they meet.
    """

    def __init__(self, key: Path, port: int) -> None:
        self.key, self.port = key, port
        self._started: list[RobotProcess] = []
        self._stack = ExitStack()

    def start(self) -> None:
        """Start them side by side; the page shows each as it is found."""
        for name, scene in ROBOTS.items():
            robot = started_robot("so100", scene, name, self.port, TENANT)
            self._started.append(self._stack.enter_context(robot))

    def check(self) -> None:
        """Raise :class:`CliError` when one has ended."""
        for each in self._started:
            each.check()

    def close(self) -> None:
        """End them, all at once."""
        for each in self._started:
            each.process.terminate()
        self._stack.close()


@contextmanager
def page_robots(screen: Screen) -> Iterator[PageRobots]:
    """Make the demo's key and settings; its robots end with the block."""
    with demo_operator() as (key, passphrase):
        # Its STOP is for its own robots, not for those of the user's mesh.
        settings.put("STRANDS_MESH", "false")
        port = free_port()
        screen.say("Four simulated robots start while you open the page.")
        screen.data({"event": "demo", "passphrase": passphrase, "meet": port})
        screen.say(f"To free a robot that was stopped, the page asks for this passphrase: {passphrase}", "yellow")
        with contextlib.closing(PageRobots(key, port)) as robots:
            yield robots
