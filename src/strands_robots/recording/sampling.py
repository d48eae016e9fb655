"""Recording of a robot in the process that serves it."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Self

from strands_robots.contract import RolloutEvent, Unsubscribe, behind_contract, holds_robots, observe
from strands_robots.envelope import text_of
from strands_robots.policies.base import numbers
from strands_robots.recording.cameras import Frames, jpeg
from strands_robots.recording.file import STEP, Recorder
from strands_robots.utils import number

logger = logging.getLogger(__name__)

JOINTS_HZ, CAMERAS_HZ, GATE_HZ = 50.0, 15.0, 20.0
"""Rates at which joints are read, pictures are taken, and the gate is checked for halts and locks."""

PATIENCE_S = 0.5
"""A source that fails for this long is reported; a busy bus costs a sample, it is not a fault."""


class RobotRecording:
    """Samples a robot into ``recorder`` while it is entered as a context.

    A source that cannot be read for half a second is reported once in the log and once in the recording, as the event
    ``notRecorded``, and is still read at every beat. Each camera fails on its own. A beat that is missed is left out
    and counted in the event ``samplesSkipped``.

    Args:
        robot: behind the contract, or an object that :func:`~strands_robots.contract.adapt` makes fit.
        recorder: entered, made with ``joints_of_events=False``.
        device: name of the robot in the recording.
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
        self._robot = behind_contract(robot)
        self._recorder = recorder
        self._device = device
        self._frames = frames
        self._stopping = threading.Event()
        self.skipped: Counter[str] = Counter()
        """Beats that came too late, by source: joints, cameras, gate."""
        self._failing: dict[str, tuple[float, bool]] = {}
        self._generation = self._robot.gate.generation
        self._lock = ""
        sources: list[tuple[str, float, Callable[[], None]]] = [
            ("joints", number("joints_hz", joints_hz, low=1, high=200), self._sample_joints),
            ("gate", GATE_HZ, self._check_gate),
        ]
        if frames is not None:
            hz = number("cameras_hz", cameras_hz, low=0.1, high=60)
            sources.append(("cameras", hz, self._sample_pictures))
        self._threads = [
            threading.Thread(target=self._paced, args=source, name=f"record-{source[0]}", daemon=True)
            for source in sources
        ]
        self._unsubscribe: Unsubscribe = lambda: None

    def __enter__(self) -> Self:
        self._unsubscribe = observe(self._robot, self._record)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        # The gate's own thread has ended; two checks at a time would record the same halt twice.
        self._attempt("gate", self._check_gate)
        self._unsubscribe()
        if self.skipped:
            self._take("samplesSkipped", dict(self.skipped))

    def _take(self, event: str, payload: Mapping[str, Any]) -> None:
        self._recorder.take(self._device, event, payload)

    def _paced(self, source: str, hz: float, sample: Callable[[], None]) -> None:
        started, beat = time.monotonic(), 0
        while not self._stopping.wait(max(0.0, started + beat / hz - time.monotonic())):
            self._attempt(source, sample)
            due = max(beat + 1, int((time.monotonic() - started) * hz))
            if due > beat + 1:
                self.skipped[source] += due - beat - 1
            beat = due

    def _attempt(self, source: str, sample: Callable[[], None]) -> None:
        try:
            sample()
        except Exception as exc:  # noqa: BLE001 - a robot's read may raise anything; the recording goes on
            self._report(source, f"{type(exc).__name__}: {exc}")
        else:
            self._failing.pop(source, None)

    def _report(self, source: str, problem: str) -> None:
        now = time.monotonic()
        since, reported = self._failing.setdefault(source, (now, False))
        if reported or now - since < PATIENCE_S:
            return
        self._failing[source] = (since, True)
        logger.warning("%s: its %s are not recorded: %s", self._device, source, problem)
        self._take("notRecorded", {"what": source, "error": problem})

    def _sample_joints(self) -> None:
        state = self._robot.get_state()
        if holds_robots(self._robot):
            for name, joints in (state.get("robots") or {}).items():
                self._recorder.take_joints(f"{self._device}/{name}", numbers(joints))
            return
        if state.get("joints_error"):
            raise ConnectionError(state["joints_error"])
        self._recorder.take_joints(self._device, numbers(state.get("joints") or {}))

    def _sample_pictures(self) -> None:
        frames = self._frames() if self._frames is not None else {}
        for camera in frames:
            self._attempt(f"pictures of {camera}", partial(self._take_picture, frames, camera))

    def _take_picture(self, frames: Mapping[str, Any], camera: str) -> None:
        self._recorder.take_picture(self._device, camera, jpeg(camera, frames[camera]))

    def _check_gate(self) -> None:
        gate = self._robot.gate
        if gate.generation != self._generation:
            self._generation = gate.generation
            self._take("halted", {})
        refusal = gate.refusal("motion")
        lock = "" if refusal is None else text_of(refusal)
        if lock != self._lock:
            self._lock = lock
            self._take("locked" if lock else "unlocked", {"reason": lock} if lock else {})

    def _record(self, event: RolloutEvent) -> None:
        """Record a rollout's event with its name and fields on Device Connect."""
        world = holds_robots(self._robot)
        robot = {"robot_name": event.robot} if world else {}
        kind = "policy" if world else "task"
        if event.kind == "step":
            step = {"step": event.step, "observation": dict(event.observation), "action": dict(event.action)}
            self._take(STEP, {**step, **robot})
        elif event.kind == "started":
            self._take(f"{kind}Started", {"instruction": event.instruction, "policy_provider": event.policy, **robot})
        else:
            end = {"instruction": event.instruction, "steps": event.step, "duration": event.elapsed_s}
            loop = {"loop": dict(event.loop)} if event.loop else {}
            self._take(f"{kind}Complete", {**end, "state": event.state, "error": event.error, **loop, **robot})
