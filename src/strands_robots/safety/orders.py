"""What asks a robot to stop, and what is answered for it: plain values that the roads and the plane share."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.safety.resume import is_epoch
from strands_robots.safety.stopping import StopVerdict

LATE_S = 60.0
AHEAD_S = 5.0


def new_epoch() -> str:
    """A fresh id for an emergency stop: 32 hex digits."""
    return secrets.token_hex(16)


def derived_epoch(source: str, distinct: bytes) -> str:
    """The epoch of a stop that brings no id of its own: 32 hex of SHA-256(source NUL what tells it apart)."""
    return hashlib.sha256(source.encode("utf-8", "replace") + b"\0" + distinct).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class StopOrder:
    """One emergency stop, decided to count.

    Attributes:
        epoch: 32 hex digits; the same on every road by which this stop arrives.
        source: who stops, as declared.
        road: lane, runtime, mesh, local or check-in.
        heard: it came over a network, so the robot named as its source is left alone.
        issued: the issuer's wall-clock seconds, or None; decides only what the audit says.
        received: this process's monotonic seconds at receipt; latencies count from here.
    """

    epoch: str
    source: str
    reason: str = ""
    road: str = "local"
    heard: bool = False
    issued: float | None = None
    received: float = field(default_factory=time.monotonic)

    def timing(self, now: float) -> str:
        """``on time``, ``late``, ``ahead`` of our clock, or ``untimed``, at wall-clock time ``now``."""
        if self.issued is None:
            return "untimed"
        if now - self.issued > LATE_S:
            return "late"
        return "ahead" if self.issued - now > AHEAD_S else "on time"


@dataclass(frozen=True, slots=True)
class RobotReport:
    """What one robot answers to one emergency stop.

    ``elapsed_ms`` is from receipt to the halt's answer. ``persisted`` is None for a robot whose lockout is not
    kept. ``repeated``: this stop was known already; ``late``: the halt answered after it was reported missing.
    """

    robot_id: str
    epoch: str
    verdict: StopVerdict
    epochs: tuple[str, ...]
    elapsed_ms: float
    persisted: bool | None = None
    repeated: bool = False
    late: bool = False

    @property
    def stopped(self) -> bool | None:
        """True, False, or None where nobody knows."""
        return self.verdict.stopped

    def fields(self) -> dict[str, Any]:
        """The ``emergencyStopVerdict`` of this report, as it goes on the wire."""
        return {
            "estop_id": self.epoch,
            "device_id": self.robot_id,
            "stopped": self.stopped,
            "halted": list(self.verdict.halted),
            "not_stopped": dict(self.verdict.not_stopped),
            "unknown": dict(self.verdict.unknown),
            "elapsed_ms": round(self.elapsed_ms, 3),
            "epochs": list(self.epochs),
            "persisted": self.persisted,
            "repeated": self.repeated,
            "late": self.late,
        }


def epoch_of(source: str, params: Mapping[str, Any], raw: bytes) -> str:
    """The epoch of a Device Connect ``emergencyStop``: its ``estop_id``, else one derived from ``event_id``.

    Without either it is derived from ``raw``, the bytes that arrived: a stop is never dropped for its shape.
    """
    estop_id, event_id = params.get("estop_id"), params.get("event_id")
    if is_epoch(estop_id):
        return str(estop_id)
    if isinstance(event_id, str) and event_id:
        return derived_epoch(source, event_id.encode("utf-8", "replace"))
    return derived_epoch(source, raw)
