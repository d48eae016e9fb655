"""The end of a move, from the only place where the daemon tells how it ended: ``/api/move/ws/updates``."""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import dataclass
from typing import Any

from strands_robots.drivers.reachy.rest import DaemonUnreachable
from strands_robots.drivers.reachy.websocket import open_socket

ENDS = {"move_completed": "completed", "move_failed": "error", "move_cancelled": "stopped"}


@dataclass(frozen=True, slots=True)
class End:
    """How a move ended: completed, error or stopped, and the daemon's words."""

    state: str
    detail: str = ""


class MoveUpdates:
    """A subscription; open it before a move is asked for, so that not even a short one is missed."""

    def __init__(self, host: str, api_port: int) -> None:
        self._stack = contextlib.ExitStack()
        self._socket: Any = open_socket(self._stack, host, api_port, "/api/move/ws/updates")

    def wait(self, uuid: str, within_s: float) -> End | None:
        """The end of that move, or None when it does not come in time. Raises :class:`DaemonUnreachable`."""
        deadline = time.monotonic() + within_s
        while (left := deadline - time.monotonic()) > 0:
            try:
                told = json.loads(self._socket.recv(left))
            except TimeoutError:
                return None
            except ValueError:
                continue
            except Exception as exc:
                raise DaemonUnreachable(f"The daemon's updates of moves broke: {exc}.") from exc
            if isinstance(told, dict) and told.get("uuid") == uuid and told.get("type") in ENDS:
                return End(ENDS[told["type"]], str(told.get("details") or ""))
        return None

    def close(self) -> None:
        self._stack.close()
