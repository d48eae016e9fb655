"""Steps of the demo: each does one thing, checks that it happened, and prints it."""

from __future__ import annotations

import secrets
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.audit import verify_audit_integrity
from strands_robots.cli.demo.output import DemoScreen
from strands_robots.cli.demo.processes import Agent, AgentEvent, EventStream, RobotProcess
from strands_robots.cli.output import CliError, first_line, label, plain, table
from strands_robots.cli.watch import joint_limits, joints_table, motion_progress
from strands_robots.device_connect.telemetry import numbers
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.ed25519 import keygen, load_signing_key
from strands_robots.safety.resume import sign

NEEDED = ("execute", "stop", "getStatus", "getFeatures")
CONTROLLER = "demo-safety"

MOTION_S = 4.0
MOTION_AGAIN_S = 2.0
"""Seconds of the two motions that run to their end."""

MOVED_RAD = 0.05
"""Travel of a joint that counts as a motion."""

BRAKE_S, BRAKE_RAD = 0.2, 0.1
"""Time and travel in which a stopped arm has to come to rest: it has mass."""

WATCH_S, STILL_RAD = 1.0, 0.005
"""Largest travel of a joint in that many seconds after braking; a held arm sags a little under gravity."""

ESTOP_DEADLINE_S = 3.0

Joints = dict[str, float]


