"""Does this emergency stop count? One answer for the lane, the runtime's handler and the mesh.

It counts when its source may stop and, where keys are configured, when one of them signed it. Nothing else refuses
a stop: not its age, not its shape, not its size. Whether it was seen before is asked at each robot.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from strands_robots import settings
from strands_robots.safety import ed25519
from strands_robots.safety.authorization import estop_refusal
from strands_robots.safety.orders import StopOrder, epoch_of
from strands_robots.safety.resume import is_epoch

PARSED_MAX_BYTES = 64 * 2**10
"""A message longer than this is not read; from a source that may stop, it stops all the same."""

REASON_MAX = 200


@dataclass(frozen=True, slots=True)
class Refused:
    """Why a message of ``source`` does not count; for the log and the audit."""

    source: str
    why: str


def signed_fields(estop_id: object, source: str, t: object, nonce: object) -> bytes:
    """The bytes that an emergency stop or a check-in is signed over: id, source, wall-clock seconds, nonce."""
    return ed25519.canonical({"estop_id": estop_id, "nonce": nonce, "source": source, "t": t})


def estop_keys() -> tuple[bytes, ...]:
    """The public keys of ``DEVICE_CONNECT_ESTOP_PUBLIC_KEYS``."""
    name = "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS"
    return ed25519.public_keys(settings.items(name), name)


class Decision:
    """The rules as they are configured when this is made, so that a flood meets no environment and no parsing.

    Args:
        allow: sources that may stop, as globs; ``DEVICE_CONNECT_ESTOP_ALLOW`` by default.
        keys: public keys of which one must have signed; empty: none is asked for. A configured list without one
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
        """Why this source may not stop, or None; costs next to nothing."""
        return estop_refusal(source, self._allow)

    def heard(
        self, source: str, payload: bytes, road: str = "lane", received: float | None = None
    ) -> StopOrder | Refused:
        """Decide on the bytes of an ``emergencyStop`` event of Device Connect."""
        return self.order(source, params_of(payload), road, payload, received)

    def order(
        self,
        source: str,
        params: Mapping[str, Any],
        road: str,
        raw: bytes | None = None,
        received: float | None = None,
    ) -> StopOrder | Refused:
        """Decide on the parameters of an ``emergencyStop``; ``raw`` tells it apart when they do not."""
        why = self.source_refusal(source) or self.signature_refusal(source, params)
        if why is not None:
            return Refused(source, why)
        distinct = raw if raw is not None and not params else _text(params)
        t, reason = params.get("t"), params.get("reason")
        return StopOrder(
            epoch_of(source, params, distinct),
            source,
            reason[:REASON_MAX] if isinstance(reason, str) and reason.isprintable() else "",
            road,
            heard=True,
            issued=_seconds(t),
            received=time.monotonic() if received is None else received,
        )

    def signature_refusal(self, source: str, params: Mapping[str, Any]) -> str | None:
        """Why the signature does not hold, or None; always None where no key is configured."""
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
    """The parameters of a JSON-RPC notification; empty for whatever is none."""
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
