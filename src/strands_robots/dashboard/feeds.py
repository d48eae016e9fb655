"""Feeds and stop buttons of a page's networks, which may come later."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any

from strands_robots.dashboard.feed import FleetFeed, page_name
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.all_stops import not_left
from strands_robots.fleet.fleet_verdict import NetworkVerdict
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stop_button import StopButtons, StopSender
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.scope import Scope
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)

REASON = "STOP on the operator's page"

AGAIN_S = 2.0
"""Seconds until the feed of a joined network is made again where that failed."""

JOINING = "it is being joined"


class Feeds:
    """Feeds and stop buttons, by the names that networks have on the page.

    Args:
        model: takes what the robots say.
        networks: which :meth:`begin` joins; whoever made them leaves them.
        signing_key: signs emergency stops; then only enrolled robots can confirm one.

    Attributes:
        networks: as given.
        buttons: of the networks on which a stop can leave.
        senders: of emergency stops, by network.
    """

    def __init__(self, model: FleetModel, networks: Networks, signing_key: Any = None) -> None:
        self._model, self.networks, self._signing_key = model, networks, signing_key
        self.buttons = StopButtons(REASON)
        self.senders: Mapping[str, StopSender] = {}
        self._feeds: Mapping[str, FleetFeed] = {}
        self._failed: dict[str, str] = {}
        self._lock, self._closing, self._stack = threading.Lock(), threading.Event(), ExitStack()
        networks.on_joined(self._joined)

    def begin(self) -> None:
        """Begin to join the networks; returns at once."""
        for each in self.networks.stated:
            if each.has_stop_link:
                # A press then leaves on it before it is joined.
                self._try(each, self._stand)
        self.networks.begin()

    def add(self, feed: FleetFeed) -> None:
        """Show the robots of a feed, which is closed with the others."""
        with self._lock:
            closed = self._closing.is_set()
            if not closed:
                # Whoever reads the old ones goes on with them.
                feeds = {**self._feeds, feed.network: feed}
                order = [page_name(each.name) for each in self.networks.stated]
                self._feeds = dict(sorted(feeds.items(), key=lambda each: (each[0] not in order, *each[:1])))
        if closed:
            feed.close()

    def add_button(self, network: str, sender: StopSender) -> None:
        """Send stops on a network, the one of its page's name, by ``sender``."""
        self.senders = {**self.senders, network: sender}
        self.buttons.add(network, sender, partial(self._expected, network))

    @property
    def joined(self) -> tuple[FleetFeed, ...]:
        """The feeds of the joined networks, that whose robots win an id first."""
        return tuple(self._feeds.values())

    def get(self, network: str) -> FleetFeed | None:
        """Return the feed of a network, or None."""
        return self._feeds.get(network)

    @property
    def unsent(self) -> dict[str, Callable[[], NetworkVerdict]]:
        """Networks without a stop button, each with the verdict of a stop, once called."""
        absences = {**self.networks.absent, **self._failed}
        keys = self.networks.keys | {each.name: partial(_key, each) for each in self.networks.stated}
        without = {page_name(name): (name, key) for name, key in keys.items() if page_name(name) not in self.senders}
        return {
            page: partial(not_left, name, key, absences.get(name, JOINING)) for page, (name, key) in without.items()
        }

    @property
    def missing(self) -> dict[str, str]:
        """Reasons why networks that someone asked for have no feed."""
        absences = {**self.networks.missing, **self._failed}.items()
        return {page: why for name, why in absences if (page := page_name(name)) not in self._feeds}

    def close(self) -> None:
        """Give up stops that wait for a link, and end the feeds."""
        self.buttons.close()
        with self._lock:
            self._closing.set()
            stack = self._stack.pop_all()
        for each in self.joined:
            each.close()
        stack.close()

    def _joined(self, network: NetworkAdapter) -> None:
        """Make the feed of a network, on the thread that has joined it."""
        while not self._closing.is_set() and not self._try(network, self._show):
            self._closing.wait(AGAIN_S)

    def _try(self, network: NetworkAdapter, work: Callable[[NetworkAdapter], None]) -> bool:
        try:
            work(network)
        except Exception as exc:  # noqa: BLE001 - the other networks are shown all the same
            self._failed[network.name] = plain_text(str(exc)) or type(exc).__name__
            logger.warning("%s cannot be shown: %s", network.name, exc)
            return False
        self._failed.pop(network.name, None)
        return True

    def _show(self, network: NetworkAdapter) -> None:
        self._stand(network)
        self.add(FleetFeed(self._model, network))

    def _stand(self, network: NetworkAdapter) -> None:
        """Give a network its stop button, where it has none."""
        name = page_name(network.name)
        with self._lock:
            if name in self.senders or self._closing.is_set():
                return
            known = partial(self._model.expected, name)
            self.add_button(name, self._stack.enter_context(network.standing(self._signing_key, known)))

    def _expected(self, network: str, scope: Scope) -> frozenset[str] | tuple[str, ...]:
        return scope.only or self._model.expected(network, scope)


def _key(network: NetworkAdapter) -> NetworkKey:
    return network.key
