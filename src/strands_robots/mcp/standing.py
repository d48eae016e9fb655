"""E-stop link of an MCP server: its answer to the stops of others."""

from __future__ import annotations

import contextlib
import logging
import threading

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller, stand
from strands_robots.safety.controller import SafetyController

logger = logging.getLogger(__name__)

CLOSE_S = 5.0
AGAIN_S, AGAIN_MAX_S = 1.0, 30.0
"""Seconds until a link that could not be opened is tried again: the first time, and at most."""

OPENING, DOWN = "its e-stop link is being opened", "its e-stop link is down"


class StandingController:
    """Safety controller of a server: reports whom it misses when others stop robots.

    It presses no stop itself. Its thread opens the link, so that the server waits for nothing, again and again until
    that succeeds, and closes it.

    Args:
        source: the server's name.
        link: its network.
    """

    def __init__(self, source: str, link: LinkConfig) -> None:
        self._source, self._link = source, link
        self._closing = threading.Event()
        self._controller: SafetyController | None = None
        self._failure = OPENING
        self._thread = threading.Thread(target=self._run, name="standing controller", daemon=True)

    @property
    def problem(self) -> str:
        """Empty while it stands, else the reason why it does not."""
        controller = self._controller
        if controller is None:
            return self._failure
        return "" if controller.link_up else DOWN

    def open(self) -> None:
        """Begin to open the link; returns at once."""
        self._thread.start()

    def close(self) -> None:
        """Close the link."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        again = AGAIN_S
        while not self._closing.is_set():
            try:
                self._stand()
            except Exception as exc:  # noqa: BLE001 - logged and said; the robots are served all the same
                problem = f"its e-stop link cannot be opened: {exc}"
                told = logger.debug if problem == self._failure else logger.exception
                told("%s does not report whom it misses when others stop robots; it tries again.", self._source)
                self._failure = problem
                self._closing.wait(again)
                again = min(2 * again, AGAIN_MAX_S)

    def _stand(self) -> None:
        with contextlib.ExitStack() as stack:
            controller = safety_controller(self._source, self._link, stands=True)
            stack.callback(controller.close)
            stack.callback(stand(controller, self._link).close)
            self._controller = controller
            if self._failure != OPENING:
                logger.warning("%s reports whom it misses again.", self._source)
            self._closing.wait()
            self._controller = None
