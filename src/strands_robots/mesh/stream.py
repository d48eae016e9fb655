"""Policy steps that a peer publishes, and the topics that its user subscribes to.

Both leave the thread that they come on, a rollout's or the transport's, at once, for a thread of the peer's own.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.contract import RolloutEvent, Unsubscribe, robots_in
from strands_robots.mesh import topics, wire
from strands_robots.mesh.scheduler import BoundedExecutor
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import Declaration, Sample, Transport, TransportError, undeclare
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
        self._executor = BoundedExecutor(f"{context.peer_id}-stream", WAITING)
        self._unsubscribe: Unsubscribe | None = None
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
            self._rollouts.forget(event.robot)
        if event.kind == "step" and self._context.running() and self._rollouts.admit(event.robot):
            stamp = self._context.clock()

            def publish() -> None:
                prefix = f"{event.robot}/" if len(robots_in(self._robot)) > 1 else ""
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


DataCallback = Callable[[str, dict[str, Any]], None]
SampleCallback = Callable[[str, dict[str, Any], str | None], None]

INBOX_MAX = 256


class Subscriptions:
    """Named subscriptions; callbacks run one after another on one thread.

    A slow callback loses the oldest messages; it never delays a command or a stop.
    """

    def __init__(self, executor: BoundedExecutor) -> None:
        self._executor = executor
        self._lock = threading.Lock()
        self._declared: dict[str, Declaration] = {}
        self.inbox: dict[str, deque[dict[str, Any]]] = {}

    def add(
        self,
        transport: Transport,
        topic: str,
        name: str,
        *,
        callback: DataCallback | None = None,
        on_sample: SampleCallback | None = None,
        direct: Callable[[Sample], None] | None = None,
    ) -> bool:
        """Subscribe under ``name``, replacing it; False when the transport refused.

        Args:
            direct: called with the raw sample on the transport's thread instead, for parts of the mesh.
        """
        try:
            declared = transport.declare_subscriber(topic, direct or self._deliverer(callback, name, on_sample))
        except TransportError as exc:
            logger.warning("subscribe %s: %s", topic, exc)
            return False
        refused = transport.refusals().get(topic)
        if refused is not None:
            logger.warning("subscribe %s: %s", topic, refused)
            undeclare([declared])
            return False
        self.remove(name)
        with self._lock:
            self._declared[name] = declared
            if callback is None and on_sample is None and direct is None:
                self.inbox.setdefault(name, deque(maxlen=INBOX_MAX))
        return True

    def remove(self, name: str) -> bool:
        """Undeclare; False when there is none of that name."""
        with self._lock:
            declared = self._declared.pop(name, None)
            self.inbox.pop(name, None)
        if declared is None:
            return False
        undeclare([declared])
        return True

    def clear(self) -> int:
        """Undeclare all of them; how many there were."""
        names = list(self._declared)
        return sum(self.remove(name) for name in names)

    def _deliverer(
        self, callback: DataCallback | None, name: str, on_sample: SampleCallback | None
    ) -> Callable[[Sample], None]:
        def deliver(sample: Sample) -> None:
            try:
                data = wire.decode(sample.payload, topics.topic_of(sample.key).max_bytes)
            except wire.WireError as exc:
                logger.debug("%s: %s", sample.key, exc)
                return
            if on_sample is not None:
                on_sample(sample.key, data, sample.session)
            elif callback is not None:
                callback(sample.key, data)
            else:
                inbox = self.inbox.get(name)
                if inbox is not None:
                    inbox.append({"key": sample.key, **data})

        def submit(sample: Sample) -> None:
            self._executor.submit(lambda: deliver(sample))

        return submit
