"""E-stop links of an MCP server: its answer to the stops of others."""

from __future__ import annotations

import logging
import threading

from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stop_button import StopSender

logger = logging.getLogger(__name__)

CLOSE_S = 5.0
AGAIN_S, AGAIN_MAX_S = 1.0, 30.0
"""Seconds until a link that could not be opened is tried again: the first time, and at most."""

OPENING, DOWN = "its e-stop link is being opened", "its e-stop link is down"


class StandingController:
    """Safety controller of a server: reports whom it misses when others stop robots.

    It presses no stop itself. On each network that is joined a thread opens the link, so that the server waits for
    nothing, again and again until that succeeds, and closes it.

    Args:
        source: the server's name.
        networks: its networks.
    """

    def __init__(self, source: str, networks: Networks) -> None:
        self._source, self._networks = source, networks
        self._closing = threading.Event()
        self._senders: dict[str, StopSender] = {}
        self._failures: dict[str, str] = {}
        self._threads: list[threading.Thread] = []

    @property
    def problem(self) -> str:
        """Empty while it stands on each network, else the reasons why it does not."""
        absent, missing = self._networks.absent, self._networks.missing
        # A network that no one asked for need not be there.
        named = [each.name for each in self._networks.stated if each.name in missing or each.name not in absent]
        why = {name: self._problem_on(name) for name in named}
        return "; ".join(f"{name}: {problem}" for name, problem in why.items() if problem)

    def open(self) -> None:
        """Begin to open the links; returns at once."""
        self._networks.on_joined(self._begin)

    def close(self) -> None:
        """Close the links."""
        self._closing.set()
        for each in self._threads:
            each.join(CLOSE_S)

    def _problem_on(self, network: str) -> str:
        sender = self._senders.get(network)
        if sender is not None:
            return "" if sender.link_up else DOWN
        return self._failures.get(network) or self._networks.absent.get(network) or OPENING

    def _begin(self, network: NetworkAdapter) -> None:
        thread = threading.Thread(target=self._run, args=(network,), name=f"stand on {network.name}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _run(self, network: NetworkAdapter) -> None:
        again, name = AGAIN_S, network.name
        while not self._closing.is_set():
            try:
                with network.standing(None, tuple) as sender:
                    self._senders[name] = sender
                    if self._failures.pop(name, ""):
                        logger.warning("%s reports whom it misses on %s again.", self._source, name)
                    self._closing.wait()
            except Exception as exc:  # noqa: BLE001 - logged and said; the robots are served all the same
                problem = f"its e-stop link cannot be opened: {exc}"
                told = logger.debug if problem == self._failures.get(name) else logger.exception
                told("%s does not report whom it misses on %s; it tries again.", self._source, name)
                self._failures[name] = problem
                self._closing.wait(again)
                again = min(2 * again, AGAIN_MAX_S)
            finally:
                self._senders.pop(name, None)
