"""Checks of a robot that is real hardware, or that another process serves.

Reads, descriptions and refusals are asked as they are. What moves the robot is asked of the one motion that its
operator approved, and never proves a stop: there is no recorder of its bus, so what the network says is told as not
proven. Its bus is never cut, and it is never flooded.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import cast

from strands_robots.contract import RUNNING
from strands_robots.envelope import text_of
from strands_robots.errors import ArgumentsError, NoAnswerError, RefusalError, UnknownVerbError, UnreachableError
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.advertised import WAITING, AdvertisedVerb
from strands_robots.testing import bronze, gold
from strands_robots.testing.bench import MotionRun, NetworkBench, NotKeptError, NotProvenError, wait_for
from strands_robots.testing.promise import Promise, judged
from strands_robots.testing.report import CheckMark, CheckResult
from strands_robots.testing.subject import LongMotion, Subject

LiveProof = Callable[[NetworkBench], str | None]

NO_MOTION = "it moves the robot, and no motion is approved"
NO_RECORDER = "no recorder of its bus"
EMULATED_ALONE = "it is checked on an emulated bus alone"

ACQUIRES = "acquireControl"

WINDOW_S = 0.3
"""Seconds over which the joints are compared."""


class LiveBench(NetworkBench):
    """A robot that another process serves, on the networks that have it.

    Args:
        networks: joined.
        robot: its id.
        subject: limits and exemptions of the checks, and the approved motion, if there is one.

    Raises:
        RefusalError: no network has it; or with a motion, two robots have the id.
    """

    poll_s = 0.05

    def __init__(self, networks: Networks, robot: str, subject: Subject) -> None:
        super().__init__(subject)
        networks.find()
        network = networks.of(robot, moves=subject.motion is not None)
        self.on = {each.name: RemoteRobot(each.known(robot), each) for each in networks.bearers(robot)}
        # By all networks: a motion goes to that of the enrolled robot, a stop to each.
        self._moved = RemoteRobot(network.known(robot), network, networks)

    @property
    def remote(self) -> RemoteRobot:
        """The robot on the network that its motions go to."""
        return self._moved

    def plain_reads(self, network: str) -> list[AdvertisedVerb]:
        """Return its reads that need no argument and wait for no motion."""
        return [each for each in super().plain_reads(network) if each.name not in WAITING]

    def settle(self) -> None:
        """Halt a motion that was on its way to the robot while the halt overtook it."""
        with suppress(RefusalError):
            if self.runs():
                self.halt("a motion began after its halt")


def check_live(promise: Promise, bench: NetworkBench) -> CheckResult:
    """Check a promise as far as may be; never raises for what the robot does."""
    proof = LIVE.get(promise.name)
    began = time.monotonic()
    if proof is not None:
        mark, said = judged(lambda: _asked(proof, bench))
    else:
        mark, said = CheckMark.NOT_PROVEN, NO_RECORDER if promise.needs_recorder else EMULATED_ALONE
    return promise.result(mark, said, time.monotonic() - began)


def _asked(proof: LiveProof, bench: NetworkBench) -> str | None:
    try:
        return proof(bench)
    except UnreachableError as exc:
        raise NotProvenError(f"the network does not carry it: {exc.why}") from exc


def _proof(promise: Promise) -> LiveProof:
    """Return the proof of a promise that asks networks alone, which takes any bench."""
    return cast("LiveProof", promise.proof)


def _on_both(bench: NetworkBench, said: str | None) -> str:
    if len(bench.on) < 2:
        raise NotProvenError(f"it is on {bench.remote.network} alone; there {said or 'it is kept'}")
    return said or ""


def _found(bench: NetworkBench) -> str:
    return _on_both(bench, bench.remote.model or bench.remote.type)


def _verbs(bench: NetworkBench) -> str:
    return _on_both(bench, _proof(bronze.verbs)(bench))


def _own_verbs(bench: NetworkBench) -> str:
    return _on_both(bench, _proof(gold.own_verbs)(bench))


def _status(bench: NetworkBench) -> str:
    states = set()
    for robot in bench.on.values():
        try:
            status = robot.status()
        except UnknownVerbError as exc:
            raise NotProvenError(f"it has no status on {robot.network}") from exc
        if isinstance(status.get("running_policies"), Mapping):
            return "a world"
        states.add(bronze.known_state(status))
    if moves := sorted(states & RUNNING):
        raise NotProvenError(f"it is {' and '.join(moves)}: what it says at rest was not seen")
    return ", ".join(sorted(states))


def _features(bench: NetworkBench) -> str:
    seen = set()
    for robot in bench.on.values():
        try:
            if isinstance(robot.features().get("robots"), Mapping):
                return "a world"
            seen.add(bronze.check_features(robot.features, robot.state))
        except UnknownVerbError as exc:
            raise NotProvenError(f"it has no features or no state on {robot.network}") from exc
    return ", ".join(sorted(seen))


def _approved(bench: NetworkBench) -> LongMotion:
    if bench.subject.motion is None:
        raise NotProvenError(NO_MOTION)
    if bench.runs():
        raise NotProvenError("it moves already, for another caller")
    return bench.subject.motion


def _domains(bench: NetworkBench) -> str:
    tried = 0
    for robot, verb in _asked_wrongly(bench):
        for name, wrong in bronze.wrong_numbers(verb):
            tried += 1
            _check_refused(bench, robot, verb, name, wrong)
    if not tried:
        raise NotProvenError("the approved motion takes no numbers")
    return _of_all(bench, f"{tried} wrong numbers")


def _unknown(bench: NetworkBench) -> str:
    for robot in bench.on.values():
        bronze.check_unknown_verb(bench, robot)
    for robot, verb in _asked_wrongly(bench):
        _check_refused(bench, robot, verb, "no_such_argument", 1)
    return _of_all(bench, "an unknown argument")


def _asked_wrongly(bench: NetworkBench) -> Iterator[tuple[RemoteRobot, AdvertisedVerb]]:
    """Yield verbs to call wrongly: the approved motion, and the lease."""
    names = (_approved(bench).verb, ACQUIRES)
    for robot in bench.on.values():
        yield from ((robot, robot.verbs[name]) for name in names if name in robot.verbs)


def _check_refused(bench: NetworkBench, robot: RemoteRobot, verb: AdvertisedVerb, name: str, wrong: object) -> None:
    try:
        bronze.check_refused(bench, robot, verb, name, wrong)
    except NotKeptError as exc:
        cause = exc.__cause__
        if isinstance(cause, RefusalError) and not isinstance(cause, ArgumentsError | NoAnswerError):
            raise NotProvenError(f"{verb.name} was refused for another reason: {cause.why}") from exc
        raise


def _of_all(bench: NetworkBench, said: str) -> str:
    asked = {_approved(bench).verb, ACQUIRES}
    others = sorted({each.name for name in bench.on for each in bench.motions(name)} - asked)
    if others:
        raise NotProvenError(f"{said} refused; not asked, because not approved: {', '.join(others)}")
    return said


def _halts(bench: NetworkBench) -> str:
    motion = _approved(bench)
    noise = _travel(bench)
    with bench.moving(motion) as run:
        before = _travel(bench)
        verdict = bench.halt()
        said = _check_stopped(bench, run, verdict, "halt")
        after = _travel(bench)
    if before is not None and after is not None and after > max(before / 2, 5 * (noise or 0.0) + 1e-6):
        raise NotKeptError(f"its joints go on after the verdict: {after:.3g} in {WINDOW_S:g} s, {before:.3g} before it")
    joints = "it states no joints" if after is None else f"joints moved {after:.3g} in {WINDOW_S:g} s after it"
    raise _seen(f"{said}, {joints}")


def _again(bench: NetworkBench) -> str:
    motion = _approved(bench)
    for nth in ("first", "second"):
        with bench.moving(motion) as run:
            for how in ("halt", "halt at rest"):
                said = _check_stopped(bench, run, bench.halt(), f"{how} of the {nth} motion")
    raise _seen(f"the fourth {said}")


def _networks(bench: NetworkBench) -> str:
    motion = _approved(bench)
    for name, robot in bench.on.items():
        with bench.moving(motion) as run:
            _check_stopped(bench, run, robot.halt("conformance"), f"stop over {name}")
    raise _seen(f"stopped over {' and '.join(bench.on)}")


def _check_stopped(bench: NetworkBench, run: MotionRun, verdict: StopVerdict, how: str) -> str:
    if verdict.stopped is not True:
        raise NotKeptError(f"{how}: {text_of(verdict.envelope())}")
    if bench.runs():
        raise NotKeptError(f"{how}: the verdict is stopped, and its status says that it runs")
    wait_for(lambda: run.over, bench.subject.answer_s, f"{how}: the answer of {run.motion.verb}")
    return f"verdict stopped after {verdict.elapsed_ms:.0f} ms, status at rest"


def _seen(said: str) -> NotProvenError:
    return NotProvenError(f"{NO_RECORDER}; the network says: {said}")


def _travel(bench: NetworkBench) -> float | None:
    """Return the longest way of a joint within the window; None without joints."""
    first = _joints(bench)
    time.sleep(WINDOW_S)
    second = _joints(bench)
    return max((abs(second[name] - first[name]) for name in first.keys() & second.keys()), default=None)


def _joints(bench: NetworkBench) -> dict[str, float]:
    try:
        joints = bench.remote.state().get("joints")
    except UnknownVerbError:
        return {}
    rows = joints.items() if isinstance(joints, Mapping) else ()
    return {str(name): float(value) for name, value in rows if isinstance(value, int | float) and math.isfinite(value)}


LIVE: Mapping[str, LiveProof] = {
    "bronze.made": _found,
    "bronze.verbs": _verbs,
    "bronze.schemas": _proof(bronze.schemas),
    "bronze.reads": _proof(bronze.reads),
    "bronze.status": _status,
    "bronze.features": _features,
    "bronze.domains": _domains,
    "bronze.unknown": _unknown,
    "silver.halts": _halts,
    "silver.again": _again,
    "silver.networks": _networks,
    "gold.own_verbs": _own_verbs,
}
"""Promises that may be asked about, and how."""

MOTIONS = {"silver.halts": 1, "silver.again": 2, "silver.networks": 2}
"""Times that a check starts the approved motion, at most."""

WRONG_ARGUMENTS = ("bronze.domains", "bronze.unknown")
"""Checks that call the approved motion with a wrong argument."""
