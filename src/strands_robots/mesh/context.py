"""Shared state of a peer's parts: name, transport, replaceable functions."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.mesh import wire
from strands_robots.mesh.console_keys import ConsoleSigner, ConsoleTrust
from strands_robots.mesh.older_peers import Pacer
from strands_robots.mesh.registry import PeerRegistry
from strands_robots.mesh.throttle import AuditThrottle
from strands_robots.mesh.transport import Transport, TransportError
from strands_robots.mesh.wire_identity import Identity

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class Context:
    """Shared by the parts of one peer.

    Attributes:
        clock: wall-clock seconds, as stated on the wire.
        monotonic: seconds, for ages.
        audit: records refusals; ``audit.always`` records what may never be left out.
        transport: None while the peer is not on the mesh.
        console: signs what moves real hardware; ``consoles`` checks such signatures.
        has_robot: it moves; a peer without a robot remembers those that it hears.
        pacer: keeps messages apart while a peer of a 0.5 release is known.
    """

    peer_id: str
    registry: PeerRegistry
    audit: AuditThrottle
    identity: Identity
    clock: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    transport: Transport | None = field(default=None)
    console: ConsoleSigner = field(default_factory=ConsoleSigner)
    consoles: ConsoleTrust = field(default_factory=ConsoleTrust)
    pacer: Pacer = field(default_factory=Pacer)
    has_robot: bool = False
    began: float = field(init=False)
    _began_at: float = field(init=False)

    def __post_init__(self) -> None:
        self.began, self._began_at = self.clock(), self.monotonic()

    def predates(self, stamp: float) -> bool:
        """True for a message that may have counted before this peer began.

        Args:
            stamp: wall-clock seconds of its sender. Once what was issued before is no longer fresh, all is false.
        """
        return stamp < self.began and self.monotonic() - self._began_at <= wire.FRESH_S + wire.AHEAD_S

    @property
    def age_s(self) -> float:
        """Seconds since this peer began."""
        return self.monotonic() - self._began_at

    def running(self) -> bool:
        return self.transport is not None and self.transport.is_alive()

    def put(self, key: str, payload: Mapping[str, Any]) -> None:
        """Publish; raise TransportError off the mesh, WireError above the size."""
        transport = self.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        transport.put(key, payload)

    def session_id(self) -> str | None:
        return self.transport.session_id if self.transport is not None else None
