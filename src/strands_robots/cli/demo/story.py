"""The steps of the demo: each does one thing, checks that it happened, and shows it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from strands_robots.cli.bars import joints_table, progress, ranges
from strands_robots.cli.demo.agent import Agent, Event, Stream
from strands_robots.cli.demo.child import Child
from strands_robots.cli.demo.show import Show
from strands_robots.cli.output import Failure, table
from strands_robots.device_connect.telemetry import numbers

NEEDED = ("execute", "stop", "getStatus", "getFeatures")

MOTION_S = 4.0
"""Length of the motion that runs to its end."""

MOVED_RAD = 0.05
"""A joint that travelled this far has moved."""

BRAKE_S, BRAKE_RAD = 0.2, 0.1
"""Time and travel in which a stopped arm has to have come to rest: it has mass."""

WATCH_S, STILL_RAD = 1.0, 0.005
"""After that no joint may move more than this in that many seconds; a held arm sags a little under gravity."""

Joints = dict[str, float]


@dataclass(slots=True)
class Report:
    """What happened, for ``--json``."""

    steps: list[dict[str, Any]] = field(default_factory=list)
    path: list[tuple[float, Joints]] = field(default_factory=list)
    stop_ms: float = 0.0
    files: list[str] = field(default_factory=list)

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Note that ``name`` happened, or the reason why it did not."""
        row: dict[str, Any] = {"step": name, "ok": False}
        self.steps.append(row)
        started = time.monotonic()
        try:
            yield row
            row["ok"] = True
        except Failure as failure:
            row["reason"] = failure.reason
            raise
        finally:
            row["seconds"] = round(time.monotonic() - started, 3)


