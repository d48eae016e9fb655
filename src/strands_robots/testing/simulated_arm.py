"""Simulated arm without physics, light enough for fifty in a process."""

from __future__ import annotations

import math
import threading
import time
from typing import Annotated, Literal

from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import Permit
from strands_robots.utils import DURATION_MAX_S, ValidationError, number
from strands_robots.verb_declaration import verb
from strands_robots.verb_parameters import Domain

JOINTS = ("pan", "lift", "elbow")
RANGE_DEG, SPEED_DEG_S, STEP_S = 90.0, 30.0, 0.02
SWAY_DEG, SWAY_S = 20.0, 4.0
"""Width and period of the motion of a task."""


class SimulatedArm:
    """Three joints that move by the clock, without a thread.

    A task sways all of them until it is stopped or its time is over; the verb ``turn`` turns one. The simulation is
    of a robot as its callers see it, not of physics.

    Args:
        name: its id.
    """

    def __init__(self, name: str) -> None:
        self.tool_name_str = name
        self._lock = threading.Lock()
        self._at = dict.fromkeys(JOINTS, 0.0)
        self._instruction, self._began, self._ends = "", 0.0, 0.0
        self._turning = ""
        self._outcome = "idle"
        self.obeys = True
        """False where a stop does not end its motion."""

        self.stop_answer: Envelope | None = None
        """Answer of a stop that does not end its motion."""

        self.stop_takes_s = 0.0
        """Seconds until a stop is answered."""

    @property
    def moving(self) -> bool:
        """True while it moves, whatever it says."""
        return bool(self._turning) or time.monotonic() < self._ends

    @property
    def joints(self) -> dict[str, float]:
        """Positions in degrees now."""
        with self._lock:
            return self._positions(time.monotonic())

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Sway for ``duration`` seconds."""
        try:
            seconds = number("duration", duration, above=0, high=DURATION_MAX_S)
        except ValidationError as refused:
            return error(str(refused))
        with self._lock:
            if self.moving:
                return error(f"It is busy: {self._instruction or 'turn'}.")
            now = time.monotonic()
            self._at = self._positions(now)
            self._instruction, self._began, self._ends, self._outcome = instruction, now, now + seconds, "completed"
        return success(f"Started {instruction!r}.")

    def stop_task(self) -> Envelope:
        """End its motion, and say so."""
        if self.obeys:
            self._end("stopped")
        if self.stop_takes_s:
            time.sleep(self.stop_takes_s)
        if self.obeys:
            return success("It stands.", stopped=True)
        return self.stop_answer or error("It moves on.", stopped=False)

    def get_task_status(self) -> Envelope:
        """Return what it does."""
        state = "running" if self.moving else self._outcome
        return success(state, task_status=state, instruction=self._instruction)

    def get_features(self) -> Envelope:
        """Return its joints as data."""
        features = dict.fromkeys(JOINTS, "float")
        return success("Three joints.", observation_features=features, action_features=features)

    def get_state(self) -> Envelope:
        """Return its joints in degrees."""
        return success("Three joints.", joints=self.joints)

    @verb(motion=True, lasts=10.0)
    def turn(
        self,
        joint: Literal["pan", "lift", "elbow"],
        degrees: Annotated[float, Domain(-RANGE_DEG, RANGE_DEG, "deg")],
        permit: Permit,
    ) -> dict[str, float]:
        """Turn a joint to an angle.

        Args:
            joint: pan, lift or elbow
            degrees: where it ends
        """
        self._turning = joint
        try:
            while (permit.valid or not self.obeys) and (left := degrees - self._at[joint]):
                step = min(abs(left), SPEED_DEG_S * STEP_S)
                self._at[joint] += step if left > 0 else -step
                time.sleep(STEP_S)
        finally:
            self._turning = ""
        return {"degrees": round(self._at[joint], 3)}

    def end(self) -> None:
        """End its motion, whatever its faults are."""
        self.obeys, self.stop_takes_s = True, 0.0
        self._end("stopped")

    def _end(self, outcome: str) -> None:
        with self._lock:
            now = time.monotonic()
            if now < self._ends:
                self._ends, self._outcome = now, outcome

    def _positions(self, now: float) -> dict[str, float]:
        """Return the positions at a moment; a task sways each joint."""
        swaying_s = max(0.0, min(now, self._ends) - self._began)
        sway = SWAY_DEG * math.sin(2 * math.pi * swaying_s / SWAY_S)
        return {joint: at + sway for joint, at in self._at.items()}
