"""Platinum: stops under load, limits kept, answers signed, all recorded."""

from __future__ import annotations

import asyncio
import math
import secrets
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from device_connect_edge.drivers import DeviceDriver, emit, rpc

from strands_robots import settings
from strands_robots.adapted import behind_contract
from strands_robots.audit import flush_audit, read_audit_log, verify_audit_integrity
from strands_robots.device_connect import FleetClient, init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.backends.config import loopback_config
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.envelope import text_of
from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import MESH
from strands_robots.fleet.lockouts import Enrolled
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.fleet.reports import Range, is_finite, joint_limits
from strands_robots.fleet.verdicts import FleetVerdict
from strands_robots.safety import ed25519
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.identity import SEED_BYTES
from strands_robots.testing.bench import (
    ANSWER_S,
    CALLER,
    PEER,
    ConformanceBench,
    DriftError,
    NotKeptError,
    NotProvenError,
    within,
)
from strands_robots.testing.promise import promise
from strands_robots.testing.silver import hung
from strands_robots.testing.subject import BusWrite, LongMotion

ESTOP_S = 0.020
STOPS_FEW, STOPS, STOPS_MAX = 10, 40, 100
"""Emergency stops of a check: where none is in time, where all are, and where one in a hundred may take longer."""

WAITED_S = 0.005
"""Seconds that all threads of the process may have waited for a processor in a stop that counts."""

TASKS = Path("/proc/self/task")

CALLS = 8
TELEMETRY_HZ = 5000.0
LEAST_SHARE = 0.8
"""Share of the telemetry that this machine has to have sent for the figure to count."""

TAKEN_EVERY = 50
NEIGHBOUR, CONTROLLER = "conform-neighbour", "conform-safety"
RESUME_KEY = "STRANDS_MESH_RESUME_PUBLIC_KEY"
SLOW_READS = ("get_state", "get_joints")

MOVED_S = 0.5
WINDOW_S = 0.2
"""Seconds over which a speed is taken, as single writes may be late."""

JITTER = 1.25
TOLERANCE = 1e-6


