"""Documented access to a Reachy Mini daemon, with the standard library alone.

Third parties (``httpx``, ``websockets``, ``zenoh``) are loaded by the first request or link.
"""

from __future__ import annotations

from strands_robots.drivers.reachy.links import WebSocketLink, ZenohLink
from strands_robots.drivers.reachy.rest import api

__all__ = ["WebSocketLink", "ZenohLink", "api"]
