"""Second documented path of :mod:`strands_robots.drivers.reachy_transport`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from strands_robots.drivers.reachy_transport import WebSocketLink, ZenohLink, api
from strands_robots.moved import of_module

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = ["WebSocketLink", "ZenohLink", "api"]
