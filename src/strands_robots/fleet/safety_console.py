"""Safety controller of an operator, on every network at once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stop_button import StopButtons, StopSender
from strands_robots.fleet.watched_robots import WatchedRobots
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)


class SafetyConsole:
    """Stop buttons and watched robots of every network of a caller.

    A network that is joined later gets its button then; a stop that it has missed leaves on it, as
    :class:`~strands_robots.fleet.stop_button.StopButtons` says. A press waits for no network.

    Args:
        networks: those of the console, which opens and closes them.
        signing_key: signs stops and check-ins, or None.
        reason: sent to the robots.
        check_in_s: seconds between check-ins, or None.

    Attributes:
        buttons: those of all networks.
        watched: robots by network.
        problems: by network, why it has no button.
    """

    def __init__(
        self, networks: Networks, signing_key: Any = None, reason: str = "", check_in_s: float | None = None
    ) -> None:
        self.buttons = StopButtons(reason)
        self.watched: Mapping[str, WatchedRobots] = {}
        self.problems: Mapping[str, str] = {}
        self._networks, self._key, self._check_in_s = networks, signing_key, check_in_s
        self._senders: Mapping[str, StopSender] = {}
        self._were_up: frozenset[str] = frozenset()
        self._stack, self._lock = ExitStack(), threading.Lock()

    def open(self) -> None:
        """Begin to join the networks; return at once."""
        for each in self._networks.stated:
            if each.has_stop_link:
                self._stand_on(each)
        self._networks.on_joined(self._joined)
        self._networks.begin()

    def close(self) -> None:
        """Give up stops that wait for a link, and leave the networks."""
        self.buttons.close()
        for each in self.watched.values():
            each.close()
        with self._lock:
            self._stack.close()
        self._networks.close()

    def press(self, scope: Scope = EVERY_ROBOT) -> None:
        """Stop the robots of a scope on the networks that have them; returns at once."""
        having = () if scope.everything else [name for name, each in self.watched.items() if each.has(scope)]
        self.buttons.press(scope, having)

    def forget(self) -> None:
        """Expect no answer any more from robots that are gone."""
        for each in self.watched.values():
            each.forget()

    @property
    def links(self) -> Mapping[str, bool]:
        """By network, whether a stop would leave at once.

        A network that can be joined and never had a link is left out beside others: nobody is there.
        """
        up = {name: each.link_up for name, each in self._senders.items()}
        # What was asked for and is not there yet has no sender.
        up |= {name: False for name in self.absent if name not in up}
        self._were_up |= {name for name, is_up in up.items() if is_up}
        known = self._were_up | self.absent.keys() | {name for name, each in self.watched.items() if each.reports}
        return {name: is_up for name, is_up in up.items() if name in known} or up

    @property
    def absent(self) -> Mapping[str, str]:
        """Networks that someone asked for and that are not joined, with reasons."""
        return {**self._networks.missing, **self.problems}

    def _joined(self, network: NetworkAdapter) -> None:
        if network.name not in self._senders:
            self._stand_on(network)
        if network.name in self.watched:
            self.watched[network.name].poll(network)

    def _stand_on(self, network: NetworkAdapter) -> None:
        """Give a network its button; one that fails takes none from the others."""
        try:
            self._stand(network)
        except Exception as exc:
            logger.exception("%s has no stop button.", network.name)
            self.problems = {**self.problems, network.name: plain_text(f"{type(exc).__name__}: {exc}")}

    def _stand(self, network: NetworkAdapter) -> None:
        watched = WatchedRobots()
        with self._lock:
            controller = self._stack.enter_context(network.standing(self._key, watched.known))
            # Read by the screen meanwhile: replaced, not changed.
            self.watched = {**self.watched, network.name: watched}
            self._senders = {**self._senders, network.name: controller}
        self.buttons.add(network.name, controller, watched.expected)
        if self._check_in_s is not None:
            controller.check_in_every(self._check_in_s)
