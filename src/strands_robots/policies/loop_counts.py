"""Figures of the control loop of one policy."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

LATENCIES = 1000
"""Latencies of which the quantiles are taken."""


@runtime_checkable
class Counted(Protocol):
    """Policy that counts what its loop did."""

    def counts(self) -> Mapping[str, float]:
        """Return the figures by name, as events, status and recordings have them."""


@dataclass
class LoopCounts:
    """Counts of one rollout; times in seconds.

    Attributes:
        inferences: answers that came.
        underruns: how often no action was there in time; ``underrun_steps`` has the control steps without one.
        stale_actions: actions that came too late to be played.
        speed_limited_steps: steps that the profile's ``max_speed`` held back.
        chunk_age_s: age of the observation behind the last action; ``chunk_age_max_s`` the greatest.
    """

    inferences: int = 0
    underruns: int = 0
    underrun_steps: int = 0
    stale_actions: int = 0
    speed_limited_steps: int = 0
    chunk_age_s: float = 0.0
    chunk_age_max_s: float = 0.0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=LATENCIES))

    def answered(self, latency_s: float) -> None:
        """Count an answer."""
        self.inferences += 1
        self.latencies.append(latency_s)

    def aged(self, seconds: float) -> None:
        """Note the age of the chunk that an action was taken of."""
        self.chunk_age_s = seconds
        self.chunk_age_max_s = max(self.chunk_age_max_s, seconds)

    def as_dict(self) -> dict[str, float]:
        """Return the figures by name."""
        ordered = sorted(self.latencies) or [0.0]
        return {
            "inferences": self.inferences,
            "latency_ms": round(1000 * (self.latencies[-1] if self.latencies else 0.0), 2),
            "latency_p50_ms": round(1000 * _quantile(ordered, 0.5), 2),
            "latency_p99_ms": round(1000 * _quantile(ordered, 0.99), 2),
            "latency_max_ms": round(1000 * ordered[-1], 2),
            "chunk_age_s": round(self.chunk_age_s, 3),
            "chunk_age_max_s": round(self.chunk_age_max_s, 3),
            "underruns": self.underruns,
            "underrun_steps": self.underrun_steps,
            "stale_actions": self.stale_actions,
            "speed_limited_steps": self.speed_limited_steps,
        }


def _quantile(ordered: list[float], share: float) -> float:
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
