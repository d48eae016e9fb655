"""Documented access to a Reachy Mini daemon, with the standard library alone.

Third parties (``httpx``, ``websockets``, ``zenoh``) are loaded by the first request or link.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from strands_robots.drivers.reachy.links import WebSocketLink, ZenohLink
from strands_robots.drivers.reachy.rest import api
from strands_robots.moved import of_module

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = ["WebSocketLink", "ZenohLink", "api"]
