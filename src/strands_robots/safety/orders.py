"""Emergency stops as values: order, rules, and each robot's report.

The e-stop listener, the runtime's handler, the mesh and the command line share them with the plane.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from strands_robots import settings
from strands_robots.safety import ed25519
from strands_robots.safety.authorization import estop_refusal
from strands_robots.safety.resume import is_epoch
from strands_robots.safety.stopping import StopVerdict

LATE_S = 60.0
AHEAD_S = 5.0

PARSED_MAX_BYTES = 64 * 2**10
"""A message longer than this is not read; from a source that may stop, it stops all the same."""

REASON_MAX = 200


def new_epoch() -> str:
    """A fresh id for an emergency stop: 32 hex digits."""
    return secrets.token_hex(16)


def derived_epoch(source: str, distinct: bytes) -> str:
    """Return the epoch of a stop without an id: 32 hex of a SHA-256."""
    return hashlib.sha256(source.encode("utf-8", "replace") + b"\0" + distinct).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class StopOrder:
    """One emergency stop, decided to count.

    Attributes:
        epoch: 32 hex digits; the same on every path by which this stop arrives.
        source: who stops, as declared.
        path: lane (the e-stop listener), runtime, mesh, local or check-in.
        remote: it came over a network, so the robot named as its source is left alone.
        issued: the issuer's wall-clock seconds, or None; decides only what the audit says.
        received: this process's monotonic seconds at receipt; latencies count from here.
    """

    epoch: str
    source: str
    reason: str = ""
    path: str = "local"
    remote: bool = False
    issued: float | None = None
    received: float = field(default_factory=time.monotonic)

    def timing(self, now: float) -> str:
        """Return ``on time``, ``late``, ``ahead`` or ``untimed`` at wall-clock ``now``."""
        if self.issued is None:
            return "untimed"
        if now - self.issued > LATE_S:
            return "late"
        return "ahead" if self.issued - now > AHEAD_S else "on time"


@dataclass(frozen=True, slots=True)
class RobotReport:
    """Answer of one robot to one emergency stop.

    ``elapsed_ms`` is from receipt to the halt's answer. ``persisted`` is None for a robot whose lockout is not
    kept. ``repeated``: this stop was known already; ``late``: reported again, because the halt answered, or the
    lockout was kept, after that was reported missing.
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
        """True, False, or None where it is unknown."""
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
            **({"settling": True} if self.verdict.settling else {}),
        }


def epoch_of(source: str, params: Mapping[str, Any], raw: bytes) -> str:
    """Return the epoch of an ``emergencyStop``: ``estop_id``, else a derived one.

    Without either it is derived from ``raw``, the bytes that arrived: a stop is never dropped for its shape.
    """
    estop_id, event_id = params.get("estop_id"), params.get("event_id")
    if is_epoch(estop_id):
        return str(estop_id)
    if isinstance(event_id, str) and event_id:
        return derived_epoch(source, event_id.encode("utf-8", "replace"))
    return derived_epoch(source, raw)


@dataclass(frozen=True, slots=True)
class StopRefused:
    """Message of ``source`` that does not count, with the reason."""

    source: str
    why: str


def signed_fields(estop_id: object, source: str, t: object, nonce: object) -> bytes:
    """Return the signed bytes of a stop or check-in: id, source, time, nonce."""
    return ed25519.canonical({"estop_id": estop_id, "nonce": nonce, "source": source, "t": t})


def estop_keys() -> tuple[bytes, ...]:
    """The public keys of ``DEVICE_CONNECT_ESTOP_PUBLIC_KEYS``."""
    name = "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS"
    return ed25519.public_keys(settings.items(name), name)


class StopRules:
    """Rules by which an emergency stop counts: its source and its signature.

    Nothing else refuses a stop: not its age, not its shape, not its size. The settings are read when this is made, so
    that a flood meets no environment and no parsing. Each robot asks for itself if it has seen a stop before.

    Args:
        allow: sources that may stop, as globs; ``DEVICE_CONNECT_ESTOP_ALLOW`` by default.
        keys: public keys of which one must have signed; empty: none is required. A configured list without one
            usable key is empty too, and in the log: a mistyped key must not make a fleet unstoppable.
    """

    def __init__(
        self,
        allow: Sequence[str] | None = None,
        keys: Sequence[bytes] | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._allow = tuple(settings.items("DEVICE_CONNECT_ESTOP_ALLOW") if allow is None else allow)
        self._keys = tuple(estop_keys() if keys is None else keys)
        self._clock = clock

    @property
    def signed(self) -> bool:
        """True when a stop needs a signature; else its source is what it says it is."""
        return bool(self._keys)

    def source_refusal(self, source: str) -> str | None:
        """Return the reason why this source may not stop, or None; costs next to nothing."""
        return estop_refusal(source, self._allow)

    def order_of(self, source: str, payload: bytes, received: float | None = None) -> StopOrder | StopRefused:
        """Decide on the bytes of an ``emergencyStop`` event."""
        return self.order(source, params_of(payload), "lane", payload, received)

    def order(
        self,
        source: str,
        params: Mapping[str, Any],
        path: str,
        raw: bytes | None = None,
        received: float | None = None,
    ) -> StopOrder | StopRefused:
        """Decide on the parameters of an ``emergencyStop``; ``raw`` may identify it."""
        why = self.source_refusal(source) or self.signature_refusal(source, params)
        if why is not None:
            return StopRefused(source, why)
        distinct = raw if raw is not None and not params else _text(params)
        t, reason = params.get("t"), params.get("reason")
        return StopOrder(
            epoch_of(source, params, distinct),
            source,
            reason[:REASON_MAX] if isinstance(reason, str) and reason.isprintable() else "",
            path,
            remote=True,
            issued=_seconds(t),
            received=time.monotonic() if received is None else received,
        )

    def signature_refusal(self, source: str, params: Mapping[str, Any]) -> str | None:
        """Return the reason why the signature is not valid, or None; None without keys."""
        if not self._keys:
            return None
        estop_id, nonce, t = params.get("estop_id"), params.get("nonce"), params.get("t")
        signature = ed25519.decode(params.get("sig"), 64)
        if signature is None or not is_epoch(estop_id) or not is_epoch(nonce) or _seconds(t) is None:
            return "it is not signed, and DEVICE_CONNECT_ESTOP_PUBLIC_KEYS asks for a signature"
        if not ed25519.signed_by_one_of(self._keys, signature, signed_fields(estop_id, source, t, nonce)):
            return "none of DEVICE_CONNECT_ESTOP_PUBLIC_KEYS made its signature"
        return None


def params_of(payload: bytes) -> dict[str, Any]:
    """Return the parameters of a JSON-RPC notification; empty for anything else."""
    if len(payload) > PARSED_MAX_BYTES:
        return {}
    try:
        message = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    params = message.get("params") if isinstance(message, dict) else None
    return params if isinstance(params, dict) else {}


def _seconds(t: object) -> float | None:
    """A finite number that a float holds, else None."""
    if isinstance(t, bool) or not isinstance(t, int | float) or not abs(t) < 1e18:
        return None
    return float(t)


def _text(params: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(params, sort_keys=True, separators=(",", ":"), default=repr).encode()
    except (TypeError, ValueError, RecursionError):
        return repr(sorted(map(str, params))).encode()
