"""One control loop: a policy drives a body at a steady rate until its time is over, it is done, or it is stopped.

The lock discipline of every write: a body sends an action only while the permit it is given is valid, and looks at
that under the same lock as the write. Whoever stops a motion voids the permit first and then passes that lock once;
from then on nothing is written. A rollout that ends in any other way than a halt leaves the body on hold, so the
last action never goes on by itself.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, Literal, Protocol

from strands_robots.contract import Observer, RolloutEvent, Unsubscribe
from strands_robots.policies.actions import checked_action, numbers
from strands_robots.policies.base import Action, Policy, PolicyError, Ranges
from strands_robots.safety.gate import Permit, PermitVoidError
from strands_robots.utils import ValidationError, number, whole

logger = logging.getLogger(__name__)

State = Literal["idle", "running", "completed", "stopped", "error"]

STEPS_MAX = 10_000_000
"""Most actions a rollout can be asked for."""

STOP_JOIN_S = 2.0
"""How long :meth:`Rollout.stop` waits for the loop by default."""


def loop_options(options: dict[str, Any], hz: float) -> tuple[float, int | None]:
    """Take from a policy's ``options`` what is the loop's own: its rate in Hz and how many actions end it.

    Args:
        options: ``control_frequency``, 0.1 to ``hz``, and ``n_steps``, 1 to 10,000,000; each is taken out, where it is.
        hz: the robot's own rate.

    Raises:
        ValidationError: a value outside its domain.
    """
    rate = number("control_frequency", options.pop("control_frequency", hz), low=min(0.1, hz), high=hz)
    steps = options.pop("n_steps", None)
    return rate, None if steps is None else whole("n_steps", steps, low=1, high=STEPS_MAX)


class Body(Protocol):
    """What a rollout or a teleoperation drives: one arm, one base."""

    name: str

    @property
    def bounds(self) -> Ranges:
        """Range of every action key, in the body's own units."""

    def get_observation(self) -> dict[str, Any]:
        """Everything the body sees; may hold images."""

    def get_joints(self) -> dict[str, float]:
        """The numbers of an observation, read without touching a camera."""

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        """Write ``action``; the answer is what was really sent.

        Raises:
            PermitVoidError: ``permit`` is void, looked at under the write's own lock; nothing was written.
        """

    def hold(self, permit: Permit | None = None) -> None:
        """Freeze where it is now; nothing when ``permit`` was revoked, for then the halt freezes it."""

    def running(self) -> AbstractContextManager[None]:
        """Held while a loop drives the body."""


