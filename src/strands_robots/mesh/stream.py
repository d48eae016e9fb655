"""One policy step on the wire: what the policy saw and what it did."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

ARRAY_MAX = 100


def step_message(
    peer_id: str,
    now: float,
    step: int,
    *,
    observation: Mapping[str, Any],
    action: Mapping[str, Any],
    instruction: str,
    policy: str,
) -> dict[str, Any]:
    """The message of one step; of the observation only numbers and 1-D arrays under 100 entries."""
    return {
        "peer_id": peer_id,
        "step": step,
        "t": now,
        "instruction": instruction,
        "policy": policy,
        "observation": numbers(observation),
        "action": numbers(action),
    }


def numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """The numeric entries, as JSON has them; everything else is left out."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        plain = _plain(value)
        if plain is not None:
            found[str(key)] = plain
    return found


class Limiter:
    """At most ``hz`` a second; 0 or less is none at all."""

    def __init__(self, hz: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period = 1.0 / hz if hz > 0 else math.inf
        self._clock = clock
        self._due = -math.inf

    def admit(self) -> bool:
        """Whether the next one may go now."""
        now = self._clock()
        if math.isinf(self._period) or now < self._due:
            return False
        # Half a period from now at least: a source at just this rate loses nothing, a burst is thinned out.
        self._due = max(self._due + self._period, now + self._period / 2)
        return True


def _plain(value: Any) -> Any:
    if isinstance(value, bool):
        return value
    if isinstance(value, int | float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist") and getattr(value, "ndim", 2) <= 1:
        value = value.tolist()
        if not isinstance(value, list):
            return _plain(value)
    if isinstance(value, list | tuple) and len(value) < ARRAY_MAX:
        entries = [_plain(entry) for entry in value if not isinstance(entry, list | tuple)]
        return entries if len(entries) == len(value) and None not in entries else None
    return None
