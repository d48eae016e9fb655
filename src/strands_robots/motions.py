"""The motion sources of one robot, or of one world of robots: at most one for each body, all halted together."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext

from strands_robots.contract import RolloutEvent
from strands_robots.envelope import Envelope, error, success
from strands_robots.policies.base import Policy
from strands_robots.rollout import Body, Observers, Plan, Rollout
from strands_robots.safety.gate import MotionGate
from strands_robots.utils import ValidationError

TASK, TELEOPERATION = "task", "teleoperation"


class Motions:
    """Starts, lists and stops rollouts. Thread-safe; its lock is never held while a loop is waited for.

    Args:
        gate: gives the permits; a robot that is locked starts nothing.
        observers: who is told of what happens.
        lease: held while a rollout runs, by body name; a simulation keeps its clock running with it.
    """

    def __init__(
        self,
        gate: MotionGate,
        observers: Observers,
        lease: Callable[[str], AbstractContextManager[None]] = lambda name: nullcontext(),
    ) -> None:
        self._gate = gate
        self._observers = observers
        self._lease = lease
        self._lock = threading.Lock()
        self._latest: dict[str, tuple[str, Rollout]] = {}

    def start(self, kind: str, body: Body, policy: Policy, plan: Plan) -> Rollout:
        """Begin to drive ``body``.

        Raises:
            MotionRefused: the robot is locked.
            ValidationError: something drives that body already.
        """
        permit = self._gate.permit(f"start_{kind}")
        lease = self._lease(body.name)
        rollout = Rollout(body, policy, plan, permit, tell=lambda event: self._told(event, lease))
        with self._lock:
            holder = self._latest.get(body.name)
            if holder is not None and holder[1].running:
                raise ValidationError(
                    f"{body.name} is busy with {describe(*holder)}; stop that first, nothing was started."
                )
            self._latest[body.name] = (kind, rollout)
            lease.__enter__()
            rollout.start()
        return rollout

    def latest(self, name: str, kind: str = TASK) -> Rollout | None:
        """The current or last rollout of a body, if it was of this kind."""
        with self._lock:
            holder = self._latest.get(name)
        return holder[1] if holder is not None and holder[0] == kind else None

    def running(self, kind: str | None = None) -> list[Rollout]:
        """The rollouts that run now, of one kind or of all."""
        with self._lock:
            holders = list(self._latest.values())
        return [rollout for each, rollout in holders if rollout.running and kind in (None, each)]

    def forget(self, name: str) -> None:
        """Drop what is known of a body that is gone."""
        with self._lock:
            self._latest.pop(name, None)

    def stop(self, name: str, kind: str, timeout: float) -> Envelope:
        """Stop one body's rollout of this kind and say whether it ended within ``timeout`` seconds."""
        rollout = self.latest(name, kind)
        if rollout is None or not rollout.running:
            return success(f"{name} has no {kind} running.", stopped=True, was_running=False)
        if rollout.stop(timeout):
            return success(f"Stopped {describe(kind, rollout)} of {name}.", stopped=True, was_running=True)
        return error(
            f"{describe(kind, rollout)} of {name} did not end within {timeout:g} s and may still write.",
            stopped=False,
            was_running=True,
        )

    def stops(self, deadline: float) -> Mapping[str, Callable[[], object]]:
        """How to halt everything that runs, for ``halt_each``: all are asked at once, then each is waited for.

        Args:
            deadline: on the monotonic clock, when the last one has to have ended.
        """
        with self._lock:
            holders = [(name, kind, rollout) for name, (kind, rollout) in self._latest.items() if rollout.running]
        for _, _, rollout in holders:
            rollout.request_stop()
        return {f"{name} {kind}": _Halt(rollout, deadline) for name, kind, rollout in holders}

    def _told(self, event: RolloutEvent, lease: AbstractContextManager[None]) -> None:
        if event.kind == "finished":
            lease.__exit__(None, None, None)
        self._observers.tell(event)


class _Halt:
    """Waits for one rollout to end, within what is left of the time for all."""

    def __init__(self, rollout: Rollout, deadline: float) -> None:
        self._rollout = rollout
        self._deadline = deadline

    def __call__(self) -> Envelope:
        left = max(0.0, self._deadline - time.monotonic())
        if self._rollout.wait(left):
            return success("ended", stopped=True)
        return error(f"no answer in {left:.3g} s", stopped=False)


def describe(kind: str, rollout: Rollout) -> str:
    """A rollout in a few words: ``task 'wave' (mock)``."""
    what = f" {rollout.plan.instruction!r}" if rollout.plan.instruction else ""
    return f"{kind}{what} ({rollout.plan.policy_name})"
