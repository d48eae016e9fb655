"""Presence of a robot on a network, also on one that was left meanwhile."""

from __future__ import annotations

import logging
import time

from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import NetworkAdapter

logger = logging.getLogger(__name__)

MISSED_BEATS = 3
"""Beats after which a robot that has left one network counts as gone from another one, too."""


def bears(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a network has a robot now; False for a network that was left."""
    try:
        return network.bears(robot)
    except RefusalError:
        return False


def reaches(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a robot is in reach, which may be asked."""
    try:
        return network.reaches(robot)
    except RefusalError as exc:
        logger.debug("%s: %s cannot be looked for: %s", network.name, robot, exc)
        return False


def silent(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a robot has missed its last beats on a network."""
    try:
        last = network.beats([robot]).get(robot)
        return last is not None and time.monotonic() - last > MISSED_BEATS * network.beats_every(robot)
    except RefusalError:
        return True
