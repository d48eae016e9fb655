"""The control loop: a policy drives a body at a steady rate until it ends.

The lock discipline of every write: a body sends an action only while its permit is valid, and checks that under the
same lock as the write. A stop voids the permit first and then passes that lock once; from then on nothing is written.
A rollout that ends in any other way than a halt makes the body hold its position, so no last action goes on by itself.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, Literal, Protocol, TypedDict

from strands_robots.contract import Observers, RolloutEvent
from strands_robots.envelope import Envelope, error, success
from strands_robots.policies.base import (
    Action,
    Counted,
    Led,
    Noting,
    Paced,
    Policy,
    PolicyError,
    Ranges,
    TurnOfDriver,
    checked_action,
    is_velocity,
    limited,
    numbers,
)
from strands_robots.safety.gate import Permit, PermitVoidError
from strands_robots.safety.process import shorten_time_slices
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, number, text, whole
from strands_robots.utils import duration as checked_duration

logger = stop_logger(__name__)

State = Literal["idle", "running", "completed", "stopped", "error"]

STEPS_MAX = 10_000_000
"""Most actions of one rollout."""

START_S = 2.0
"""Seconds in which a policy has to be ready for its first step."""

STOP_JOIN_S = 2.0
"""Seconds that a stop of one robot waits for its loop."""

MOTIONS_HELD = "its motions were held, as after a pause of its process"
"""Reason of a led robot's hold by its gate."""

STILL_JOIN_S = 0.05
"""Seconds that a stop waits for the loop of a robot that cannot move any more."""


class RolloutOptions(TypedDict):
    """The arguments of :class:`Rollout` that a caller chooses."""

    instruction: str
    duration: float
    hz: float
    steps: int | None


def rollout_options(instruction: object, duration: object, policy: dict[str, Any], hz: float) -> RolloutOptions:
    """Check a request for a rollout.

    Args:
        instruction: the task, 1 to 2000 characters.
        duration: seconds, above 0 up to :data:`~strands_robots.utils.DURATION_MAX_S`.
        policy: options of the policy. Those of the loop itself are taken out: ``control_frequency``, 0.1 to ``hz``,
            and ``n_steps``, 1 to 10,000,000.
        hz: the robot's own rate.

    Raises:
        ValidationError: a value outside its domain.
    """
    task = text("instruction", instruction)
    seconds = checked_duration("duration", duration)
    whole("policy_port", policy.get("policy_port", 0), low=0, high=65535)
    rate = number("control_frequency", policy.pop("control_frequency", hz), low=min(0.1, hz), high=hz)
    steps = policy.pop("n_steps", None)
    count = None if steps is None else whole("n_steps", steps, low=1, high=STEPS_MAX)
    return {"instruction": task, "duration": seconds, "hz": rate, "steps": count}


class Body(Protocol):
    """One arm or one base that a rollout or a teleoperation drives."""

    name: str

    @property
    def bounds(self) -> Ranges:
        """Range of every action key, in the body's own units."""

    @property
    def speeds(self) -> Mapping[str, float]:
        """Greatest speed by action key, in its unit a second; only of bounded keys."""

    def get_observation(self) -> Mapping[str, Any]:
        """Return the numbers and images that the body observes."""

    def get_joints(self) -> dict[str, float]:
        """Return the numbers of an observation, read without touching a camera."""

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        """Write ``action`` and return what was really sent.

        Raises:
            PermitVoidError: ``permit`` is void, which is checked under the lock of the write; nothing was written.
        """

    def hold(self, permit: Permit | None = None) -> None:
        """Freeze the body, unless ``permit`` was revoked: then that halt freezes it."""

    def running(self) -> AbstractContextManager[None]:
        """Return a context that is entered while a loop drives the body."""


