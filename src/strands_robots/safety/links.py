"""What a network gives the safety plane: a connection of its own that carries stops and nothing else."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol, runtime_checkable

ESTOP = "emergencyStop"
VERDICT = "emergencyStopVerdict"
CHECK_IN = "safetyCheckIn"

Hear = Callable[[str, str, bytes], None]
"""Called with event, source and bytes on a thread of the link; it must return at once and may not raise."""

OnState = Callable[[bool], None]
"""Called with whether the link is up, on a thread of the link, at each change."""


class StopLink(Protocol):
    """One connection of the lane's own. No method blocks on the network, and none raises for its state."""

    @property
    def up(self) -> bool:
        """True while somebody can be reached."""

    def open(self, events: Collection[str], hear: Hear, on_state: OnState) -> None:
        """Hear these events of every device of the tenant. Returns at once; the link comes up when it can."""

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        """Send as ``source`` now; False when the link is down, and then nothing is kept for later."""

    def close(self) -> None:
        """Close the connection and end the link's thread. Safe to call twice."""


@runtime_checkable
class RenewableLink(Protocol):
    """A link that can be made anew while it is used."""

    def renew(self) -> None:
        """Open another connection in place of the one there is, which carries stops until then; returns at once."""


def notification(event: str, params: Mapping[str, Any], event_id: str = "") -> bytes:
    """An event as Device Connect writes it: a JSON-RPC 2.0 notification with ``event_id`` and ``ts``."""
    stamp = {"event_id": event_id or uuid.uuid4().hex, "ts": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    return json.dumps({"jsonrpc": "2.0", "method": event, "params": {**params, **stamp}}).encode()