class Story:
    """Discovery, functions, a motion, a stop in mid-motion.

    Args:
        show: where it is told.
        agent: who drives.
        child: the process that serves the robot.
        peer_id: the robot.
        report: where each step is noted.
    """

    def __init__(self, show: Show, agent: Agent, child: Child, peer_id: str, report: Report) -> None:
        self.report = report
        self._show = show
        self._agent = agent
        self._child = child
        self._peer = peer_id
        self._limits: dict[str, tuple[float, float]] = {}

    def discover(self) -> None:
        """The agent finds the robot and reads what it can do."""
        self._show.head("The agent looks who is there")
        with self.report.step("discover") as row:
            started = time.monotonic()
            device = self._agent.discover(self._peer)
            row["discovered_ms"] = round((time.monotonic() - started) * 1000, 1)
            functions = {str(each.get("name")): each for each in device.get("functions", []) if isinstance(each, dict)}
            missing = [name for name in NEEDED if name not in functions]
            if missing:
                raise Failure(f"{self._peer} was found, but without {', '.join(missing)}.")
            row["functions"] = sorted(functions)
        self._show.done(f"Found {self._peer} ({device.get('device_type', '')}) at {self._agent.endpoint}")
        rows = ((name, _first(str(each.get("description", "")))) for name, each in functions.items())
        self._show.panel(table("What the agent can call", ("function", "description"), rows))

    def drive(self) -> None:
        """A motion that runs to its end, followed by events."""
        self._show.head("It starts a motion and follows it by events")
        with self.report.step("execute") as row, self._agent.events(self._peer) as stream:
            self._limits = ranges(self._agent.call(self._peer, "getFeatures"))
            row["steps"], row["travelled_rad"] = self.to_the_end(stream, "wave hello", MOTION_S)
        travelled = row["travelled_rad"]
        self._show.done(f"execute ran to its end: {row['steps']} steps, the joints travelled up to {travelled:.2f} rad")

    def stop(self) -> None:
        """A stop in mid-motion, its latency, and whether the arm stands still afterwards."""
        self._show.head("It starts another one and stops it in mid-motion")
        with self.report.step("stop") as row, self._agent.events(self._peer) as stream:
            self.set_off(stream, "keep waving", 2.0)
            started = time.perf_counter()
            verdict = self._agent.call(self._peer, "stop")
            self.report.stop_ms = row["latency_ms"] = round((time.perf_counter() - started) * 1000, 2)
            row["stopped"] = verdict.get("stopped")
            if not verdict.get("stopped") or verdict.get("not_stopped"):
                raise Failure(f"stop was answered, but nothing says that the arm stopped: {verdict}")
            row["braking_rad"], row["drift_rad"] = self.rest(stream)
        self._show.done(
            f"stop answered in {row['latency_ms']:.1f} ms; the arm came to rest within "
            f"{row['braking_rad']:.3f} rad and then stood still: {row['drift_rad']:.4f} rad in {WATCH_S:g} s"
        )

    def to_the_end(self, stream: Stream, title: str, seconds: float) -> tuple[int, float]:
        """A motion that completes; its steps, and how far the busiest joint travelled (rad).

        Raises:
            Failure: it was refused, did not end, ended otherwise, or nothing moved.
        """
        before = len(self.report.path)
        self._agent.call(self._peer, "execute", instruction=title, policy_provider="mock", duration=seconds)
        until = seconds + 6.0
        ended = self._follow(stream, title, until, lambda event: event.name == "policyComplete", total=seconds)
        if ended is None:
            raise Failure("The motion did not report its end.")
        state = ended.payload.get("state")
        if state != "completed":
            raise Failure(f"The motion ended as {state}: {ended.payload.get('error', '')}")
        return int(ended.payload.get("steps") or 0), self._travelled(self.report.path[before:])

    def set_off(self, stream: Stream, title: str, seconds: float) -> None:
        """A motion of a minute, left in the middle after ``seconds``. Raises :class:`Failure` when nothing moved."""
        before = len(self.report.path)
        self._agent.call(self._peer, "execute", instruction=title, policy_provider="mock", duration=60.0)
        self._follow(stream, title, seconds, lambda event: False, total=60.0)
        self._travelled(self.report.path[before:])

    def _follow(
        self, stream: Stream, title: str, within: float, until: Callable[[Event], bool], total: float
    ) -> Event | None:
        """Draw what happens until ``until`` or for ``within`` seconds; joints go into the report's path."""
        started = time.monotonic()
        with self._show.live() as frame:
            for event in stream.follow(within):
                joints = _joints(event)
                if joints:
                    self.report.path.append((event.at, joints))
                    frame(progress(title, event.at - started, total), joints_table(joints, self._limits))
                if until(event):
                    return event
                self._child.check()
        return None

    def _travelled(self, path: list[tuple[float, Joints]]) -> float:
        """How far the busiest joint travelled. Raises :class:`Failure` when none moved."""
        names = {name for _, joints in path for name in joints}
        spans = [_span([joints[name] for _, joints in path if name in joints]) for name in names]
        most = max(spans, default=0.0)
        if most < MOVED_RAD:
            raise Failure(f"The arm did not move: its busiest joint travelled {most:.3f} rad.")
        return round(most, 4)

    def rest(self, stream: Stream) -> tuple[float, float]:
        """How far the arm went while braking, and how far it moved afterwards, in rad of its busiest joint.

        Raises:
            Failure: it did not come to rest, or told too little to say.
        """
        at_stop = self._robot_joints()
        for _ in stream.follow(BRAKE_S):
            continue
        seen = [self._robot_joints()]
        seen += [_joints(event) for event in stream.follow(WATCH_S) if event.name == "observationUpdate"]
        seen = [joints for joints in [*seen, self._robot_joints()] if joints]
        if len(seen) < 3 or not at_stop:
            raise Failure("After the stop the robot told too little to say that it stands still.")
        braking = max(abs(seen[0].get(name, value) - value) for name, value in at_stop.items())
        if braking > BRAKE_RAD:
            raise Failure(f"The arm went on after its stop: {braking:.3f} rad in {BRAKE_S:g} s.")
        drift = max(_span([joints[name] for joints in seen if name in joints]) for name in seen[0])
        if drift > STILL_RAD:
            raise Failure(f"The arm moved on after its stop: {drift:.3f} rad in {WATCH_S:g} s.")
        return round(braking, 5), round(drift, 5)

    def _robot_joints(self) -> Joints:
        robots = self._agent.call(self._peer, "getStatus").get("robots")
        return numbers(next(iter(robots.values()), {})) if isinstance(robots, dict) else {}


def _joints(event: Event) -> Joints:
    if event.name == "observationUpdate":
        return numbers(event.payload.get("joints"))
    return numbers(event.payload.get("observation")) if event.name == "streamStep" else {}


def _span(values: list[float]) -> float:
    return max(values) - min(values) if values else 0.0


def _first(description: str) -> str:
    return description.strip().partition("\n")[0]
