"""Feeds and stop buttons of a page's networks, which may come later."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from strands_robots.dashboard.feed import FleetFeed, page_name
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.fleet.adapter import NetworkAdapter, StopSender
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import StopButtons
from strands_robots.fleet.standing import StandingController
from strands_robots.fleet.stops import not_left
from strands_robots.fleet.verdicts import NetworkVerdict
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
        self._model, self.networks = model, networks
        self.buttons = StopButtons(REASON)
        self.senders: Mapping[str, StopSender] = {}
        self._feeds: Mapping[str, FleetFeed] = {}
        self._failed: dict[str, str] = {}
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._standing = StandingController(
            "dashboard",
            networks,
            signing_key,
            lambda network: model.expected(page_name(network)),
            lambda network, sender: self.add_button(page_name(network.name), sender),
            waits=True,
        )
        networks.on_joined(self._joined)

    def begin(self) -> None:
        """Begin to join the networks; returns at once."""
        # A press leaves where stops have a connection of their own before that network is joined.
        self._standing.open()
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
        absences = {**self.networks.absent, **self._failures}
        keys = self.networks.keys | {each.name: partial(_key, each) for each in self.networks.stated}
        without = {page_name(name): (name, key) for name, key in keys.items() if page_name(name) not in self.senders}
        return {
            page: partial(not_left, name, key, absences.get(name, JOINING)) for page, (name, key) in without.items()
        }

    @property
    def missing(self) -> dict[str, str]:
        """Reasons why networks that someone asked for have no feed."""
        absences = {**self.networks.missing, **self._failures}.items()
        return {page: why for name, why in absences if (page := page_name(name)) not in self._feeds}

    @property
    def _failures(self) -> dict[str, str]:
        return {**{name: _why(exc) for name, exc in self._standing.failures.items()}, **self._failed}

    def close(self) -> None:
        """Give up stops that wait for a link, and end the feeds."""
        self.buttons.close()
        with self._lock:
            self._closing.set()
        for each in self.joined:
            each.close()
        self._standing.close()

    def _joined(self, network: NetworkAdapter) -> None:
        """Make the feed of a network, on the thread that has joined it."""
        self._standing.stand(network)
        while not self._closing.is_set() and not self._show(network):
            self._closing.wait(AGAIN_S)

    def _show(self, network: NetworkAdapter) -> bool:
        """Add the feed of a network; return whether that could be made."""
        try:
            self.add(FleetFeed(self._model, network))
        except Exception as exc:  # noqa: BLE001 - the other networks are shown all the same
            self._failed[network.name] = _why(exc)
            logger.warning("%s cannot be shown: %s", network.name, exc)
            return False
        self._failed.pop(network.name, None)
        return True

    def _expected(self, network: str, scope: Scope) -> frozenset[str] | tuple[str, ...]:
        return scope.only or self._model.expected(network, scope)


def _why(exc: Exception) -> str:
    return plain_text(str(exc)) or type(exc).__name__


def _key(network: NetworkAdapter) -> NetworkKey:
    return network.key
