"""A policy without a model: smooth, repeatable motion inside the joint ranges."""

from __future__ import annotations

import hashlib
import logging
import math
import random
from collections.abc import Mapping
from typing import Any

from strands_robots.policies.base import Action, Ranges, numbers
from strands_robots.utils import ValidationError, number, whole

logger = logging.getLogger(__name__)


class MockPolicy:
    """Policy that moves every joint along two slow sines around its middle.

    Motion is a function of the seed, the instruction, the start position and the count of steps, so a run can be
    repeated exactly. It starts at the present position with zero velocity and acceleration. A joint without a
    finite range does not move.

    Args:
        seed: any integer; another seed or another instruction is another motion.
        amplitude: used share of each half range, above 0 and at most 1.
        hz: control rate in which steps are counted; a slower loop makes a slower motion.
        fade_s: seconds in which the motion fades in from the start position.
    """

    uses_cameras = False
    follows_instruction = False

    def __init__(self, seed: int = 0, amplitude: float = 0.5, hz: float = 50.0, fade_s: float = 2.0) -> None:
        self._seed = whole("seed", seed)
        self._amplitude = number("amplitude", amplitude, above=0, high=1)
        self._dt = 1 / number("hz", hz, low=0.1, high=2000)
        self._fade_s = number("fade_s", fade_s, above=0, high=60)
        self._ranges: Ranges = {}
        self._waves: dict[str, tuple[float, float, float, float]] = {}
        self._start: dict[str, float] | None = None
        self._step = 0

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._ranges = {k: (low, high) for k, (low, high) in ranges.items() if math.isfinite(high - low)}
        if not self._ranges:
            raise ValidationError("the mock policy needs a robot with at least one action key of finite range.")
        unbounded = [key for key in ranges if key not in self._ranges]
        if unbounded:
            logger.info("The mock policy does not move %s, which have no range.", ", ".join(unbounded))
        digest = hashlib.blake2b(f"{self._seed}|{instruction}".encode(), digest_size=8).digest()
        draw = random.Random(int.from_bytes(digest)).uniform
        self._waves = {
            key: (draw(0.15, 0.3), draw(0, math.tau), draw(0.35, 0.6), draw(0, math.tau))
            for key in sorted(self._ranges)
        }
        self._start = None
        self._step = 0

    def act(self, observation: Mapping[str, Any]) -> Action:
        if self._start is None:
            present = numbers(observation)
            self._start = {key: min(max(present.get(key, (a + b) / 2), a), b) for key, (a, b) in self._ranges.items()}
        seconds = self._step * self._dt
        part = min(seconds / self._fade_s, 1.0)
        # The quintic from 0 to 1, smooth in velocity and acceleration.
        share = part * part * part * (part * (6 * part - 15) + 10)
        self._step += 1
        action: Action = {}
        for key, (low, high) in self._ranges.items():
            slow, slow_phase, fast, fast_phase = self._waves[key]
            swing = 0.7 * math.sin(math.tau * slow * seconds + slow_phase)
            swing += 0.3 * math.sin(math.tau * fast * seconds + fast_phase)
            wave = (low + high) / 2 + self._amplitude * (high - low) / 2 * swing
            action[key] = (1 - share) * self._start[key] + share * wave
        return action

    def interrupt(self) -> None:
        """Do nothing: this policy never waits."""

    def close(self) -> None:
        """Do nothing: this policy has no resources."""
