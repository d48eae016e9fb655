"""One policy on one body at a steady rate, with an honest stop.

A rollout holds a :class:`~strands_robots.safety.gate.Permit`; the body checks it under the lock of each write, so
that nothing is written after a halt's verdict. Ticks have absolute deadlines: the rate does not drift, and a tick
that was missed is dropped, never made up in a burst.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from strands_robots.contract import Observer, RolloutEvent, Unsubscribe
from strands_robots.policies.base import Action, Policy, Task
from strands_robots.safety.gate import CommandVoidError, Permit

logger = logging.getLogger(__name__)

JOIN_S = 1.0
"""How long a stop waits for the loop to end before it says that it did not."""


class Body(Protocol):
    """What a rollout drives: one robot's observations and actions, by name, in its own units."""

    name: str

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """Lowest and highest command of each action key, infinite where nobody knows."""

    def get_observation(self) -> Mapping[str, Any]:
        """Positions by joint name; images and other things may be among them."""

    def send_action(self, action: Mapping[str, float], permit: Permit) -> Mapping[str, float]:
        """Write and return what was really sent. Raises CommandVoidError, having written nothing, without leave."""

    def hold(self, permit: Permit) -> None:
        """Freeze where it is now. Writes nothing when ``permit`` is void: then a halt holds already."""


class Ticker(Protocol):
    """Time, so that a test may own it."""

    def now(self) -> float:
        """Seconds that only go forward."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait for ``event`` at most ``seconds``; true when it was set."""


class MonotonicTicker:
    """The machine's own clock."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return event.wait(seconds) if seconds > 0 else event.is_set()


class Observers:
    """Who is told of rollout events. An observer that raises is logged and told again next time."""

    def __init__(self) -> None:
        self._observers: tuple[Observer, ...] = ()
        self._lock = threading.Lock()

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` from now on; the returned callable ends it."""
        with self._lock:
            self._observers = (*self._observers, observer)

        def unsubscribe() -> None:
            with self._lock:
                self._observers = tuple(each for each in self._observers if each is not observer)

        return unsubscribe

    def tell(self, event: RolloutEvent) -> None:
        """Tell everybody, in the order in which they came."""
        for observer in self._observers:
            try:
                observer(event)
            except Exception:
                logger.exception("An observer of %s failed at a %s event.", event.robot, event.kind)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a rollout is to do: ``duration`` in seconds, ``hz`` actions a second."""

    instruction: str
    policy_name: str
    duration: float
    hz: float


class Rollout:
    """Runs once. ``state`` is running, completed, stopped or error; ``error`` says why in the last case."""

    def __init__(
        self,
        body: Body,
        policy: Policy,
        plan: Plan,
        permit: Permit,
        *,
        tell: Callable[[RolloutEvent], None] = lambda event: None,
        ticker: Ticker | None = None,
    ) -> None:
        self.body = body
        self.plan = plan
        self.state = "running"
        self.error = ""
        self.step = 0
        self._policy = policy
        self._permit = permit
        self._tell = tell
        self._ticker = ticker or MonotonicTicker()
        self._stop = threading.Event()
        self._begun = self._ticker.now()
        self._ended: float | None = None
        self._thread = threading.Thread(target=self._run, name=f"rollout-{body.name}", daemon=True)

    @property
    def running(self) -> bool:
        """True until the loop has ended for good: only so long can it still write."""
        return self._ended is None

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start, up to the end."""
        return (self._ticker.now() if self._ended is None else self._ended) - self._begun

    def start(self) -> Rollout:
        """Begin; returns at once."""
        self._thread.start()
        return self

    def request_stop(self) -> None:
        """Ask the loop to end after the write that may be in flight; returns at once."""
        self._stop.set()

    def stop(self, timeout: float = JOIN_S) -> bool:
        """Ask the loop to end and wait for it, ``timeout`` seconds at most. False when it outlived that."""
        self.request_stop()
        return self.wait(timeout)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end. False when it has not come within ``timeout`` seconds."""
        if self._thread is not threading.current_thread() and self._thread.ident is not None:
            self._thread.join(timeout)
        return not self.running

    def status(self) -> dict[str, Any]:
        """The rollout as a row for people and agents."""
        return {
            "robot": self.body.name,
            "instruction": self.plan.instruction,
            "policy": self.plan.policy_name,
            "state": self.state,
            "step": self.step,
            "elapsed_s": round(self.elapsed_s, 3),
            "duration": self.plan.duration,
            "error": self.error,
        }

    def _run(self) -> None:
        self._emit("started")
        try:
            self.state = self._loop()
        except CommandVoidError:
            self.state = "stopped"
        except Exception as exc:
            logger.exception("The rollout of %s on %s failed.", self.plan.policy_name, self.body.name)
            self.error = f"{type(exc).__name__}: {exc}"
            self.state = "error"
        finally:
            self._rest()
            self._ended = self._ticker.now()
            self._emit("finished")

    def _loop(self) -> str:
        self._policy.reset(Task(self.plan.instruction, self.body.bounds, self.plan.hz))
        waiting: deque[Action] = deque()
        for _ in self._ticks():
            if not self._permit.valid:
                return "stopped"
            observation = self.body.get_observation()
            if not waiting:
                waiting.extend(self._policy.act(observation))
            if not waiting:
                return "completed"
            sent = self.body.send_action(waiting.popleft(), self._permit)
            self.step += 1
            self._emit("step", numbers(observation), sent)
        return "stopped" if self._stop.is_set() else "completed"

    def _ticks(self) -> Iterator[None]:
        """One turn a control period until the duration is over or a stop is asked for."""
        period = 1 / self.plan.hz
        begun = due = self._ticker.now()
        while not self._stop.is_set() and self._ticker.now() - begun < self.plan.duration:
            yield
            due += period
            late = self._ticker.now() - due
            if late > 0:
                due += int(late / period) * period
            if self._ticker.wait(self._stop, due - self._ticker.now()):
                return

    def _rest(self) -> None:
        """Leave nothing running: neither the last action nor what the policy took."""
        endings: dict[str, Callable[[], None]] = {
            "hold": lambda: self.body.hold(self._permit),
            "close its policy": self._policy.close,
        }
        for what, action in endings.items():
            try:
                action()
            except Exception as exc:
                logger.exception("%s could not %s after a rollout.", self.body.name, what)
                self.error = self.error or f"could not {what}: {type(exc).__name__}: {exc}"
                self.state = "error"

    def _emit(
        self,
        kind: Literal["started", "step", "finished"],
        observation: Mapping[str, float] | None = None,
        action: Mapping[str, float] | None = None,
    ) -> None:
        self._tell(
            RolloutEvent(
                kind,
                self.body.name,
                self.plan.instruction,
                self.plan.policy_name,
                self.step,
                self.elapsed_s,
                self.state,
                self.error,
                observation or {},
                action or {},
            )
        )


def numbers(observation: Mapping[str, Any]) -> dict[str, float]:
    """The scalars of an observation as floats; images, text and booleans are left out."""
    found: dict[str, float] = {}
    for key, value in observation.items():
        if isinstance(value, bool | str | bytes) or _shape(value):
            continue
        try:
            found[key] = float(value)
        except (TypeError, ValueError):
            continue
    return found


def _shape(value: Any) -> tuple[int, ...]:
    shape: tuple[int, ...] = getattr(value, "shape", ())
    return shape
