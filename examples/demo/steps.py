"""Steps of the demo: each does one thing, checks that it happened, and prints it."""

from __future__ import annotations

import base64
import io
import math
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.audit import verify_audit_integrity
from strands_robots.cli.output import CliError, label, plain, table
from strands_robots.cli.watch import joints_table
from strands_robots.fleet.reports import joint_limits
from strands_robots.policies.base import plain_numbers
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.resume import sign
from strands_robots.simulation import CUBE, PLATE

from .output import DemoScreen
from .processes import Agent, AgentEvent, EventStream, RobotProcess

NEEDED = ("getObjects", "getPicture", "pick", "place", "setGripper", "wait", "stop", "getStatus", "getFeatures")
CONTROLLER = "demo-safety"

MOTION_MAX_S = 25.0
"""Longest motion that runs to its end; a pick takes 6 s."""

START_MAX_S = 6.0
MIDWAY_RAD = 0.35
"""A motion is stopped once a joint of the arm has travelled so far, which it must within so many seconds."""

MOVED_RAD = 0.05
"""Travel of a joint that counts as a motion."""

GRIPPER = "gripper"
"""Joint whose travel alone is no motion of the arm."""

LIFT_M = 0.004
"""How far a cube may be from standing on the plate, up or down."""

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
    path: list[Joints] = field(default_factory=list)
    setpoints: list[tuple[float, Joints]] = field(default_factory=list)
    """What the joints were told, and when (s): the pictures replay it."""
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
def demo_operator(estop_allow: str = "") -> Iterator[tuple[Path, str]]:
    """Yield the file and the passphrase of a key whose public half robots get.

    Robots and audit get a state folder of their own, so that no demo finds the lockout of an earlier one.

    Args:
        estop_allow: sources whose emergency stop counts; every one by default.
    """
    with tempfile.TemporaryDirectory(prefix="strands-demo-") as folder:
        key, passphrase = Path(folder) / "operator.pem", f"Demo-{secrets.token_hex(16)}"
        settings.put("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(key, passphrase))
        settings.put("STRANDS_STATE_DIR", folder)
        settings.put("STRANDS_MESH_AUDIT_DIR", "")
        settings.put("DEVICE_CONNECT_ESTOP_ALLOW", estop_allow)
        settings.put("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "")
        settings.put("STRANDS_CHECKIN_TIMEOUT_S", "0")
        yield key, passphrase


class DriveSteps:
    """First steps: discovery, a look, a motion that is stopped, a pick.

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
        """List the robots and read the functions of the arm."""
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
        rows = [(name, str(functions[name].get("description") or "").strip().partition("\n")[0]) for name in NEEDED]
        rows.append((f"and {len(functions) - len(NEEDED)} more", ""))
        self._screen.panel(table("What the agent can call", ("function", "description"), rows))

    def look(self, folder: Path) -> None:
        """Read the objects and save a picture of the table."""
        self._screen.head("It looks at the table")
        with self.report.step("look") as row:
            objects = self.read_objects()
            if on_plate(objects) is not None:
                raise CliError("The cube is on the plate before anything has moved it.")
            answer = self._agent.call(self._peer, "getPicture", camera="front")
            row["objects"], row["picture"] = objects, save_jpeg(answer, folder / "table.jpg")
        rows = [(name, _metres(each, "xyz"), _extents(each)) for name, each in objects.items()]
        self._screen.panel(table("", ("object", "x, y, z (m)", "size (mm)"), rows))
        picture = row["picture"]
        self._screen.done(
            f"a picture of camera front, {picture['width']} x {picture['height']} pixels, "
            f"{picture['bytes'] / 1000:.0f} kB: {picture['file']}"
        )

    def stop(self) -> None:
        """Stop a motion midway; measure the latency and check that the arm stands still."""
        self._screen.head("It reaches for the red cube, and stops the arm in mid-motion")
        with self.report.step("stop") as row, self._agent.events(self._peer) as stream:
            self._limits = joint_limits(self._agent.call(self._peer, "getFeatures"))
            self.start_motion(stream, "pick", object=CUBE)
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

    def pick(self) -> None:
        """Pick up the red cube."""
        self._screen.head("It picks up the red cube")
        with self.report.step("pick") as row, self._agent.events(self._peer) as stream:
            outcome = self.run_motion(stream, "pick", object=CUBE)
            row |= {name: outcome.get(name) for name in ("holding", "error_mm", "duration")}
            if outcome.get("holding") is not True:
                raise CliError(f"pick ended, but the jaws hold nothing: {outcome}")
        self._screen.done(
            f"the jaws hold the cube after {row['duration']:.1f} s, {row['error_mm']:.1f} mm from the planned place"
        )

    def read_objects(self) -> dict[str, Any]:
        """Return the objects on the table, as the simulation tells them.

        Raises:
            CliError: cube or plate is not among them.
        """
        objects = self._agent.call(self._peer, "getObjects").get("objects")
        if not isinstance(objects, dict) or not {CUBE, PLATE} <= objects.keys():
            raise CliError(f"There are no {CUBE} and {PLATE} on the table: {objects}")
        return objects

    def run_motion(self, stream: EventStream, verb: str, **params: Any) -> dict[str, Any]:
        """Run a motion to its end and return its outcome.

        Raises:
            CliError: it was refused, did not end, ended otherwise, or nothing moved.
        """
        before = len(self.report.path)
        task = self._agent.call(self._peer, verb, wait=False, **params).get("task_id")
        if self._follow(stream, verb, MOTION_MAX_S, lambda event: event.name == "policyComplete") is None:
            raise CliError(f"{verb} did not report its end.")
        outcome = self._agent.ask(self._peer, "wait", task_id=task, seconds=5.0)
        if outcome.get("task_status") != "completed":
            raise CliError(f"{verb} ended as {outcome.get('task_status')}: {outcome.get('why', '')}")
        if verb != "setGripper":
            self._require_travel(before)
        return outcome

    def start_motion(self, stream: EventStream, verb: str, **params: Any) -> None:
        """Start a motion and return when it is midway."""
        before = len(self.report.path)
        self._agent.call(self._peer, verb, wait=False, **params)
        self._follow(stream, verb, START_MAX_S, lambda event: self._travel(before) >= MIDWAY_RAD)
        self._require_travel(before)

    def _follow(
        self, stream: EventStream, title: str, within: float, until: Callable[[AgentEvent], bool]
    ) -> AgentEvent | None:
        """Draw events until ``until`` or for ``within`` s; add them to the report."""
        started = time.monotonic()
        with self._screen.live() as frame:
            for event in stream.follow(within):
                told = plain_numbers(event.payload.get("action")) if event.name == "streamStep" else {}
                if told:
                    self.report.setpoints.append((event.at, told))
                joints = _joints(event)
                if joints:
                    self.report.path.append(joints)
                    frame(label(f"{title}, {event.at - started:.1f} s", "bold"), joints_table(joints, self._limits))
                if until(event):
                    return event
                self._process.check()
        return None

    def _travel(self, before: int) -> float:
        """Return the largest travel (rad) of an arm joint since an index of the path."""
        path = self.report.path[before:]
        names = {name for joints in path for name in joints} - {GRIPPER}
        return max((_span([joints[name] for joints in path if name in joints]) for name in names), default=0.0)

    def _require_travel(self, before: int) -> None:
        most = self._travel(before)
        if most < MOVED_RAD:
            raise CliError(f"The arm did not move: its busiest joint travelled {most:.3f} rad.")

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
        return plain_numbers(next(iter(robots.values()), {})) if isinstance(robots, dict) else {}


class SafetySteps:
    """Last steps: an emergency stop, a refusal, a signed resume, a place.

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
        return self.emergency_stop, self.refuse, self.resume, self.place

    def emergency_stop(self) -> None:
        """Stop the arm in mid-motion by a safety controller."""
        self._screen.head("It carries the cube to the plate, and a safety controller stops everything")
        with self._report.step("emergency stop") as row, self._agent.events(self._peer) as stream:
            self._motions.start_motion(stream, "place", on=PLATE)
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
            answer = self._agent.ask(self._peer, "place", on=PLATE)
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

    def place(self) -> None:
        """Put the cube on the plate, check that it stands there, and verify the audit."""
        self._screen.head("And the agent finishes")
        with self._report.step("place") as row, self._agent.events(self._peer) as stream:
            # What a stopped gripper holds is not known until it closes once more.
            row["still_held"] = self._motions.run_motion(stream, "setGripper", opening=0.0).get("holding")
            if row["still_held"] is not True:
                raise CliError("The cube was lost while the arm was locked.")
            row["error_mm"] = self._motions.run_motion(stream, "place", on=PLATE).get("error_mm")
            row["objects"] = self._motions.read_objects()
            away = on_plate(row["objects"])
            if away is None:
                raise CliError(f"The cube is not on the plate: {row['objects']}")
            row["from_centre_mm"] = round(1000 * away, 1)
            audit = verify_audit_integrity()
            row["audit_records"] = audit["total"]
            if not audit["ok"] or audit["total"] < 2:
                raise CliError(f"The safety audit does not record what happened: {audit}")
        self._screen.done(
            f"the simulation says: the cube stands on the plate, {row['from_centre_mm']:.0f} mm from its centre; "
            f"the safety audit is intact: {row['audit_records']} records"
        )


def on_plate(objects: Mapping[str, Any]) -> float | None:
    """Return the cube's distance (m) from the plate's centre, None if not on it.

    The whole cube must be over the plate, and its bottom at the plate's top.
    """
    cube, plate = objects[CUBE], objects[PLATE]
    away = math.hypot(cube["x"] - plate["x"], cube["y"] - plate["y"])
    lifted = (cube["z"] - cube["size"][2] / 2) - (plate["z"] + plate["size"][2] / 2)
    over = away + math.hypot(cube["size"][0], cube["size"][1]) / 2 <= plate["size"][0] / 2
    return away if over and abs(lifted) <= LIFT_M else None


def save_jpeg(answer: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """Write the picture of an answer to getPicture; return its file, size and bytes.

    Raises:
        CliError: there is no picture in it, or the file cannot be written.
    """
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415 - loaded when the demo runs

    try:
        content = base64.b64decode(str(answer.get("jpeg", "")), validate=True)
        with Image.open(io.BytesIO(content), formats=["JPEG"]) as picture:
            width, height = picture.size
    except (ValueError, UnidentifiedImageError):
        raise CliError("getPicture was answered without a picture.") from None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    except OSError as exc:
        raise CliError(f"The picture could not be written to {file}: {exc}") from exc
    return {"file": str(file), "width": width, "height": height, "bytes": len(content)}


def _metres(each: Mapping[str, Any], axes: str) -> str:
    return ", ".join(f"{each[axis]:.3f}" for axis in axes)


def _extents(each: Mapping[str, Any]) -> str:
    return " x ".join(f"{1000 * value:.0f}" for value in each["size"])


def _joints(event: AgentEvent) -> Joints:
    if event.name == "observationUpdate":
        return plain_numbers(event.payload.get("joints"))
    return plain_numbers(event.payload.get("observation")) if event.name == "streamStep" else {}


def _span(values: list[float]) -> float:
    return max(values) - min(values) if values else 0.0