class Clock:
    """Monotonic time, and waiting until a moment of it; a test gives its own."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, until: float, stop: threading.Event) -> None:
        """Return at ``until``, or at once when ``stop`` is set."""
        left = until - time.monotonic()
        if left > 0:
            stop.wait(left)


class Observers:
    """Who is told of rollout events. One that raises is logged, once for each kind of error, and stays."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._observers: tuple[Observer, ...] = ()
        self._logged: set[tuple[int, str]] = set()

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every event until the returned callable is called; a second call of it does nothing."""
        with self._lock:
            self._observers = (*self._observers, observer)
        once = threading.Lock()

        def unsubscribe() -> None:
            if once.acquire(blocking=False):
                with self._lock:
                    left = list(self._observers)
                    left.remove(observer)
                    self._observers = tuple(left)

        return unsubscribe

    def tell(self, event: RolloutEvent) -> None:
        """Tell everybody, in the calling thread."""
        for observer in self._observers:
            try:
                observer(event)
            except Exception as exc:
                mark = (id(observer), type(exc).__name__)
                if mark not in self._logged:
                    self._logged.add(mark)
                    logger.exception("An observer of %s raised and goes on being told.", event.robot)


class Rollout:
    """One run of one policy on one body, on a thread of its own. It is used once.

    Args:
        body: what is driven.
        policy: who decides; closed at the end.
        permit: leave to move. Revoked by a halt, withdrawn by :meth:`stop`.
        instruction: what the policy is told.
        policy_name: how the policy is called in events and answers.
        duration: seconds, or None for no end.
        steps: actions, or None for no end.
        hz: control rate. Ticks are at absolute times; one that is missed is dropped, never made up in a burst.
        observers: who is told of events.
        clock: the time the loop keeps.
    """

    def __init__(
        self,
        body: Body,
        policy: Policy,
        *,
        permit: Permit,
        instruction: str = "",
        policy_name: str = "policy",
        duration: float | None = None,
        steps: int | None = None,
        hz: float = 50.0,
        observers: Observers | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.instruction = instruction
        self.policy_name = policy_name
        self.duration = duration
        self._steps = steps
        self.state: State = "idle"
        self.error = ""
        self.step_count = 0
        self.missed_ticks = 0
        self._body = body
        self._policy = policy
        self._permit = permit
        self._period = 1 / hz
        self._observers = observers or Observers()
        self._clock = clock or Clock()
        self._ending = threading.Event()
        self._began: float | None = None
        self._ended: float | None = None
        self._thread = threading.Thread(target=self.run, name=f"rollout-{body.name}", daemon=True)

    @property
    def robot(self) -> str:
        """The name of the body."""
        return self._body.name

    @property
    def running(self) -> bool:
        """True from :meth:`start` until the loop's thread has ended, whatever it was told."""
        return self.state == "running" or self._thread.is_alive()

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began, or that it took."""
        if self._began is None:
            return 0.0
        return (self._clock.now() if self._ended is None else self._ended) - self._began

    def row(self) -> dict[str, Any]:
        """The rollout as a row of ``list_policies_running``."""
        return {
            "robot": self.robot,
            "instruction": self.instruction,
            "policy": self.policy_name,
            "step": self.step_count,
            "elapsed_s": round(self.elapsed_s, 3),
        }

    def start(self) -> None:
        """Run on the rollout's own thread; returns at once."""
        self.state = "running"
        self._thread.start()

    def join(self, timeout: float | None = None) -> bool:
        """Wait for the end; True when the loop has ended."""
        if self._thread.ident is not None and threading.current_thread() is not self._thread:
            self._thread.join(timeout)
        return not self.running

    def request_stop(self) -> None:
        """Void the permit, wake the loop and tell the policy; returns at once."""
        self._permit.withdraw()
        self._ending.set()
        try:
            self._policy.interrupt()
        except Exception:
            logger.exception("The policy %s of %s raised when interrupted.", self.policy_name, self.robot)

    def stop(self, timeout: float = STOP_JOIN_S) -> bool:
        """Stop, and tell the truth: False when the loop has not ended within ``timeout`` seconds.

        A loop that outlives it, in a policy that computes or on a bus that hangs, sends no action any more.
        """
        self.request_stop()
        return self.join(timeout)

    def run(self) -> None:
        """The loop, in the calling thread."""
        self.state = "running"
        self._began = self._clock.now()
        state: State = "stopped"
        try:
            with self._body.running():
                self._tell("started")
                try:
                    bounds = dict(self._body.bounds)
                    self._policy.reset(self.instruction, bounds)
                    state = self._loop(bounds)
                except PermitVoidError:
                    state = "stopped"
                except BaseException as exc:  # noqa: BLE001 - whatever a policy raises, SystemExit too, is told and held
                    # What was told to stop may give up in any way it likes.
                    if self._permit.valid:
                        state, self.error = "error", f"{type(exc).__name__}: {exc}"
                        self._lament(exc)
                state = self._hold(state)
        except Exception as exc:
            state, self.error = "error", f"{type(exc).__name__}: {exc}"
            logger.exception("The rollout of %s on %s could not run.", self.policy_name, self.robot)
        finally:
            self._finish(state)

    def _lament(self, exc: BaseException) -> None:
        what = "The rollout of %s on %s failed; it holds: %s"
        if isinstance(exc, PolicyError | OSError | ValidationError):
            logger.error(what, self.policy_name, self.robot, exc)
        else:
            logger.error(what, self.policy_name, self.robot, exc, exc_info=exc)

    def _loop(self, bounds: Ranges) -> State:
        started = self._clock.now()
        chunk: deque[Action] = deque()
        tick = 0
        while self._permit.valid:
            # A duration begins with the first tick: loading a policy is not part of it.
            if self.duration is not None and self._clock.now() - started >= self.duration:
                return "completed"
            if self._steps is not None and self.step_count >= self._steps:
                return "completed"
            observation = self._observe()
            if not chunk:
                decided = self._policy.act(observation)
                if decided is None:
                    return "completed"
                chunk.extend([decided] if isinstance(decided, Mapping) else decided)
            if chunk:
                sent = self._body.send_action(checked_action(chunk.popleft(), bounds), self._permit)
                self.step_count += 1
                self._tell("step", observation=numbers(observation), action=numbers(sent))
            tick = self._next(tick, started)
            self._clock.wait(started + tick * self._period, self._ending)
        return "stopped"

    def _next(self, tick: int, started: float) -> int:
        late = int((self._clock.now() - started) / self._period) - tick
        self.missed_ticks += max(late, 0)
        return tick + 1 + max(late, 0)

    def _observe(self) -> dict[str, Any]:
        return self._body.get_observation() if self._policy.uses_cameras else dict(self._body.get_joints())

    def _hold(self, state: State) -> State:
        try:
            self._body.hold(self._permit)
        except Exception as exc:  # noqa: BLE001 - a body may raise anything; the rollout ends in error and says it
            logger.critical("%s could not be put on hold after its rollout: %s", self.robot, exc)
            self.error = f"{self.error + '; ' if self.error else ''}hold failed: {type(exc).__name__}: {exc}"
            return "error"
        return state

    def _finish(self, state: State) -> None:
        self._permit.withdraw()
        try:
            self._policy.close()
        except Exception:
            logger.exception("The policy %s of %s raised when closed.", self.policy_name, self.robot)
        self._ended = self._clock.now()
        self.state = state
        self._tell("finished", state=state, error=self.error)

    def _tell(self, kind: Literal["started", "step", "finished"], **more: Any) -> None:
        self._observers.tell(
            RolloutEvent(
                kind=kind,
                robot=self.robot,
                instruction=self.instruction,
                policy=self.policy_name,
                step=self.step_count,
                elapsed_s=self.elapsed_s,
                **more,
            )
        )