class Clock:
    """Monotonic time, and waiting until a moment of it. Tests replace it."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, until: float, stop: threading.Event) -> None:
        """Return at ``until``, or at once when ``stop`` is set."""
        left = until - time.monotonic()
        if left > 0:
            stop.wait(left)


RolloutObservers = Observers[RolloutEvent]
"""Observers of the rollouts of one robot."""


def instruction_note(rollout: Rollout) -> str:
    """Return the sentence for the answer of a policy that follows no instruction."""
    return "" if rollout.follows_instruction else f" The policy {rollout.policy_name} does not follow the instruction."


class Rollout:
    """One run of one policy on one body, on its own thread. A rollout is used once.

    Args:
        body: driven by the policy.
        policy: decides the actions; closed at the end.
        permit: permission to move, revoked by a halt and withdrawn by :meth:`request_stop`.
        instruction: the task, passed to the policy.
        policy_name: the policy's name in events and answers.
        duration: seconds, or None for no end.
        steps: actions, or None for no end.
        hz: control rate. Ticks are at absolute times; a missed tick is dropped, never made up later.
        observers: called with the rollout's events.
        clock: the loop's time.
        ends_at_rest: the last action is one to keep, such as a grip: a completed rollout leaves it as it is.
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
        observers: RolloutObservers | None = None,
        clock: Clock | None = None,
        ends_at_rest: bool = False,
    ) -> None:
        self.robot = body.name
        self.instruction = instruction
        self.policy_name = policy_name
        self.duration = duration
        self._steps = steps
        self.state: State = "idle"
        self.error = ""
        self.step_count = 0
        self.missed_ticks = 0
        self.clamped_steps = 0
        """Actions that the body's speed limit held back."""
        self.out_of_range_steps = 0
        """Actions with a target beyond the body's range, where it was put."""
        self._body = body
        self._policy = policy
        self._permit = permit
        self._period = 1 / hz
        self._observers = observers or RolloutObservers()
        self._clock = clock or Clock()
        self._ends_at_rest = ends_at_rest
        self._speeds = dict(body.speeds)
        self._last: dict[str, float] = {}
        self._written_at = -math.inf
        self._held_back: Action = {}
        self._moving = False
        self._holds = permit.request.gate.holds
        self._stop_requested = threading.Event()
        self._begun = threading.Event()
        self._paced = policy if isinstance(policy, Paced) else None
        self._noting = policy if isinstance(policy, Noting) else None
        self._led = policy if isinstance(policy, Led) else None
        self._turn: TurnOfDriver | None = None
        self.follows_instruction = getattr(policy, "follows_instruction", True) is not False
        """False for a policy that moves by itself, whatever it was told."""
        self._started_at: float | None = None
        self._ended_at: float | None = None
        self._thread = threading.Thread(target=self.run, name=f"rollout-{body.name}", daemon=True)
        self.start = self._thread.start
        """Run on the rollout's own thread; returns at once."""

    @property
    def running(self) -> bool:
        """True from :meth:`start` until the loop's thread has ended."""
        return self.state == "running" or self._thread.is_alive()

    @property
    def voided(self) -> bool:
        """True once it was stopped or halted: it moves nothing more; its loop may run."""
        return not self._permit.valid

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start, or the time it took."""
        if self._started_at is None:
            return 0.0
        return (self._clock.now() if self._ended_at is None else self._ended_at) - self._started_at

    @property
    def counts(self) -> dict[str, float]:
        """Figures of the loop, as status, events and recordings have them."""
        own = {
            "missed_ticks": self.missed_ticks,
            "clamped_steps": self.clamped_steps,
            "out_of_range_steps": self.out_of_range_steps,
        }
        return {**own, **(self._policy.counts() if isinstance(self._policy, Counted) else {})}

    def row(self) -> dict[str, Any]:
        """Return the rollout as a row of ``list_policies_running``."""
        return {
            "robot": self.robot,
            "instruction": self.instruction,
            "policy": self.policy_name,
            "step": self.step_count,
            "elapsed_s": round(self.elapsed_s, 3),
            **({"loop": self.counts} if isinstance(self._policy, Counted) else {}),
        }

    def not_begun(self, within: float = START_S) -> str:
        """Wait for the first step; return why there is none ``within`` seconds, if so.

        A rollout whose policy is not ready by then is void: nothing starts after the reason was given.
        """
        if not self._begun.wait(within):
            self.request_stop()
            return f"the policy {self.policy_name} was not ready in {within:g} s, and was given up"
        if self.state == "error":
            return f"the policy {self.policy_name} failed: {self.error}"
        return "it was stopped before its first step" if self.state == "stopped" and not self.step_count else ""

    def join(self, timeout: float | None = None) -> bool:
        """Wait for the end and return True when the loop has ended."""
        if self._thread.ident is not None and threading.current_thread() is not self._thread:
            self._thread.join(timeout)
        return not self.running

    def request_stop(self) -> None:
        """Void the permit, wake the loop and interrupt the policy."""
        self.void()
        self.interrupt()

    def void(self) -> None:
        """Void the permit and wake the loop; asks nothing of the policy."""
        self._permit.withdraw()
        self._stop_requested.set()

    def interrupt(self) -> None:
        """Interrupt the policy, which may take its time: no halt waits for this."""
        try:
            self._policy.interrupt()
        except Exception:
            logger.exception("The policy %s of %s raised when interrupted.", self.policy_name, self.robot)

    def ended_by(self, deadline: float) -> Envelope:
        """Answer a stop: wait for the loop's end until ``deadline`` (monotonic).

        The caller has frozen the body, so a loop that outlives this sends no action any more. It counts as stopped
        while its policy is still loading, for it never moved the robot, and while the robot is locked.
        """
        still = not self._begun.is_set() or self._permit.locked
        patience = deadline - time.monotonic()
        if self.join(max(0.0, min(patience, STILL_JOIN_S) if still else patience)):
            return success("Stopped.", stopped=True)
        if still:
            return success(f"Stopped; its {self.policy_name} has not returned yet and can move nothing.", stopped=True)
        return error(
            f"the loop of its {self.policy_name} has not returned yet; it sends no action any more", stopped=False
        )

    def run(self) -> None:
        """Run the loop in the calling thread."""
        self.state = "running"
        self._started_at = self._clock.now()
        state: State = "stopped"
        # A policy that computes in this process must not keep the interpreter from the control loop.
        restore_time_slices = shorten_time_slices()
        try:
            with self._body.running():
                try:
                    bounds = dict(self._body.bounds)
                    try:
                        self._policy.reset(self.instruction, bounds)
                        self._begun.set()
                    finally:
                        self._notify("started")
                    self._permit.request.begun = True
                    state = self._loop(bounds)
                except PermitVoidError:
                    state = "stopped"
                except BaseException as exc:  # noqa: BLE001 - whatever a policy raises, SystemExit too, is reported
                    # A policy that was asked to stop may give up with any exception.
                    if self._permit.valid:
                        state, self.error = "error", f"{type(exc).__name__}: {exc}"
                        self._log_failure(exc)
                if state != "completed" or not self._ends_at_rest:
                    state = self._hold(state)
        except Exception as exc:
            state, self.error = "error", f"{type(exc).__name__}: {exc}"
            logger.exception("The rollout of %s on %s could not run.", self.policy_name, self.robot)
        finally:
            restore_time_slices()
            self._finish(state)

    def _log_failure(self, exc: BaseException) -> None:
        expected = isinstance(exc, PolicyError | OSError | ValidationError)
        message = "The rollout of %s on %s failed and the robot holds its position: %s"
        logger.error(message, self.policy_name, self.robot, exc, exc_info=None if expected else exc)

    def _loop(self, bounds: Ranges) -> State:
        began = started = self._clock.now()
        chunk: deque[Action] = deque()
        tick = 0
        while self._permit.valid:
            if self._held(chunk):
                started = self._clock.now() - tick * self._period
                continue
            # The duration starts with the first tick: loading a policy is not part of it.
            if self.duration is not None and self._clock.now() - began >= self.duration:
                return "completed"
            if self._steps is not None and self.step_count >= self._steps:
                return "completed"
            observation = self._body.get_observation() if self._policy.uses_cameras else dict(self._body.get_joints())
            if not chunk:
                actions = self._policy.act(observation)
                self._tell_turn()
                if actions is None:
                    return "completed"
                chunk.extend([actions] if isinstance(actions, Mapping) else actions)
            if self._held(chunk):
                started = self._clock.now() - tick * self._period
                continue
            if chunk:
                wanted = chunk.popleft()
                checked = checked_action(wanted, bounds if self._led is None else self._led.reach)
                self.out_of_range_steps += any(checked[key] != wanted[key] for key in checked)
                action = self._limited(checked, observation) if self._speeds else checked
                sent = self._body.send_action(action, self._permit)
                self._moving = any(is_velocity(key) and value for key, value in sent.items())
                self.step_count += 1
                self.clamped_steps += bool(self._held_back)
                told = numbers(sent)
                if self._noting is not None:
                    self._noting.wrote(told)
                led_by = "" if self._led is None else self._led.led_by
                self._notify("step", observation=numbers(observation), action=told, led_by=led_by)
            elif self._held_back:
                # The policy waits for the end of an action that the speed limit has not let through yet.
                self._body.send_action(self._limited(self._held_back, observation), self._permit)
            if self._paced is not None and self._paced.preparing:
                # The first inference is part of loading.
                began = started = self._clock.now()
                tick = 0
            if self._held(chunk):
                # Steps that were missed meanwhile are not made up for: the plan goes on from here.
                started = self._clock.now() - tick * self._period
            tick = self._next(tick, started)
            self._clock.wait(started + tick * self._period, self._stop_requested)
        return "stopped"

    def _tell_turn(self) -> None:
        """Tell who drives, where that has changed."""
        if self._led is not None and self._led.turn != self._turn:
            self._turn = turn = self._led.turn
            self._notify("turn", state=turn.state, error=turn.why, led_by=turn.leader)

    def _held(self, chunk: deque[Action]) -> bool:
        """Wait for the end of a hold; return True if there was one since the last call.

        Args:
            chunk: what would be written next; a leader's command of before is never carried out.
        """
        on = self._permit.held
        if on and self._led is not None:
            self._led.hold(MOTIONS_HELD)
        if on and self._moving:
            # A velocity goes on by itself until another one is written.
            self._moving = False
            self._body.hold(self._permit)
        self._permit.wait()
        before, self._holds = self._holds, self._permit.request.gate.holds
        if self._holds != before and self._led is not None:
            # A turn that began meanwhile was begun by somebody who had not seen the hold.
            self._led.hold(MOTIONS_HELD)
            chunk.clear()
        return self._holds != before

    def _limited(self, action: Action, observation: Mapping[str, Any]) -> Action:
        """Return the action to write now, within the speed limit of the body."""
        now = self._clock.now()
        # A pause must not add up to a jump.
        dt = min(now - self._written_at, self._period)
        wanted = {**self._held_back, **action}
        bounded = limited(wanted, {**numbers(observation), **self._last}, self._speeds, dt)
        self._written_at, self._last = now, {**self._last, **bounded}
        self._held_back = {key: value for key, value in wanted.items() if bounded[key] != value}
        return bounded

    def _next(self, tick: int, started: float) -> int:
        late = int((self._clock.now() - started) / self._period) - tick
        self.missed_ticks += max(late, 0)
        if self._paced is not None and late > 0:
            self._paced.miss(late)
        return tick + 1 + max(late, 0)

    def _hold(self, state: State) -> State:
        try:
            # After a halt, which freezes the body, the bus is left to it.
            if not self._permit.revoked:
                self._body.hold(self._permit)
        except Exception as exc:  # noqa: BLE001 - a body may raise anything; the rollout ends in error
            logger.critical("%s could not hold its position after its rollout: %s", self.robot, exc)
            self.error = f"{self.error + '; ' if self.error else ''}hold failed: {type(exc).__name__}: {exc}"
            return "error"
        return state

    def _finish(self, state: State) -> None:
        self._permit.withdraw()
        try:
            self._policy.close()
        except Exception:
            logger.exception("The policy %s of %s raised when closed.", self.policy_name, self.robot)
        self._ended_at = self._clock.now()
        self.state = state
        self._begun.set()
        self._notify("finished", state=state, error=self.error)

    def _notify(self, kind: Literal["started", "step", "turn", "finished"], **more: Any) -> None:
        self._observers.notify(
            RolloutEvent(
                kind=kind,
                robot=self.robot,
                instruction=self.instruction,
                policy=self.policy_name,
                step=self.step_count,
                clamped_steps=self.clamped_steps,
                elapsed_s=self.elapsed_s,
                follows_instruction=self.follows_instruction,
                loop=self.counts if kind == "finished" else {},
                **more,
            )
        )
