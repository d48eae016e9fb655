"""One policy step on the wire: what the policy saw and what it did."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.contract import RolloutEvent, Unsubscribe, WorldRobot
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.executor import Lane
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.wire import WireError

logger = logging.getLogger(__name__)

ARRAY_MAX = 100
WAITING = 8


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


class StepFeed:
    """Publishes the policy steps of one peer: those of its robot's rollouts, and those that a program hands in.

    A rollout tells of its steps on its control thread, so they leave on a thread of this feed's own; where the
    transport is slower than the rollout the oldest are dropped.

    Args:
        hz: steps a second of each robot at most; 0 or less is none at all.
    """

    def __init__(self, context: Context, robot: Any, hz: float) -> None:
        self._context = context
        self._robot = robot
        self._hz = hz
        self._called = Limiter(hz)
        self._limits: dict[str, Limiter] = {}
        self._lane = Lane(f"{context.peer_id}-stream", 1, WAITING, drop_oldest=True)
        self._unsubscribe: Unsubscribe | None = None
        self._several = False
        self._unpublished = 0

    def start(self) -> None:
        """Hear the robot's rollouts from now on; a robot that cannot be heard publishes no steps of its own."""
        if self._robot is None or self._hz <= 0:
            return
        try:
            self._unsubscribe = self._robot.subscribe(self.hear)
        except Exception as exc:  # noqa: BLE001 - a foreign robot's subscribe may be something else altogether
            logger.warning(
                "%s: its rollouts cannot be heard, so no steps are published: %s", self._context.peer_id, exc
            )

    def stop(self, timeout: float) -> list[str]:
        """Hear no more rollouts; names of threads that still publish after ``timeout`` seconds."""
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if callable(unsubscribe):
            unsubscribe()
        return self._lane.stop(timeout)

    def hear(self, event: object) -> None:
        """A rollout event, on its control thread; returns at once."""
        if not isinstance(event, RolloutEvent):
            return
        if event.kind == "started":
            self._several = isinstance(self._robot, WorldRobot) and len(self._robot.list_robots()) > 1
            self._limits[event.robot] = Limiter(self._hz)
        limit = self._limits.setdefault(event.robot, Limiter(self._hz))
        if event.kind == "step" and self._context.running() and limit.admit():
            stamp, prefix = self._context.clock(), f"{event.robot}/" if self._several else ""
            self._lane.submit(lambda: self._tell(event, stamp, prefix))

    def publish(
        self, step: int, observation: Mapping[str, Any], action: Mapping[str, Any], instruction: str, policy: str
    ) -> None:
        """Publish one step in the calling thread; what is above the rate is left out."""
        if not self._context.running() or not self._called.admit():
            return
        self._put(
            step_message(
                self._context.peer_id,
                self._context.clock(),
                step,
                observation=observation,
                action=action,
                instruction=instruction,
                policy=policy,
            )
        )

    def _tell(self, event: RolloutEvent, stamp: float, prefix: str) -> None:
        body = step_message(
            self._context.peer_id,
            stamp,
            event.step,
            observation={prefix + key: value for key, value in event.observation.items()},
            action={prefix + key: value for key, value in event.action.items()},
            instruction=event.instruction,
            policy=event.policy,
        )
        self._put(body)

    def _put(self, body: Mapping[str, Any]) -> None:
        try:
            self._context.put(topics.stream(self._context.peer_id), body)
        except (TransportError, WireError) as exc:
            self._unpublished += 1
            # A link that is down must not fill the log at the rate of a rollout.
            if self._unpublished & (self._unpublished - 1) == 0:
                logger.warning("%s: %d steps were not published: %s", self._context.peer_id, self._unpublished, exc)
        else:
            self._unpublished = 0


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
