"""A browser, robots in a process of their own, and a page's server on a port of the test's own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.mesh_peer import share_console_key
from fixtures.page_site import PageServer, browser, chromium, shows
from fixtures.served_page import ServedPage
from fixtures.stop_robots import robots
from fixtures.waiting import eventually

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.fleet.adapter import DEVICE_CONNECT

ARMS = ("arm-1", "arm-2", "arm-3")


# Not of the session: Playwright's loop counts as running on this thread, where later tests run loops of their own.
@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    pytest.importorskip("playwright.sync_api")
    assert chromium(), "Chromium is not installed; run: make system"
    with browser("--host-resolver-rules=MAP rebound.example 127.0.0.1") as started:
        yield started


class Cell:
    """Three arms, a page's server, and pages of it."""

    def __init__(self, folder: Path, chrome: Any, stack: ExitStack) -> None:
        self.stack, self.chrome, self.folder = stack, chrome, folder
        state = folder / "robots"
        state.mkdir(mode=0o700)
        own = folder / "server"
        own.mkdir(mode=0o700)
        self.machine = Machine(own)
        self.port = int(self.machine.environment["STRANDS_DC_PORT"])
        self.link: LinkConfig = loopback_config(self.port)
        # The arms count as hardware: a caller is allowed, and its verbs are approved.
        self.settings = {
            "STRANDS_STATE_DIR": str(state),
            "STRANDS_MESH_PORT": self.machine.environment["STRANDS_MESH_PORT"],
            "DEVICE_CONNECT_RPC_ALLOW": "dashboard",
            "STRANDS_ROBOT_COMMAND_ALLOW": "execute,start,moveJoints,acquireControl,wipe",
        }
        for each in (state, own):
            share_console_key(each)

    def serve_arms(self, *names: str, networks: Sequence[str] = (DEVICE_CONNECT,), **settings: str) -> Any:
        """Arms in a process of their own, ready to be stopped."""
        environment = {**self.settings, **settings}
        arms = robots(self.link, *(names or ARMS), environment=environment, networks=networks)
        self.stack.callback(arms.close)
        eventually(lambda: arms.ask("ready"), what="the robots' e-stop links")
        return arms

    def serve_page(self, *arguments: str) -> PageServer:
        """A page's server."""
        server = PageServer(self.machine, *arguments)
        self.stack.callback(server.close)
        return server

    def open(self, server: PageServer, robots: int = len(ARMS), **options: Any) -> Any:
        """A page of its own browser context that shows so many robots and could stop them."""
        context = self.chrome.new_context(**options)
        self.stack.callback(context.close)
        page = context.new_page()
        page.problems = []
        page.on("pageerror", lambda error: page.problems.append(str(error)))
        page.on("console", lambda said: page.problems.append(said.text) if said.type == "error" else None)
        page.goto(server.url)
        ready = f"document.querySelectorAll('.card').length >= {robots} && document.body.dataset.canStop === 'yes'"
        shows(page, ready, 30.0)
        return page


Make = Callable[[], Cell]


@pytest.fixture
def cell(tmp_path: Path, chrome: Any) -> Iterator[Cell]:
    with ExitStack() as stack:
        yield Cell(tmp_path, chrome, stack)


@pytest.fixture
def served() -> Iterator[ServedPage]:
    with ServedPage() as page:
        yield page


@pytest.fixture
def page(chrome: Any, served: ServedPage) -> Iterator[Any]:
    with ExitStack() as stack:
        context = chrome.new_context()
        stack.callback(context.close)
        opened = context.new_page()
        opened.goto(served.url)
        yield opened
