"""Device Connect's own agent tools on the network that our robots use."""

from __future__ import annotations

import atexit
from typing import Any

from strands_robots import settings
from strands_robots.device_connect.links import usual_link


def connect_agent(**options: Any) -> None:
    """Connect the framework's ``discover`` and ``invoke`` to our robots.

    Where the environment names no network, they are those of this machine. The end of the process disconnects: the
    framework's own thread, which the interpreter would end inside Zenoh, could abort the process.

    Args:
        options: of ``device_connect_agent_tools.connect``, such as ``request_timeout``.
    """
    from device_connect_agent_tools import connect, disconnect  # noqa: PLC0415 - loaded when an agent connects

    link = usual_link()
    if link.meeting_point:
        settings.put("ZENOH_CONNECT", link.meeting_point)
        if not settings.is_set("DEVICE_CONNECT_DISCOVERY_MODE"):
            settings.put("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    atexit.unregister(disconnect)
    atexit.register(disconnect)
    connect(**options)