@dataclass(slots=True)
class DemoReport:
    """Steps and results of one demo, for ``--json``."""

    steps: list[dict[str, Any]] = field(default_factory=list)
    path: list[tuple[float, Joints]] = field(default_factory=list)
    stop_ms: float = 0.0
    files: list[str] = field(default_factory=list)

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Record that the step ``name`` happened, or why it did not."""
        row: dict[str, Any] = {"step": name, "ok": False}
        self.steps.append(row)
        started = time.monotonic()
        try:
            yield row
            row["ok"] = True
        except CliError as failure:
            row["reason"] = failure.reason
            raise
        finally:
            row["seconds"] = round(time.monotonic() - started, 3)


@contextmanager
def demo_operator() -> Iterator[Any]:
    """Yield an operator's key for this demo; the robot gets its public half.

    Robot and audit get a state folder of their own, so that no demo finds the lockout of an earlier one.
    """
    with tempfile.TemporaryDirectory(prefix="strands-demo-") as folder:
        key, passphrase = Path(folder) / "operator.pem", f"Demo-{secrets.token_hex(16)}"
        settings.put("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(key, passphrase))
        settings.put("STRANDS_STATE_DIR", folder)
        settings.put("STRANDS_MESH_AUDIT_DIR", "")
        # A safety controller of the user's own takes no part.
        settings.put("DEVICE_CONNECT_ESTOP_ALLOW", CONTROLLER)
        settings.put("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "")
        settings.put("STRANDS_CHECKIN_TIMEOUT_S", "0")
        yield load_signing_key(key, passphrase)


class DriveSteps:
    """First steps: discovery, a motion, a stop in mid-motion.

    Args:
        screen: where it is printed.
        agent: drives the robot.
        process: serves the robot.
        peer_id: the robot.
        report: records each step.
    """

    def __init__(
        self, screen: DemoScreen, agent: Agent, process: RobotProcess, peer_id: str, report: DemoReport
    ) -> None:
        self.report = report
        self._screen = screen
        self._agent = agent
        self._process = process
        self._peer = peer_id
        self._limits: dict[str, tuple[float, float]] = {}

    def discover(self) -> None:
        """Find the robot and read its functions."""
        self._screen.head("The agent looks for robots")
        with self.report.step("discover") as row:
            started = time.monotonic()
            device = self._agent.discover(self._peer)
            row["discovered_ms"] = round((time.monotonic() - started) * 1000, 1)
            functions = {str(each.get("name")): each for each in device.get("functions", []) if isinstance(each, dict)}
            missing = [name for name in NEEDED if name not in functions]
            if missing:
                raise CliError(f"{self._peer} was found, but without {', '.join(missing)}.")
            row["functions"] = sorted(functions)
        self._screen.done(f"Found {self._peer} ({device.get('device_type', '')}) at {self._agent.endpoint}")
        rows = ((name, first_line(each.get("description"))) for name, each in functions.items())
        self._screen.panel(table("What the agent can call", ("function", "description"), rows))

    def drive(self) -> None:
        """Start a motion and follow its events until it ends."""
        self._screen.head("It starts a motion and follows it by events")
        with self.report.step("execute") as row, self._agent.events(self._peer) as stream:
            self._limits = joint_limits(self._agent.call(self._peer, "getFeatures"))
            row["steps"], row["travelled_rad"] = self.run_motion(stream, "wave hello", MOTION_S)
        travelled = row["travelled_rad"]
        self._screen.done(
            f"execute ran to its end: {row['steps']} steps, the joints travelled up to {travelled:.2f} rad"
        )

    def stop(self) -> None:
        """Stop a motion; measure the latency and check that the arm stands still."""
        self._screen.head("It starts another one and stops it in mid-motion")
        with self.report.step("stop") as row, self._agent.events(self._peer) as stream:
            self.start_motion(stream, "keep waving", 2.0)
            started = time.perf_counter()
            verdict = self._agent.call(self._peer, "stop")
            self.report.stop_ms = row["latency_ms"] = round((time.perf_counter() - started) * 1000, 2)
            row["stopped"] = verdict.get("stopped")
            if not verdict.get("stopped") or verdict.get("not_stopped"):
                raise CliError(f"stop was answered, but nothing says that the arm stopped: {verdict}")
            row["braking_rad"], row["drift_rad"] = self.measure_rest(stream)
        self._screen.done(
            f"stop answered in {row['latency_ms']:.1f} ms; the arm came to rest within "
            f"{row['braking_rad']:.3f} rad and then stood still: {row['drift_rad']:.4f} rad in {WATCH_S:g} s"
        )

    def run_motion(self, stream: EventStream, title: str, seconds: float) -> tuple[int, float]:
        """Run a motion to its end; return its steps and largest joint travel (rad).

        Raises:
            CliError: it was refused, did not end, ended otherwise, or nothing moved.
        """
        before = len(self.report.path)
        self._agent.call(self._peer, "execute", instruction=title, policy_provider="mock", duration=seconds)
        until = seconds + 6.0
        ended = self._follow(stream, title, until, lambda event: event.name == "policyComplete", total=seconds)
        if ended is None:
            raise CliError("The motion did not report its end.")
        state = ended.payload.get("state")
        if state != "completed":
            raise CliError(f"The motion ended as {state}: {ended.payload.get('error', '')}")
        return int(ended.payload.get("steps") or 0), self._travelled(self.report.path[before:])

    def start_motion(self, stream: EventStream, title: str, seconds: float) -> None:
        """Start a motion of a minute and return after ``seconds`` of movement."""
        before = len(self.report.path)
        self._agent.call(self._peer, "execute", instruction=title, policy_provider="mock", duration=60.0)
        self._follow(stream, title, seconds, lambda event: False, total=60.0)
        self._travelled(self.report.path[before:])

    def _follow(
        self, stream: EventStream, title: str, within: float, until: Callable[[AgentEvent], bool], total: float
    ) -> AgentEvent | None:
        """Draw events until ``until`` or for ``within`` s; add joints to the path."""
        started = time.monotonic()
        with self._screen.live() as frame:
            for event in stream.follow(within):
                joints = _joints(event)
                if joints:
                    self.report.path.append((event.at, joints))
                    frame(motion_progress(title, event.at - started, total), joints_table(joints, self._limits))
                if until(event):
                    return event
                self._process.check()
        return None

    def _travelled(self, path: list[tuple[float, Joints]]) -> float:
        """Return the largest joint travel (rad); raise :class:`CliError` for none."""
        names = {name for _, joints in path for name in joints}
        spans = [_span([joints[name] for _, joints in path if name in joints]) for name in names]
        most = max(spans, default=0.0)
        if most < MOVED_RAD:
            raise CliError(f"The arm did not move: its busiest joint travelled {most:.3f} rad.")
        return round(most, 4)

    def measure_rest(self, stream: EventStream) -> tuple[float, float]:
        """Return the travel while braking and after it, in rad of the busiest joint.

        Raises:
            CliError: it did not come to rest, or reported too little to decide.
        """
        at_stop = self._robot_joints()
        for _ in stream.follow(BRAKE_S):
            continue
        seen = [self._robot_joints()]
        seen += [_joints(event) for event in stream.follow(WATCH_S) if event.name == "observationUpdate"]
        seen = [joints for joints in [*seen, self._robot_joints()] if joints]
        if len(seen) < 3 or not at_stop:
            raise CliError("After the stop the robot reported too little to show that it stands still.")
        braking = max(abs(seen[0].get(name, value) - value) for name, value in at_stop.items())
        if braking > BRAKE_RAD:
            raise CliError(f"The arm went on after its stop: {braking:.3f} rad in {BRAKE_S:g} s.")
        drift = max(_span([joints[name] for joints in seen if name in joints]) for name in seen[0])
        if drift > STILL_RAD:
            raise CliError(f"The arm moved on after its stop: {drift:.3f} rad in {WATCH_S:g} s.")
        return round(braking, 5), round(drift, 5)

    def _robot_joints(self) -> Joints:
        robots = self._agent.call(self._peer, "getStatus").get("robots")
        return numbers(next(iter(robots.values()), {})) if isinstance(robots, dict) else {}


class SafetySteps:
    """Last steps: an emergency stop, a refusal, a signed resume, a motion again.

    Args:
        screen: where it is printed.
        agent: drives the robot.
        motions: start and measure the motions.
        peer_id: the robot.
        controller: sends the emergency stop on a connection of its own.
        key: the operator's.
    """

    def __init__(
        self,
        screen: DemoScreen,
        agent: Agent,
        motions: DriveSteps,
        *,
        peer_id: str,
        controller: SafetyController,
        key: Any,
    ) -> None:
        self._screen, self._agent, self._motions, self._peer = screen, agent, motions, peer_id
        self._controller, self._key = controller, key
        self._report = motions.report
        self._estop_id = ""

    @property
    def steps(self) -> tuple[Callable[[], None], ...]:
        """Return the steps in order."""
        return self.emergency_stop, self.refuse, self.resume, self.move_again

    def emergency_stop(self) -> None:
        """Stop the arm in mid-motion by a safety controller."""
        self._screen.head("It moves once more, and a safety controller stops everything")
        with self._report.step("emergency stop") as row, self._agent.events(self._peer) as stream:
            self._motions.start_motion(stream, "wave on", 1.2)
            report = self._controller.stop([self._peer], "demonstration", deadline_s=ESTOP_DEADLINE_S)
            if not report.ok:
                raise CliError(f"{self._peer} did not answer the emergency stop with a stop: {report}")
            answer = report.stopped[self._peer]
            self._estop_id = row["estop_id"] = report.estop_id
            row["latency_ms"], row["halt_ms"] = round(answer.latency_ms, 2), answer.facts.get("elapsed_ms")
            row["braking_rad"], row["drift_rad"] = self._motions.measure_rest(stream)
        self._screen.done(
            f"{self._peer} halted {row['halt_ms']} ms after receiving {CONTROLLER}'s stop, and answered with its "
            f"lockout on disk in {row['latency_ms']:.1f} ms; {row['drift_rad']:.4f} rad in {WATCH_S:g} s after that"
        )

    def refuse(self) -> None:
        """Check that the next motion is refused, naming the stop and the resume."""
        self._screen.head("The agent tries to go on")
        with self._report.step("refusal") as row:
            answer = self._agent.ask(self._peer, "execute", instruction="go on", policy_provider="mock", duration=1.0)
            row["reason"] = str(answer.get("reason", ""))
            if answer.get("status") != "error" or self._estop_id not in row["reason"]:
                raise CliError(f"A locked arm did not refuse a motion with the id of its stop: {answer}")
            if CONTROLLER not in row["reason"]:
                raise CliError(f"The refusal does not say who stopped the arm: {row['reason']}")
        self._screen.panel(label(plain(row["reason"], 1000), "red"))
        self._screen.done("the motion was refused, and the stop named")

    def resume(self) -> None:
        """Free the arm by the operator's signature; it does not move."""
        self._screen.head("The operator signs a resume")
        with self._report.step("resume") as row:
            (assertion,) = sign(self._key, self._estop_id, [self._peer])
            answer = self._agent.call(self._peer, "resume", assertion=assertion)
            status = self._agent.call(self._peer, "getStatus")
            if answer.get("locked") is not False or status.get("locked") is not False:
                raise CliError(f"{self._peer} is still locked after the operator's resume: {answer}")
            if status.get("running_policies"):
                raise CliError(f"A resume started a motion: {status['running_policies']}")
            row["epochs"] = answer.get("epochs")
        self._screen.done(f"the key made for this demo freed {self._peer}; nothing moves by it")

    def move_again(self) -> None:
        """Run a motion to its end and verify the safety audit."""
        self._screen.head("And the agent drives again")
        with self._report.step("execute again") as row, self._agent.events(self._peer) as stream:
            row["steps"], row["travelled_rad"] = self._motions.run_motion(stream, "wave goodbye", MOTION_AGAIN_S)
            audit = verify_audit_integrity()
            row["audit_records"] = audit["total"]
            if not audit["ok"] or audit["total"] < 2:
                raise CliError(f"The safety audit does not record what happened: {audit}")
        self._screen.done(
            f"execute ran to its end: {row['steps']} steps; the safety audit is intact: {row['audit_records']} records"
        )


def _joints(event: AgentEvent) -> Joints:
    if event.name == "observationUpdate":
        return numbers(event.payload.get("joints"))
    return numbers(event.payload.get("observation")) if event.name == "streamStep" else {}


def _span(values: list[float]) -> float:
    return max(values) - min(values) if values else 0.0
