"""Safety controllers that stand on the networks of a caller."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

from strands_robots.fleet.adapter import NetworkAdapter, StopSender
from strands_robots.fleet.networks import Networks

logger = logging.getLogger(__name__)

CLOSE_S = 5.0
AGAIN_S, AGAIN_MAX_S = 1.0, 30.0
"""Seconds until a link that could not be opened is tried again: the first time, and at most."""

OPENING, DOWN = "its e-stop link is being opened", "its e-stop link is down"

OnStanding = Callable[[NetworkAdapter, StopSender], None]
"""Takes a network with its controller, on the thread that has opened it."""


class StandingController:
    """Safety controller of a program, on each of its networks.

    It reports whom it misses when others stop robots.

    On each network a thread opens the link, again and again until that succeeds, and closes it.

    Args:
        source: the program's name.
        networks: its networks.
        signing_key: signs stops and check-ins, or None.
        known: returns the robots that a network's name shows besides its roster.
        on_standing: told of each controller.
        waits: return from :meth:`open`, and from the joining of a network, once its link was tried.

    Attributes:
        senders: the controllers by network.
        failures: by network, what opening its link raised.
    """

    def __init__(
        self,
        source: str,
        networks: Networks,
        signing_key: Any = None,
        known: Callable[[str], Collection[str]] = lambda network: (),
        on_standing: OnStanding = lambda network, sender: None,
        *,
        waits: bool = False,
    ) -> None:
        self._source, self._networks, self._signing_key = source, networks, signing_key
        self._known, self._on_standing, self._waits = known, on_standing, waits
        self._closing, self._lock = threading.Event(), threading.Lock()
        self._threads: dict[str, threading.Thread] = {}
        self.senders: Mapping[str, StopSender] = {}
        self.failures: Mapping[str, Exception] = {}

    @property
    def problem(self) -> str:
        """Empty while it stands on each network, else the reasons why it does not."""
        absent, missing = self._networks.absent, self._networks.missing
        # A network that no one asked for need not be there.
        named = [each.name for each in self._networks.stated if each.name in missing or each.name not in absent]
        why = {name: self._problem_on(name) for name in named}
        return "; ".join(f"{name}: {problem}" for name, problem in why.items() if problem)

    def open(self) -> None:
        """Begin to open the links.

        Where stops have a connection of their own that is now, else once a network is joined.
        """
        for each in self._networks.stated:
            if self._waits and each.has_stop_link:
                self.stand(each)
        self._networks.on_joined(self.stand)

    def close(self) -> None:
        """Close the links."""
        with self._lock:
            self._closing.set()
            threads = list(self._threads.values())
        for each in threads:
            each.join(CLOSE_S)

    def stand(self, network: NetworkAdapter) -> None:
        """Begin to open the link of one network, where that has not begun."""
        tried = threading.Event()
        with self._lock:
            if network.name in self._threads or self._closing.is_set():
                return
            thread = threading.Thread(
                target=self._run, args=(network, tried), name=f"stand on {network.name}", daemon=True
            )
            self._threads[network.name] = thread
            thread.start()
        if self._waits:
            tried.wait()

    def _problem_on(self, network: str) -> str:
        sender = self.senders.get(network)
        if sender is not None:
            return "" if sender.link_up else DOWN
        if failure := self.failures.get(network):
            return f"its e-stop link cannot be opened: {failure}"
        return self._networks.absent.get(network) or OPENING

    def _run(self, network: NetworkAdapter, tried: threading.Event) -> None:
        again, name = AGAIN_S, network.name
        while not self._closing.is_set():
            try:
                with network.standing(self._signing_key, partial(self._known, name)) as sender:
                    if name in self.failures:
                        logger.warning("%s reports whom it misses on %s again.", self._source, name)
                    self._note(name, sender, None)
                    self._on_standing(network, sender)
                    tried.set()
                    self._closing.wait()
            except Exception as exc:  # noqa: BLE001 - logged and said; the other networks have their controller
                log = logger.debug if str(exc) == str(self.failures.get(name)) else logger.exception
                log("%s does not report whom it misses on %s; it tries again.", self._source, name)
                self._note(name, None, exc)
                tried.set()
                self._closing.wait(again)
                again = min(2 * again, AGAIN_MAX_S)
        self._note(name, None, None)
        tried.set()

    def _note(self, network: str, sender: StopSender | None, failure: Exception | None) -> None:
        # Read by screens meanwhile: replaced, not changed.
        with self._lock:
            senders = {**self.senders, network: sender}
            failures = {**self.failures, network: failure}
            self.senders = {name: each for name, each in senders.items() if each is not None}
            self.failures = {name: each for name, each in failures.items() if each is not None}
