"""Policy steps on the wire: the observation and the action of each."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

from strands_robots.contract import RolloutEvent, Unsubscribe, robots_in
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.executor import BoundedExecutor
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.wire import WireError
from strands_robots.rate_limits import RateLimiter

logger = logging.getLogger(__name__)

ARRAY_MAX = 100
WAITING = 8


class StepPublisher:
    """Publishes policy steps: of rollouts, and those that a program hands in.

    A rollout reports its steps on its control thread, so they leave on a thread of this publisher's own; where the
    transport is slower than the rollout the oldest are dropped.

    Args:
        hz: steps a second of each robot at most; 0 or less is none at all.
    """

    def __init__(self, context: Context, robot: Any, hz: float) -> None:
        self._context = context
        self._robot = robot
        self._hz = hz
        self._handed_in = RateLimiter(hz)
        self._rollouts = RateLimiter(hz)
        self._executor = BoundedExecutor(f"{context.peer_id}-stream", 1, WAITING, drop_oldest=True)
        self._unsubscribe: Unsubscribe | None = None
        self._several = False
        self._unpublished = 0

    def start(self) -> None:
        """Subscribe to the robot's rollouts, where it has ``subscribe``."""
        if self._robot is None or self._hz <= 0:
            return
        try:
            self._unsubscribe = self._robot.subscribe(self.on_event)
        except Exception as exc:  # noqa: BLE001 - a foreign robot's subscribe may be something else altogether
            logger.warning(
                "%s: its rollouts cannot be subscribed to, so no steps are published: %s", self._context.peer_id, exc
            )

    def stop(self, timeout: float) -> list[str]:
        """Unsubscribe; names of threads that still publish after ``timeout`` seconds."""
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if callable(unsubscribe):
            unsubscribe()
        return self._executor.stop(timeout)

    def on_event(self, event: object) -> None:
        """Take a rollout event, on its control thread; returns at once."""
        if not isinstance(event, RolloutEvent):
            return
        if event.kind == "started":
            self._several = len(robots_in(self._robot)) > 1
            self._rollouts.forget(event.robot)
        if event.kind == "step" and self._context.running() and self._rollouts.admit(event.robot):
            stamp, prefix = self._context.clock(), f"{event.robot}/" if self._several else ""

            def publish() -> None:
                observation = {prefix + key: value for key, value in event.observation.items()}
                action = {prefix + key: value for key, value in event.action.items()}
                self._put(stamp, event.step, observation, action, instruction=event.instruction, policy=event.policy)

            self._executor.submit(publish)

    def publish(
        self, step: int, observation: Mapping[str, Any], action: Mapping[str, Any], instruction: str, policy: str
    ) -> None:
        """Publish one step in the calling thread; one above the rate is left out."""
        if self._context.running() and self._handed_in.admit():
            self._put(self._context.clock(), step, observation, action, instruction=instruction, policy=policy)

    def _put(
        self,
        now: float,
        step: int,
        observation: Mapping[str, Any],
        action: Mapping[str, Any],
        *,
        instruction: str,
        policy: str,
    ) -> None:
        peer = self._context.peer_id
        body = {
            "peer_id": peer,
            "step": step,
            "t": now,
            "instruction": instruction,
            "policy": policy,
            "observation": numbers(observation),
            "action": numbers(action),
        }
        try:
            self._context.put(topics.stream(peer), body)
        except (TransportError, WireError) as exc:
            self._unpublished += 1
            # A link that is down must not fill the log at the rate of a rollout.
            if self._unpublished & (self._unpublished - 1) == 0:
                logger.warning("%s: %d steps were not published: %s", peer, self._unpublished, exc)
        else:
            self._unpublished = 0


def numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers, booleans and 1-D arrays under 100 entries."""
    plain = {str(key): _plain(value) for key, value in values.items()}
    return {key: value for key, value in plain.items() if value is not None}


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
