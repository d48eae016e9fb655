"""Settling: the slow way of a stopped arm to its rest pose, then limp.

It is the second half of a halt, and the only motion of a locked robot. The halt alone begins it; its permit is void at
the next halt, which freezes the arm; while it runs every other motion is refused. Real and simulated arms settle alike,
each in its own time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, Literal, Protocol

from strands_robots.audit import queue_safety_event
from strands_robots.contract import SETTLE, RolloutEvent
from strands_robots.envelope import Envelope, error
from strands_robots.errors import StrandsRobotsError
from strands_robots.policies.base import Action, Ranges
from strands_robots.policies.rollout import RolloutObservers
from strands_robots.safety.gate import MotionGate, Permit, PermitVoidError
from strands_robots.safety.stopping import StopVerdict
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, mapping, number, shown

logger = stop_logger(__name__)

SETTLE_S = 5.0
"""Longest time that an arm may take to its rest pose, in seconds."""

RANGES_PER_S = 0.25
"""Speed: the joint with the longest way crosses a quarter of its range in a second."""

LAG_SHARE = 0.1
"""Part of its range that a joint may be behind its target; one that is further behind is blocked."""

ARRIVED_SHARE = 0.02
"""Part of its range by which a joint may miss the rest pose."""

SETTLE_HZ = 50.0

STALLED_S = 30.0
"""Longest settling in real time where an arm's own time is simulated."""

State = Literal["", "settling", "settled", "stopped", "failed"]


class SettleError(StrandsRobotsError, RuntimeError):
    """The arm did not come to its rest pose."""


class StoppedArm(Protocol):
    """Arm that a halt has frozen, and that may settle."""

    name: str

    def get_positions(self) -> Mapping[str, float]:
        """Return the present position by action key."""

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        """Write targets; raise :class:`PermitVoidError` after a further stop."""

    def hold(self, permit: Permit | None = None) -> None:
        """Freeze it, unless ``permit`` was revoked."""

    def let_go(self, permit: Permit) -> None:
        """Switch the torque off; raise :class:`PermitVoidError` after a further stop."""

    def running(self) -> AbstractContextManager[None]:
        """Return a context in which its time passes."""


def checked_rest_pose(pose: object, ranges: Ranges) -> Action:
    """Return a rest pose that names every position key of a robot.

    Raises:
        ValidationError: no pose, a key that is missing or unknown, a target outside its range, a joint without one.
    """
    named = mapping("rest_pose", pose)
    unknown = [key for key in named if key not in ranges]
    missing = [key for key in ranges if key not in named]
    if unknown or missing:
        wrong = f"it lacks {', '.join(missing)}" if missing else f"there is no {', '.join(map(shown, unknown))}"
        raise ValidationError(f"rest_pose must have a target for each of {', '.join(ranges)}: {wrong}.")
    unbounded = [key for key, (low, high) in ranges.items() if not math.isfinite(high - low)]
    if unbounded:
        raise ValidationError(f"rest_pose needs joint_ranges for {', '.join(unbounded)}: its speed is a part of them.")
    return {key: number(f"rest_pose[{key!r}]", named[key], low=low, high=high) for key, (low, high) in ranges.items()}


