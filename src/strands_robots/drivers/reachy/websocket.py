"""Opening a WebSocket to a daemon. ``websockets`` is loaded by the first one."""

from __future__ import annotations

import contextlib
from typing import Any

from strands_robots.drivers.reachy.rest import CONNECT_S, DaemonUnreachable, dialled
from strands_robots.utils import missing_extra


def open_socket(stack: contextlib.ExitStack, host: str, api_port: int, path: str) -> Any:
    """A connection that ends with ``stack``. Raises :class:`DaemonUnreachable`."""
    try:
        from websockets.exceptions import WebSocketException  # noqa: PLC0415 - optional, loaded by the first link
        from websockets.sync.client import connect  # noqa: PLC0415 - the same
    except ImportError as exc:
        raise missing_extra("Reachy Mini", "reachy") from exc
    url = f"ws://{dialled(host)}:{api_port}{path}"
    try:
        # No compression: a frame of 300 bytes costs more to inflate than to carry. No keepalive: data is the sign.
        return stack.enter_context(
            connect(url, compression=None, ping_interval=None, open_timeout=CONNECT_S, close_timeout=0.5, proxy=None)
        )
    except (OSError, WebSocketException) as exc:
        raise DaemonUnreachable(f"{url} did not open: {exc}.") from exc
