"""E-stop link of an MCP server: its answer to the stops of others."""

from __future__ import annotations

import contextlib
import logging
import threading

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller, stand

logger = logging.getLogger(__name__)

CLOSE_S = 5.0


class StandingController:
    """Safety controller of a server: reports whom it misses when others stop robots.

    It presses no stop itself. Its thread opens the link, so that the server waits for nothing, and closes it.

    Args:
        source: the server's name.
        link: its network.
    """

    def __init__(self, source: str, link: LinkConfig) -> None:
        self._source, self._link = source, link
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="standing controller", daemon=True)

    def open(self) -> None:
        """Begin to open the link; returns at once."""
        self._thread.start()

    def close(self) -> None:
        """Close the link."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            with contextlib.ExitStack() as stack:
                controller = safety_controller(self._source, self._link, stands=True)
                stack.callback(controller.close)
                stack.callback(stand(controller, self._link).close)
                self._closing.wait()
        except Exception:
            # The robots are served all the same.
            logger.exception("%s does not report whom it misses when others stop robots.", self._source)
