"""A leader kept inside a follower's bounds before its frames travel: ranges, speed, a glide at the start."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from strands_robots.policies.base import Action, Ranges
from strands_robots.teleop import LeaderPolicy
from strands_robots.utils import ValidationError


class BoundedLeader:
    """A leader whose every frame the follower can take.

    Args:
        policy: the leader as a policy, which checks, clamps and bounds its frames.
        start: where the follower stands, by action key; the first frames glide from there.
        ranges: of the follower's action keys.

    Raises:
        ValidationError: the leader is not connected.
    """

    is_connected = True

    def __init__(self, policy: LeaderPolicy, start: Mapping[str, float], ranges: Ranges) -> None:
        self.done = threading.Event()
        """Set when the leader has led to the end, or failed for so long that it is given up."""
        self.error = ""
        self._policy = policy
        self._start = dict(start)
        self._last: Action = {}
        policy.reset("lead a follower elsewhere", ranges)

    def get_action(self) -> Action:
        """The next frame; after the end the last one.

        Raises:
            ValidationError: the leader gave nothing usable this time.
        """
        if self.done.is_set():
            return self._held()
        try:
            decided = self._policy.act(self._start)
        except Exception as exc:  # noqa: BLE001 - a leader raises what it likes; it is over, and the reason is kept
            self.error = f"{type(exc).__name__}: {exc}"
            self.done.set()
            return self._held()
        if decided is None:
            self.done.set()
            return self._held()
        if not isinstance(decided, Mapping) or not decided:
            raise ValidationError(f"leader gave nothing usable: {self._policy.last_error}.")
        self._last = dict(decided)
        return dict(decided)

    def get_teleop_events(self) -> dict[str, Any] | None:
        """What the leader itself tells besides its targets. Raises what the leader raises."""
        return self._policy.events()

    def _held(self) -> Action:
        if not self._last:
            raise ValidationError("leader ended before its first frame.")
        return dict(self._last)
