"""Recording a robot in the process that serves it: joints also while it stands, pictures, tasks, halts and locks."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Self

from strands_robots.contract import RolloutEvent, Unsubscribe, WorldRobot, adapt
from strands_robots.envelope import text_of
from strands_robots.policies.base import numbers
from strands_robots.recording.cameras import Frames, jpeg
from strands_robots.recording.file import STEP, Recorder
from strands_robots.utils import number

logger = logging.getLogger(__name__)

JOINTS_HZ, CAMERAS_HZ, LOOKS_HZ = 50.0, 15.0, 20.0
"""How often joints are read, pictures taken, and the gate is looked at for halts and locks."""


PATIENCE_S = 0.5
"""How long something may fail before it is told: a busy bus is a beat that is missed, not a fault."""


class RobotRecording:
    """Writes what a robot does to ``recorder`` while it is entered as a context.

    What cannot be read for half a second is told once in the log and once in the recording, as the event
    ``notRecorded``, and is asked for again at every beat; a camera that fails costs no other its picture. A beat that
    is missed is left out.

    Args:
        robot: behind the contract, or an object that :func:`~strands_robots.contract.adapt` makes fit.
        recorder: entered, made with ``joints_of_events=False``.
        device: what the robot is called in the recording.
        frames: takes its pictures; None for none.
        joints_hz: 1 to 200.
        cameras_hz: 0.1 to 60.

    Raises:
        ValidationError: a rate outside its domain, or an object that is no robot.
    """

    def __init__(
        self,
        robot: Any,
        recorder: Recorder,
        device: str,
        *,
        frames: Frames | None = None,
        joints_hz: float = JOINTS_HZ,
        cameras_hz: float = CAMERAS_HZ,
    ) -> None:
        self._robot = robot if isinstance(robot, WorldRobot) else adapt(robot)
        self._recorder = recorder
        self._device = device
        self._frames = frames
        self._ending = threading.Event()
        self.skipped: Counter[str] = Counter()
        """Beats of joints, cameras and looks at the gate that came too late, by that; told in the recording's end."""
        self._failing: dict[str, tuple[float, bool]] = {}
        self._generation = self._robot.gate.generation
        self._lock = ""
        works: list[tuple[str, float, Callable[[], None]]] = [
            ("joints", number("joints_hz", joints_hz, low=1, high=200), self._joints),
            ("gate", LOOKS_HZ, self._look),
        ]
        if frames is not None:
            works.append(("cameras", number("cameras_hz", cameras_hz, low=0.1, high=60), self._pictures))
        self._threads = [
            threading.Thread(target=partial(self._paced, name, hz, work), name=f"record-{name}", daemon=True)
            for name, hz, work in works
        ]
        self._unsubscribe: Unsubscribe = lambda: None

    def __enter__(self) -> Self:
        self._unsubscribe = self._robot.subscribe(self._tell)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._ending.set()
        for thread in self._threads:
            thread.join()
        # After the thread that looks has ended: of two looks at a time each would tell of the same halt.
        self._attempt("gate", self._look)
        self._unsubscribe()
        if self.skipped:
            self._recorder.take(self._device, "samplesSkipped", dict(self.skipped))

    def _paced(self, what: str, hz: float, work: Callable[[], None]) -> None:
        began, beat = time.monotonic(), 0
        while not self._ending.wait(max(0.0, began + beat / hz - time.monotonic())):
            self._attempt(what, work)
            due = max(beat + 1, int((time.monotonic() - began) * hz))
            if due > beat + 1:
                self.skipped[what] += due - beat - 1
            beat = due

    def _attempt(self, what: str, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as exc:  # noqa: BLE001 - a robot's read raises what it likes; the recording goes on
            self._note(what, f"{type(exc).__name__}: {exc}")
        else:
            self._failing.pop(what, None)

    def _joints(self) -> None:
        told = self._robot.get_state()
        if isinstance(self._robot, WorldRobot):
            for name, joints in (told.get("robots") or {}).items():
                self._recorder.take_joints(f"{self._device}/{name}", numbers(joints))
            return
        if told.get("joints_error"):
            raise ConnectionError(told["joints_error"])
        self._recorder.take_joints(self._device, numbers(told.get("joints") or {}))

    def _pictures(self) -> None:
        seen = self._frames() if self._frames is not None else {}
        for camera in seen:
            self._attempt(f"pictures of {camera}", partial(self._picture, seen, camera))

    def _picture(self, seen: Mapping[str, Any], camera: str) -> None:
        self._recorder.take_picture(self._device, camera, jpeg(camera, seen[camera]))

    def _look(self) -> None:
        gate = self._robot.gate
        if gate.generation != self._generation:
            self._generation = gate.generation
            self._recorder.take(self._device, "halted", {})
        refusal = gate.refusal("motion")
        lock = "" if refusal is None else text_of(refusal)
        if lock != self._lock:
            self._lock = lock
            self._recorder.take(self._device, "locked" if lock else "unlocked", {"reason": lock} if lock else {})

    def _note(self, what: str, problem: str) -> None:
        now = time.monotonic()
        since, told = self._failing.setdefault(what, (now, False))
        if told or now - since < PATIENCE_S:
            return
        self._failing[what] = (since, True)
        logger.warning("%s: its %s are not recorded: %s", self._device, what, problem)
        self._recorder.take(self._device, "notRecorded", {"what": what, "error": problem})

    def _tell(self, event: RolloutEvent) -> None:
        """Under the names and with the fields that the events of a device have on Device Connect."""
        world = isinstance(self._robot, WorldRobot)
        whose = {"robot_name": event.robot} if world else {}
        kind = "policy" if world else "task"
        if event.kind == "step":
            told = {"step": event.step, "observation": dict(event.observation), "action": dict(event.action)}
            self._recorder.take(self._device, STEP, {**told, **whose})
        elif event.kind == "started":
            told = {"instruction": event.instruction, "policy_provider": event.policy}
            self._recorder.take(self._device, f"{kind}Started", {**told, **whose})
        else:
            told = {"instruction": event.instruction, "steps": event.step, "duration": event.elapsed_s}
            told |= {"state": event.state, "error": event.error}
            self._recorder.take(self._device, f"{kind}Complete", {**told, **whose})