class _Neighbour(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A device of the same process: its calls wait, and it tells telemetry."""

    device_type = "neighbour"

    def __init__(self) -> None:
        super().__init__()
        self.waiting = 0

    @rpc()  # type: ignore[untyped-decorator]
    async def linger(self) -> dict[str, Any]:
        """Answer a minute later."""
        self.waiting += 1
        await asyncio.sleep(60.0)
        return {}

    @emit()  # type: ignore[untyped-decorator]
    async def tick(self, n: int) -> None:
        """Telemetry.

        Args:
            n: its number
        """


@promise(
    "platinum.estop",
    f"An emergency stop has halted it within {ESTOP_S * 1000:.0f} ms, 99 times in 100, beside {CALLS} slow calls and"
    f" {TELEMETRY_HZ / 1000:.0f} kHz of telemetry in its process.",
    why="The stop that counts is pressed when everything else goes wrong as well.",
    look="halt() or stop_task(): what it waits for besides the last write",
    needs_recorder=True,
)
def estop(bench: ConformanceBench) -> str:
    """Stop motions by emergency stops, in a busy process."""
    with closing(safety_controller(CONTROLLER, loopback_config())) as hand, _load(bench) as rate:
        if not hand.wait_link(ANSWER_S):
            raise NotProvenError(f"the connection of emergency stops was not there within {ANSWER_S:g} s")
        stops: list[_Stop] = []
        while not _enough(stops):
            stops.append(_stopped_in(bench, hand))
        bench.check_no_write(bench.writes, "emergency stop")
        sent_hz = rate()
    every, counted = _took(stops), _took(each for each in stops if each.counts)
    said = f"p50 {statistics.median(every) * 1000:.1f} ms, p99 {_p99(every) * 1000:.1f} ms of {len(every)}"
    if not _kept(every):
        if min(every) > ESTOP_S or (len(counted) >= STOPS and not _kept(counted)):
            raise NotKeptError(said)
        if len(counted) < STOPS:
            busy = f"this machine is busy, {len(every) - len(counted)} of {len(every)} stops waited for a processor"
            raise NotProvenError(f"{said}; {busy}")
    if sent_hz < LEAST_SHARE * TELEMETRY_HZ:
        raise NotProvenError(f"this machine sent {sent_hz / 1000:.1f} kHz of telemetry only; {said}")
    return f"{said}, beside {sent_hz / 1000:.1f} kHz"


@dataclass(frozen=True, slots=True)
class _Stop:
    """One emergency stop.

    Attributes:
        took_s: seconds to the last write or to the verdict.
        waited_s: seconds that threads of the process waited for a processor meanwhile.
    """

    took_s: float
    waited_s: float

    @property
    def counts(self) -> bool:
        """False where another program had the processor that the stop needed."""
        return self.waited_s <= WAITED_S


def _took(stops: Iterable[_Stop]) -> list[float]:
    return [each.took_s for each in stops]


def _enough(stops: Sequence[_Stop]) -> bool:
    """Return True once the stops are enough: all in time, none, or many."""
    took, counted = _took(stops), sum(each.counts for each in stops)
    if len(took) >= STOPS_FEW and min(took) > ESTOP_S:
        return True
    # Where so few count, there will not be enough of them.
    return len(took) >= STOPS_MAX or (len(took) >= STOPS and (_kept(took) or counted < len(took) // 4))


def _kept(took: Sequence[float]) -> bool:
    return sum(each > ESTOP_S for each in took) <= len(took) // 100


def _p99(took: Sequence[float]) -> float:
    return sorted(took)[-1 - len(took) // 100]


def _stopped_in(bench: ConformanceBench, hand: SafetyController) -> _Stop:
    """Measure one stop: from the press to the last write or the verdict of the halt."""
    recorder = bench.subject.recorder
    assert recorder is not None
    with bench.moving():
        waited = _waited_for_processors()
        pressed = time.monotonic()
        report = hand.stop([PEER], "emergency stop of a check", deadline_s=bench.subject.deadline_s + 1.0)
        waited = _waited_for_processors() - waited
        bench.estops.append(report.estop_id)
        answer, count = report.answered.get(PEER), bench.writes
        if answer is None or answer.stopped is not True:
            raise NotKeptError(f"emergency stop: {'no answer' if answer is None else answer.why or 'not known'}")
        bench.clear()
        last = recorder.since(count - 1)[0].at
    if bench.writes > count:
        raise NotKeptError("it wrote after an emergency stop's verdict")
    halted_ms = answer.facts.get("elapsed_ms")
    return _Stop(max(last - pressed, halted_ms / 1000 if is_finite(halted_ms) else math.inf), waited)


def _waited_for_processors() -> float:
    """Return the seconds that threads of the process waited for a processor.

    Linux counts them (``schedstat``); elsewhere it is 0, and each stop counts.
    """
    waited_ns = 0
    for task in TASKS.glob("*/schedstat"):
        # A thread may end meanwhile.
        with suppress(OSError, ValueError, IndexError):
            waited_ns += int(task.read_text(encoding="ascii").split()[1])
    return waited_ns / 1e9


@contextmanager
def _load(bench: ConformanceBench) -> Iterator[Callable[[], float]]:
    """Have calls out, which wait, and telemetry for the block; yield its rate in Hz.

    The calls wait in a read of the robot, and where it has none that can wait, in a device beside it.
    """
    link, name = loopback_config(), next((each for each in SLOW_READS if callable(getattr(bench.body, each, None))), "")
    over = threading.Event()
    with ExitStack() as stack:
        runtime = init_device_connect_sync(_Neighbour(), peer_id=NEIGHBOUR, link=link, allow_insecure=True)
        stack.callback(stop_device_connect, runtime)
        if name:
            stack.enter_context(hung(bench.body, name))
            robots = [*bench.on.values()]
            calls: list[Callable[[], object]] = [robots[nth % len(robots)].state for nth in range(CALLS)]
        else:
            client = stack.enter_context(FleetClient(link, "conform-caller"))
            calls = [partial(client.call, NEIGHBOUR, "linger", timeout=60.0)] * CALLS
        for each in calls:
            threading.Thread(target=_ask_again, args=(each, over), name="conform slow call", daemon=True).start()
        sent, began = [0], time.monotonic()
        flood = threading.Thread(target=_flood, args=(runtime, sent, over), name="conform telemetry", daemon=True)
        flood.start()
        try:
            yield lambda: sent[0] / (time.monotonic() - began)
        finally:
            over.set()
            flood.join()


def _ask_again(call: Callable[[], object], over: threading.Event) -> None:
    while not over.is_set():
        try:
            call()
        except Exception:  # noqa: BLE001 - a call that was out for too long is asked anew
            over.wait(0.01)


def _flood(runtime: Any, sent: list[int], over: threading.Event) -> None:
    began = time.monotonic()
    while not over.wait(0.0005):
        due = (time.monotonic() - began) * TELEMETRY_HZ
        while sent[0] < due and not over.is_set():
            told = runtime.emit_from_thread("tick", {"n": sent[0]})
            sent[0] += 1
            if not sent[0] % TAKEN_EVERY:
                # No more is on its way than the network takes.
                with suppress(TimeoutError):
                    told.result(1.0)


@promise(
    "platinum.limits",
    "What it writes to its bus stays within the limits and below the speeds that it declares.",
    why="Who stands beside it stands where the limits end.",
    look="the place that writes: clamp the target and the step there, after whatever computes them",
    needs_recorder=True,
)
def limits(bench: ConformanceBench) -> str:
    """Compare the positions of the run and the speeds of motions with those."""
    recorder = bench.subject.recorder
    assert recorder is not None
    declared = {**_stated(bench), **bench.subject.limits}
    count = bench.writes
    for motion in (bench.motion, *_own_motions(bench)):
        with suppress(NotProvenError), bench.moving(motion):
            time.sleep(MOVED_S)
            bench.halt()
    written = recorder.since(0)
    names = {name for write in written for name in write.values}
    if not names:
        raise NotProvenError(
            "its recorder is given no positions: recorder.wrote('goal', {'pan': 12.5}), or"
            " recorder.watch(device, 'send_action', values=lambda action: action)"
        )
    if unlimited := sorted(names - declared.keys()):
        raise NotProvenError(
            f"no limits are declared of {', '.join(unlimited)}: state ranges={{'pan': [-90, 90]}} in get_features, or"
            " give Subject(limits=...)"
        )
    if unknown := sorted(names - bench.subject.speeds.keys()):
        raise NotProvenError(
            f"no speed is declared of {', '.join(unknown)}: give Subject(speeds={{'pan': 45.0}}), in its unit a second"
        )
    for write in written:
        for name, value in write.values.items():
            _check_within(name, value, declared[name])
    if len(written) == count:
        raise NotProvenError("no motion was written to its bus, so no speed was seen")
    fastest = {name: _fastest(name, [*_last(name, written[:count]), *written[count:]]) for name in sorted(names)}
    for name, speed in fastest.items():
        if speed > JITTER * bench.subject.speeds[name]:
            raise DriftError(f"{name} was moved at {speed:.3g} a second; {bench.subject.speeds[name]:g} is declared")
    return ", ".join(f"{name} at most {speed:.3g} a second" for name, speed in fastest.items())


def _stated(bench: ConformanceBench) -> dict[str, Range]:
    features = within(bench.subject.answer_s, behind_contract(bench.body).get_features, "get_features")
    return joint_limits(features) if isinstance(features, Mapping) else {}


def _own_motions(bench: ConformanceBench) -> list[LongMotion]:
    taken = bench.motion.verb
    return [LongMotion(each.name, bench.arguments(each)) for each in bench.motions() if each.own and each.name != taken]


def _check_within(name: str, value: object, limits: Range) -> None:
    low, high = limits
    if not is_finite(value):
        raise NotKeptError(f"{name} was written as {value!r:.50}, which is no finite number")
    slack = TOLERANCE * (high - low)
    if not low - slack <= value <= high + slack:
        raise DriftError(f"{name} was written as {value:.4g}; from {low:g} to {high:g} is declared")


def _last(name: str, writes: Sequence[BusWrite]) -> list[BusWrite]:
    """Return the last write of a joint: from there the next one moves it."""
    return [write for write in writes if name in write.values][-1:]


def _fastest(name: str, writes: Sequence[BusWrite]) -> float:
    """Return the greatest speed of a joint over any window of the writes.

    A shorter way counts as one of a whole window.
    """
    times, paths = [0.0], [0.0]
    points = [(write.at, write.values[name]) for write in writes if name in write.values]
    for (before, start), (at, end) in pairwise(points):
        # After a pause the way of one write is no slower for it.
        times.append(times[-1] + min(at - before, WINDOW_S))
        paths.append(paths[-1] + abs(end - start))
    fastest, first = 0.0, 0
    for last, at in enumerate(times):
        while first < last and at - times[first + 1] >= WINDOW_S:
            first += 1
        fastest = max(fastest, (paths[last] - paths[first]) / max(at - times[first], WINDOW_S))
    return fastest


@promise(
    "platinum.signed",
    "With its key enrolled, its answers to stops, to the question for its lockouts and to a resume are its own.",
    why="An answer that anyone can write says nothing of the robot behind it.",
    look="the robot's key in the state directory: its log and doctor say why it is not used",
)
def signed(bench: ConformanceBench) -> str:
    """Enroll it, and stop, ask and resume it on each network."""
    key = ed25519.signing_key(secrets.token_bytes(SEED_BYTES))
    # It is the bench's own, and ends with it.
    settings.put(RESUME_KEY, ed25519.encode(ed25519.public_half(key)))
    for name, fleet in bench.fleets.items():
        enrolled = fleet.enroll().get(PEER)
        if enrolled is None or enrolled.outcome not in (Enrolled.NEW, Enrolled.KNOWN):
            raise NotKeptError(f"on {name} it shows no key: {enrolled.said if enrolled else 'it did not answer'}")
        verdict = bench.estop(name)
        _check_own(name, "an emergency stop", verdict)
        report = fleet.lockouts().get(PEER)
        if report is None or report.problem or not report.lockouts:
            why = "it did not answer" if report is None else report.problem or "none, though it is locked"
            raise NotKeptError(f"{name}: asked for its lockouts: {why}")
        freed, said = fleet.resume(key, PEER).get(PEER, (False, "it did not answer"))
        if not freed:
            raise NotKeptError(f"{name}: a resume: {said}")
    return f"on {' and '.join(bench.fleets)}"


def _check_own(network: str, asked: str, verdict: FleetVerdict) -> None:
    """Check that a verdict of an enrolled robot is its own, and says stopped.

    Once it is enrolled, what it has not signed counts as unknown.
    """
    alarms = [why for each in verdict.networks if each.outcome for why in each.outcome.report.alarms.values()]
    answer = verdict.get(PEER)
    if alarms or answer is None or answer.stopped is not True:
        why = "; ".join(alarms) or ("no answer" if answer is None else text_of(answer.envelope()))
        raise NotKeptError(f"{network}: {asked}: {why}")


@promise(
    "platinum.audit",
    "Each emergency stop of the run, a stop, a refused motion and a resume over each network are in the audit, which"
    " is intact.",
    why="After an accident the record is all that there is.",
    look="what the robot does to the state directory; records of its own go through log_safety_event",
)
def audit(bench: ConformanceBench) -> str:
    """Stop, lock and resume it over each network, and look for the records."""
    motion, expected = bench.motion, dict[str, Callable[[str, Mapping[str, Any]], bool]]()
    for name, robot in bench.on.items():
        with bench.moving():
            epoch = bench.estop(name).estop_id
            _check_locked(robot, motion, bench.subject.answer_s)
            bench.clear()
        with bench.moving():
            robot.halt("conformance")
        expected |= {
            f"the refusal of {motion.verb} over {name}": partial(_is_command, name, "command_refused", motion.verb),
            f"the stop over {name}": partial(_is_command, name, "command_executed", "stop"),
            f"the resume after a stop over {name}": partial(_is_resume, epoch),
        }
    expected |= {f"emergency stop {each}": partial(_is_stop, each) for each in bench.estops}
    flush_audit()
    records = [(str(each.get("event")), _payload(each)) for each in read_audit_log() if each.get("peer_id") == PEER]
    missing = [what for what, known in expected.items() if not any(known(*each) for each in records)]
    if missing:
        raise NotKeptError(f"the audit lacks {', '.join(missing[:5])}{' and others' if len(missing) > 5 else ''}")
    found = verify_audit_integrity()
    if not found["ok"]:
        raise NotKeptError(f"the audit is not intact: {found['breaks'] or found}"[:500])
    return f"{len(expected)} of {found['total']} records"


def _check_locked(robot: RemoteRobot, motion: LongMotion, seconds: float) -> None:
    try:
        robot.call(motion.verb, timeout=seconds, **motion.arguments)
    except RefusalError:
        return
    raise NotKeptError(f"{motion.verb} was carried out on {robot.network} while it was locked")


def _payload(record: Mapping[str, Any]) -> Mapping[str, Any]:
    payload = record.get("payload")
    return payload if isinstance(payload, Mapping) else {}


def _is_stop(epoch: str, event: str, payload: Mapping[str, Any]) -> bool:
    return event in ("emergency_stop", "remote_estop_engaged") and payload.get("estop_id") == epoch


def _is_resume(epoch: str, event: str, payload: Mapping[str, Any]) -> bool:
    return event in ("resume_local", "resume_ok") and epoch in (*payload.get("epochs", ()), payload.get("epoch"))


def _is_command(network: str, wanted: str, verb: str, event: str, payload: Mapping[str, Any]) -> bool:
    # A caller has another name on the mesh.
    over_mesh = str(payload.get("about")).startswith(f"{CALLER}-mesh")
    return event == wanted and payload.get("action") == verb and over_mesh is (network == MESH)


PROMISES = (estop, limits, signed, audit)