class Settling:
    """The settling of one arm; :meth:`begin` belongs to its halt.

    Args:
        body: goes to its rest pose.
        gate: of the robot; this is one of its latches while the arm settles.
        rest_pose: targets, as :func:`checked_rest_pose` returns them.
        ranges: of the keys of ``rest_pose``.
        observers: called with the beginning and the end, as of a task with the policy ``settle``.
        clock: the arm's own time, in seconds, where that is not the real one.

    Whoever makes it calls :meth:`note_motion` with each motion of the arm.
    """

    def __init__(
        self,
        body: StoppedArm,
        gate: MotionGate,
        rest_pose: Action,
        ranges: Ranges,
        observers: RolloutObservers,
        *,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._body, self._gate, self._observers = body, gate, observers
        self._rest = rest_pose
        self._width = {key: ranges[key][1] - ranges[key][0] for key in rest_pose}
        self._clock = clock or time.monotonic
        self._patience_s = SETTLE_S + 1 if clock is None else STALLED_S
        self._due = False
        self._permit: Permit | None = None
        self._ended = threading.Event()
        self._ended.set()
        self.state: State = ""
        self.error = ""

    @property
    def running(self) -> bool:
        """True until the arm is limp, was stopped again or failed."""
        return not self._ended.is_set()

    def refusal(self, verb: str) -> Envelope | None:
        """Return the refusal of ``verb`` while the arm settles."""
        if not self.running:
            return None
        return error(f"{verb} is refused: {self._body.name} settles to its rest pose after a stop.", settling=True)

    def take(self) -> bool:
        """Return whether the halt that asks may settle the arm: once after each motion.

        A halt of an arm that has not moved since the one before only freezes it: neither a second stop nor a robot
        that comes up locked starts a motion.
        """
        due, self._due = self._due, False
        return due

    def begin(self, generation: int, given: int) -> bool:
        """Start, for the halt of this ``generation``.

        Args:
            given: the gate's count of permits at that halt.

        Returns:
            False where a motion was begun since, which a settling must not join, or no thread starts.
        """
        permit = self._gate.settling(generation)
        before, self.state, self.error = self.state, "settling", ""
        self._ended.clear()
        # After the lockout, whose refusal says more.
        self._gate.attach(self)
        if self._gate.given != given:
            self.state = before
            self._gate.detach(self)
            self._ended.set()
            return False
        self._permit = permit
        try:
            threading.Thread(target=self._run, args=(permit,), name=f"settle-{self._body.name}", daemon=True).start()
        except RuntimeError as exc:
            self._end(permit, "failed", str(exc))
            return False
        return True

    def give_up(self) -> None:
        """End a settling under way; the caller freezes the arm."""
        if self._permit is not None:
            self._permit.withdraw()

    def wait(self) -> State:
        """Wait for the end of a settling under way; return how the last one ended."""
        self._ended.wait(self._patience_s + 1)
        return self.state

    def ending(self) -> str:
        """Return how the last settling ended, as the end of a sentence; empty for none."""
        ends = {
            "settled": "is at its rest pose, and limp",
            "stopped": "was stopped again while it settled, and holds its position",
            "failed": f"did not settle, and keeps its position with torque: {self.error}",
        }
        return ends.get(self.state, "")

    def note_motion(self) -> None:
        """Let the next halt settle the arm; its own way to the rest pose does not count."""
        if not self.running:
            self._due = True

    def _run(self, permit: Permit) -> None:
        began = self._clock()
        self._notify("started")
        try:
            with self._body.running():
                self._travel(permit, began + SETTLE_S, time.monotonic() + self._patience_s)
                self._body.let_go(permit)
        except PermitVoidError:
            self._end(permit, "stopped", "another stop froze it", began)
        except BaseException as exc:  # noqa: BLE001 - a device may raise anything; the arm is held and the event says what
            problem = str(exc) if isinstance(exc, SettleError) else f"{type(exc).__name__}: {exc}"
            self._end(permit, "failed" if permit.valid else "stopped", problem, began)
        else:
            self._end(permit, "settled", "", began)

    def _travel(self, permit: Permit, deadline: float, give_up: float) -> None:
        """Go along a straight line in joint space, all joints at once."""
        present = self._read(permit)
        start = {key: present[key] for key in self._rest}
        way = max(abs(self._rest[key] - start[key]) / self._width[key] for key in self._rest)
        steps = math.ceil(way / RANGES_PER_S * SETTLE_HZ)
        for step in range(1, steps + 1):
            share = step / steps
            target = {key: start[key] + share * (self._rest[key] - start[key]) for key in self._rest}
            due = self._clock() + 1 / SETTLE_HZ
            self._body.send_action(target, permit)
            present = self._read(permit)
            behind = self._off(target, present, LAG_SHARE)
            if behind:
                raise SettleError(f"{behind} of its target on the way to the rest pose: something is in its way")
            if self._clock() > deadline:
                raise SettleError(f"it was not at its rest pose in {SETTLE_S:g} s")
            # A late step delays the next one; catching up would be faster than the bound.
            self._wait(permit, due, give_up)
        while off := self._off(self._rest, present, ARRIVED_SHARE):
            if self._clock() > deadline:
                raise SettleError(f"{off} of the rest pose after {SETTLE_S:g} s")
            self._wait(permit, self._clock() + 1 / SETTLE_HZ, give_up)
            present = self._read(permit)

    def _wait(self, permit: Permit, until: float, give_up: float) -> None:
        while (left := until - self._clock()) > 0 and permit.valid:
            if time.monotonic() > give_up:
                raise SettleError("its time stands still")
            time.sleep(left)

    def _read(self, permit: Permit) -> Mapping[str, float]:
        if not permit.valid:
            raise PermitVoidError(f"{self._body.name} was stopped")
        joints = self._body.get_positions()
        missing = [key for key in self._rest if key not in joints]
        if missing:
            raise SettleError(f"{', '.join(missing)} cannot be read")
        return joints

    def _off(self, target: Mapping[str, float], present: Mapping[str, float], share: float) -> str:
        """Return the joint furthest off, if beyond ``share`` of its range."""
        worst = max(target, key=lambda key: abs(target[key] - present[key]) / self._width[key])
        short = abs(target[worst] - present[worst])
        return f"{worst} is {short:.1f} short" if short > share * self._width[worst] else ""

    def _end(self, permit: Permit, state: State, problem: str, began: float | None = None) -> None:
        """Hold the arm unless it is limp or another halt froze it; record the end."""
        if state == "failed":
            try:
                self._body.hold(permit)
            except Exception as exc:  # noqa: BLE001 - as in _run; without a bus a servo keeps its last target
                problem = f"{problem}; {type(exc).__name__}: {exc}"
        self.state, self.error = state, problem
        self._gate.detach(self)
        self._ended.set()
        name = self._body.name
        if state == "failed":
            logger.critical("%s did not settle, and keeps its last position with torque: %s.", name, problem)
        else:
            logger.info("%s %s.", name, "settled and is limp" if state == "settled" else "was stopped while it settled")
        took = 0.0 if began is None else self._clock() - began
        queue_safety_event("settle_" + state, name, {"why": problem, "elapsed_s": round(took, 3)})
        self._notify("finished", took, {"settled": "completed", "stopped": "stopped"}.get(state, "error"), problem)

    def _notify(
        self, kind: Literal["started", "finished"], took: float = 0.0, state: str = "running", problem: str = ""
    ) -> None:
        self._observers.notify(
            RolloutEvent(
                kind,
                self._body.name,
                instruction="settle to the rest pose",
                policy=SETTLE,
                elapsed_s=took,
                state=state,
                error=problem if state == "error" else "",
            )
        )


class Settlings:
    """Settling of each arm of a robot or of a world, by the name of its body."""

    def __init__(self) -> None:
        # A halt may be reading the present map, so that a new one takes its place as a whole.
        self.by_body: Mapping[str, Settling] = {}

    def running(self) -> list[str]:
        """Return the names of the bodies that settle."""
        return [name for name, each in self.by_body.items() if each.running]

    def after(self, gate: MotionGate, generation: int, given: int, verdict: StopVerdict) -> StopVerdict:
        """Let the arms settle that moved since the last stop, if everything stopped.

        Args:
            gate: of the robot.
            generation: of the halt that has frozen every body.
            given: the gate's count of permits at that halt.
            verdict: of that halt.
        """
        if not self.by_body or gate.under_way:
            # A verb of the robot's own goes on, or halts its own robot.
            return verdict
        if generation != gate.generation:
            # Another stop came meanwhile: the two are one, and the later one lets the arms settle.
            return replace(verdict, settling=bool(self.running()))
        due = [each for each in self.by_body.values() if each.take()]
        if not due or not verdict.stopped:
            return verdict
        begun = [each.begin(generation, given) for each in due]
        return replace(verdict, settling=any(begun))

    def wait(self) -> str:
        """Wait for the end of every settling under way; return a sentence on each."""
        for each in self.by_body.values():
            each.wait()
        ends = {name: each.ending() for name, each in self.by_body.items()}
        return " ".join(f"{name} {end}." for name, end in ends.items() if end)
