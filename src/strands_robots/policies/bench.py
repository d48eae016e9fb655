"""The loop of a profile's policy on a still body, measured against its budget."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from strands_robots.contract import RolloutEvent
from strands_robots.policies import create_policy
from strands_robots.policies.base import Action, PolicyError, Ranges
from strands_robots.policies.check import RobotFacts, statements_of
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import Profile
from strands_robots.policies.rollout import Rollout, RolloutObservers
from strands_robots.safety.gate import MotionGate, Permit

PERIODS_MAX = 1.1
"""A control step may be late by a tenth of its period, p99."""

PICTURE = (480, 640)
"""Height and width of the pictures of a camera whose profile states no size."""


@dataclass(frozen=True)
class BenchRow:
    """One figure and its budget."""

    what: str
    measured: str
    budget: str
    kept: bool


@dataclass(frozen=True)
class BenchResult:
    """All rows, and the figures of the loop by name."""

    rows: tuple[BenchRow, ...]
    loop: Mapping[str, float]

    @property
    def kept(self) -> bool:
        """True when every budget was kept."""
        return all(row.kept for row in self.rows)


class StillBody:
    """Body of a profile's keys that stands still, and notes each look and each write."""

    name = "bench"
    speeds: Mapping[str, float] = {}

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._joints = dict.fromkeys((*profile.state, *profile.environment, *profile.action), 0.0)
        for each in statements_of(profile):
            if each.state_range is not None and len(each.state_range.low) == len(profile.state):
                # In the middle of the data, or the check refuses to begin.
                middle = [
                    (low + high) / 2 for low, high in zip(each.state_range.low, each.state_range.high, strict=True)
                ]
                self._joints |= dict(zip(profile.state, middle, strict=True))
        self._pictures: dict[str, Any] = {}
        if profile.cameras:
            numpy = import_module("numpy")
            for camera in profile.cameras:
                self._pictures[camera.camera] = numpy.zeros((*(camera.size or PICTURE), 3), numpy.uint8)
        self.observed: list[float] = []
        self.written: list[float] = []

    @property
    def bounds(self) -> Ranges:
        return dict.fromkeys(self._profile.action, (-1e9, 1e9))

    def get_observation(self) -> dict[str, Any]:
        return {**self.get_joints(), **self._pictures}

    def get_joints(self) -> dict[str, float]:
        self.observed.append(time.perf_counter())
        return dict(self._joints)

    def send_action(self, action: Action, permit: Permit) -> Mapping[str, Any]:
        permit.check()
        self.written.append(time.perf_counter())
        return action

    def hold(self, permit: Permit | None = None) -> None:
        """Do nothing: this body stands still."""

    def running(self) -> AbstractContextManager[None]:
        return nullcontext()

    def facts(self, hz: float) -> RobotFacts:
        """Return facts that fit the profile."""
        units = {key: unit for key in self._joints if (unit := self._profile.unit(key)) is not None}
        sizes = {each.camera: (*self._pictures[each.camera].shape[:2], 3) for each in self._profile.cameras}
        return RobotFacts(self.name, dict(self._joints), list(self._profile.action), units, sizes, hz)


def measure(profile: Profile, hz: float, seconds: float) -> BenchResult:
    """Run the loop of a profile at ``hz`` for some seconds.

    Raises:
        ValidationError: the profile contradicts its checkpoint or its server.
        PolicyError: the policy could not be loaded, or failed.
    """
    policy = create_policy(profile.name)
    assert isinstance(policy, ProfiledPolicy)
    body = StillBody(profile)
    began = time.monotonic()
    policy.load(body.facts(hz), profile.first_deadline_s)
    loaded_s = time.monotonic() - began
    finished: list[RolloutEvent] = []
    observers = RolloutObservers()
    observers.subscribe(lambda event: finished.append(event) if event.kind == "finished" else None)
    rollout = Rollout(
        body,
        policy,
        permit=MotionGate().permit("bench"),
        instruction="bench",
        duration=seconds,
        hz=hz,
        observers=observers,
        policy_name=profile.name,
    )
    body.observed.clear()
    rollout.run()
    if rollout.error:
        raise PolicyError(rollout.error)
    return BenchResult(_rows(profile, hz, loaded_s, body.observed, finished[0].loop), finished[0].loop)


def _rows(
    profile: Profile, hz: float, loaded_s: float, observed: list[float], loop: Mapping[str, float]
) -> tuple[BenchRow, ...]:
    period_ms = 1000 / hz
    gaps = sorted(1000 * (after - before) for before, after in itertools.pairwise(observed)) or [0.0]
    p99 = gaps[int(0.99 * (len(gaps) - 1))]
    steps = profile.horizon or profile.chunk
    budget_ms = 1000 * steps / (profile.rate or hz) if steps else 1000 * profile.deadline_s
    latency, late, dry = loop.get("latency_p99_ms", 0.0), PERIODS_MAX * period_ms, int(loop.get("underruns", 0))
    return (
        BenchRow(
            "until ready", f"{loaded_s:.1f} s", f"{profile.first_deadline_s:g} s", loaded_s <= profile.first_deadline_s
        ),
        BenchRow(
            f"latency, {loop.get('inferences', 0):g} answers",
            f"p50 {loop.get('latency_p50_ms', 0.0):.0f} ms, p99 {latency:.0f} ms",
            f"{budget_ms:.0f} ms, {'the steps that are played' if steps else 'deadline_s'}",
            latency <= budget_ms,
        ),
        BenchRow("age of a chunk", f"at most {1000 * loop.get('chunk_age_max_s', 0.0):.0f} ms", "", True),
        BenchRow("underruns", f"{dry} ({loop.get('underrun_steps', 0):g} steps)", "0", dry == 0),
        BenchRow(
            f"control period, {len(gaps)} steps",
            f"p99 {p99:.1f} ms, worst {gaps[-1]:.1f} ms",
            f"{late:.1f} ms",
            p99 <= late,
        ),
        BenchRow("speed-limited steps", f"{loop.get('speed_limited_steps', 0):g}", "", True),
        BenchRow("out of range", f"{loop.get('out_of_range_steps', 0):g}", "", True),
    )
