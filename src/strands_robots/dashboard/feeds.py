"""Feeds of all networks of a page, each made once its network is joined."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from strands_robots.dashboard.feed import FleetFeed, page_name
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.fleet_verdict import NetworkVerdict
from strands_robots.fleet.network_stop import not_left
from strands_robots.fleet.networks import Networks
from strands_robots.safety.network_key import NetworkKey
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)

AGAIN_S = 2.0
"""Seconds until the feed of a joined network is made again where that failed."""

JOINING = "it is being joined"


class Feeds:
    """Feeds by the names that their networks have on the page.

    Args:
        model: takes what the robots say.
        networks: which :meth:`begin` joins; whoever made them leaves them.
        signing_key: signs emergency stops.
    """

    def __init__(self, model: FleetModel, networks: Networks, signing_key: Any = None) -> None:
        self._model, self._networks, self._signing_key = model, networks, signing_key
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._feeds: Mapping[str, FleetFeed] = {}
        self._failed: dict[str, str] = {}
        networks.on_joined(self._joined)

    def begin(self) -> None:
        """Begin to join the networks; returns at once."""
        self._networks.begin()

    def add(self, feed: FleetFeed) -> None:
        """Show the robots of a feed, which is closed with the others."""
        with self._lock:
            closed = self._closing.is_set()
            if not closed:
                # Whoever reads the old ones goes on with them.
                feeds = {**self._feeds, feed.network: feed}
                order = [page_name(each.name) for each in self._networks.stated]
                self._feeds = dict(sorted(feeds.items(), key=lambda each: (each[0] not in order, *each[:1])))
        if closed:
            feed.close()

    @property
    def joined(self) -> tuple[FleetFeed, ...]:
        """The feeds of the joined networks, that whose robots win an id first."""
        return tuple(self._feeds.values())

    def get(self, network: str) -> FleetFeed | None:
        """Return the feed of a network, or None."""
        return self._feeds.get(network)

    @property
    def absent(self) -> dict[str, Callable[[], NetworkVerdict]]:
        """Networks without a feed, each with the verdict of a stop, once called."""
        absences = {**self._networks.absent, **self._failed}
        keys = self._networks.keys | {each.name: partial(_key, each) for each in self._networks.stated}
        without = {page_name(name): (name, key) for name, key in keys.items() if page_name(name) not in self._feeds}
        return {
            page: partial(not_left, name, key, absences.get(name, JOINING)) for page, (name, key) in without.items()
        }

    @property
    def missing(self) -> dict[str, str]:
        """Reasons why networks that someone asked for have no feed."""
        absences = {**self._networks.missing, **self._failed}.items()
        return {page: why for name, why in absences if (page := page_name(name)) not in self._feeds}

    def close(self) -> None:
        """End the feeds."""
        with self._lock:
            self._closing.set()
        for each in self.joined:
            each.close()

    def _joined(self, network: NetworkAdapter) -> None:
        """Make the feed of a network, on the thread that has joined it."""
        while not self._closing.is_set():
            try:
                feed = FleetFeed(self._model, network, self._signing_key)
            except Exception as exc:  # noqa: BLE001 - the other networks are shown all the same
                self._failed[network.name] = plain_text(str(exc)) or type(exc).__name__
                logger.warning("%s cannot be shown: %s", network.name, exc)
                self._closing.wait(AGAIN_S)
            else:
                self._failed.pop(network.name, None)
                self.add(feed)
                return


def _key(network: NetworkAdapter) -> NetworkKey:
    return network.key
