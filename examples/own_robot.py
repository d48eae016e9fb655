"""A robot of your own that knows tasks alone: give it four methods, and agents find it, start it and stop it.

It counts as real hardware: it moves only for callers that you allow, and only with your approval::

    DEVICE_CONNECT_RPC_ALLOW=strands-robots STRANDS_ROBOT_COMMAND_ALLOW=execute .venv/bin/python examples/own_robot.py
    strands-robots call turntable execute instruction=turn duration=5              # in another terminal
"""

from __future__ import annotations

import sys
import threading
import time

from strands_robots.envelope import Envelope, error, success
from strands_robots.robot import run

STEP_S, STEP_DEG = 0.02, 0.6


class Turntable:
    """Turns for as long as its task lasts. Put your own motor where the angle is."""

    tool_name_str = "turntable"

    def __init__(self) -> None:
        self._angle_deg, self._steps, self._instruction = 0.0, 0, ""
        self._lock, self._asked_to_stop, self._still = threading.Lock(), threading.Event(), threading.Event()
        self._still.set()

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        if not 0 < duration <= 3600:  # nor is NaN
            return error(f"duration must be above 0 and at most 3600 s, not {duration}.")
        with self._lock:
            if not self._still.is_set():
                return error("The turntable turns already; stop it first.")
            self._still.clear()
            self._asked_to_stop.clear()
            self._instruction, self._steps = instruction, 0
        threading.Thread(target=self._turn, args=(duration,), daemon=True).start()
        return success(f"Turning for {duration:g} s.")  # a start returns at once

    def stop_task(self) -> Envelope:
        with self._lock:
            self._asked_to_stop.set()
        if self._still.wait(0.5):  # a success says that nothing is written any more
            return success("The turntable stands.", stopped=True)
        return error("The turntable may still turn.", stopped=False)

    def get_task_status(self) -> Envelope:
        state = "idle" if self._still.is_set() else "running"
        return success(state, task_status=state, instruction=self._instruction, step_count=self._steps)

    def get_features(self) -> Envelope:
        return success("One axis.", observation_features={"angle": "float"}, action_features={"angle": "float"})

    def get_state(self) -> Envelope:
        """Not one of the four: it lets `watch` show the angle."""
        return success("One axis.", joints={"angle": self._angle_deg})

    def _turn(self, duration: float) -> None:
        ends = time.monotonic() + duration
        try:
            while time.monotonic() < ends and not self._asked_to_stop.wait(STEP_S):
                self._angle_deg, self._steps = (self._angle_deg + STEP_DEG) % 360, self._steps + 1
        finally:  # also when the motor raises: it stands then, and can be started again
            self._still.set()


if __name__ == "__main__":
    sys.exit(0 if run(Turntable(), peer_id="turntable").stopped else 1)
