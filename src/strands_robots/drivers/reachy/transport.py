"""Which link a daemon speaks, decided from what it says of itself, again at every connection.

The badge ``wireless_version`` does not decide: daemons 1.0.0 to 1.4.1 speak Zenoh on every robot, 1.5.0 and newer a
WebSocket on every robot (measured on 1.4.1, 1.5.0, 1.9.0 and 1.13.0). Only where neither a version nor a type is
told is the badge believed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

from strands_robots.drivers.reachy.links import ZENOH_PORT, Link, PubSub, WebSocketLink, ZenohLink, key_prefix
from strands_robots.drivers.reachy.rest import DaemonFault
from strands_robots.utils import ValidationError, shown

LinkKind = Literal["websocket", "zenoh"]
TRANSPORTS = ("auto", "websocket", "zenoh")
DEFAULT_PREFIX = "reachy_mini"

WEBSOCKET_SINCE = (1, 5)
PREFIX_SINCE = (1, 2)
FULL_TARGET_SINCE = (1, 6)
APP_LOCK_SINCE = (1, 7)
STOP_MOVE_SINCE = (1, 10)
SLEEP_DISABLES_SINCE = (1, 10)

_VERSION = re.compile(r"(\d+)\.(\d+)(?:\.(\d+))?")


@dataclass(frozen=True, slots=True)
class DaemonInfo:
    """A daemon's status object, read. ``version`` is empty where none is told."""

    raw: dict[str, Any]
    version: tuple[int, ...] = ()

    @classmethod
    def of(cls, status: object) -> DaemonInfo:
        """Raises :class:`DaemonFault` for anything but an object."""
        if not isinstance(status, dict):
            raise DaemonFault(f"the daemon's status is no object: {shown(status)}.")
        found = _VERSION.match(str(status.get("version") or ""))
        return cls(status, tuple(int(part or 0) for part in found.groups()) if found else ())

    def since(self, version: tuple[int, ...]) -> bool:
        """The daemon is that version or newer; an untold version counts as new when it shows the new status type."""
        return self.version >= version if self.version else self.raw.get("type") == "daemon_status"

    @property
    def state(self) -> str:
        """not_initialized, starting, running, stopping, stopped, error; empty where none is told."""
        return str(self.raw.get("state") or "")

    @property
    def error(self) -> str:
        return str(self.raw.get("error") or "")

    @property
    def motor_mode(self) -> str:
        """enabled, disabled or gravity_compensation; empty while no backend runs."""
        backend = self.raw.get("backend_status")
        return str(backend.get("motor_control_mode") or "") if isinstance(backend, dict) else ""

    @property
    def link(self) -> LinkKind:
        """The link that this daemon serves."""
        if self.raw.get("type") == "daemon_status" or self.version >= WEBSOCKET_SINCE:
            return "websocket"
        if self.version:
            return "zenoh"
        return "zenoh" if self.raw.get("wireless_version") is True else "websocket"

    def prefix(self, asked: str) -> str:
        """The prefix of the robot's keys: the caller's own, else the robot's name where the daemon uses it."""
        name = self.raw.get("robot_name")
        if asked != DEFAULT_PREFIX or not isinstance(name, str) or self.version < PREFIX_SINCE:
            return asked
        try:
            return key_prefix(name)
        except ValidationError as exc:
            raise DaemonFault(f"the daemon's robot_name cannot be a key prefix: {exc}") from exc


def make_link(
    info: DaemonInfo,
    host: str,
    api_port: int,
    *,
    prefix: str,
    transport: str = "auto",
    session: PubSub | None = None,
    zenoh_port: int = ZENOH_PORT,
) -> Link:
    """The link for a daemon, not yet open; ``transport`` other than auto overrides the rule."""
    kind = info.link if transport == "auto" else transport
    if kind == "zenoh":
        return ZenohLink(host, info.prefix(prefix), session=session, zenoh_port=zenoh_port)
    return WebSocketLink(
        host, api_port, full_target=info.since(FULL_TARGET_SINCE), can_stop=info.since(STOP_MOVE_SINCE)
    )
