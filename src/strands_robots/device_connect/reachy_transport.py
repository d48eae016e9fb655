"""Second documented path of :mod:`strands_robots.drivers.reachy_transport`."""

from __future__ import annotations

from strands_robots.drivers.reachy_transport import WebSocketLink, ZenohLink, api

__all__ = ["WebSocketLink", "ZenohLink", "api"]
