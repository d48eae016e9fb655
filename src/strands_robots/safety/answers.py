"""Answers to one emergency stop, graded by the robot's own signature; its report.

A robot whose key is enrolled answers for itself: what is not signed with that key is only claimed, and what is signed
with another one is an alarm. *Not stopped* outranks *stopped*, whichever arrives first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from strands_robots.safety.orders import RoundTrip, seconds_of
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.statements import Proof, Purpose, proof_of

ANSWERS_MAX = 4096
"""Robots that answer one stop; further names that are not expected are not taken, so that they use no memory."""

RUNS_MAX = 8
"""Processes of one robot's name that answer one stop."""

RUN_MAX = 64

REFUSED = "resumed before"


@dataclass(frozen=True, slots=True)
class Answer:
    """One robot's verdict.

    Attributes:
        latency_ms: from the press to its receipt here.
        why: empty when it stopped.
        facts: the fields of the verdict.
        proof: grade of its signature.
        required: a signature of the robot was needed.
        enrolled: the robot's key is known here.
        delay_s: from the press to the stop's receipt by the robot, or None where clocks were not compared.
        runs: the answer of each process of this name by its run id, which robots of earlier releases leave empty.
    """

    device_id: str
    stopped: bool | None
    latency_ms: float
    why: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    proof: Proof = Proof.CLAIMED
    required: bool = False
    enrolled: bool = False
    delay_s: float | None = None
    runs: Mapping[str, Answer] = field(default_factory=dict)

    @property
    def claimed(self) -> bool:
        """True where the robot's signature was needed and is missing."""
        return self.required and self.proof is not Proof.SIGNED

    @property
    def refused(self) -> bool:
        """True when the robot says that this stop was resumed before."""
        return REFUSED in self.why


@dataclass(frozen=True, slots=True)
class Received:
    """A verdict as it arrived: its fields, and both clocks at its receipt."""

    params: Mapping[str, Any]
    latency_ms: float
    wall: float


class Answers:
    """Answers to one stop, the one that counts for each robot.

    Args:
        keys: enrolled public keys by robot.
        required: a robot that is not enrolled is only claimed to have answered, too.
        pressed_at: wall-clock seconds of the press.
    """

    def __init__(self, keys: Mapping[str, bytes], *, required: bool, pressed_at: float) -> None:
        self._keys = keys
        self._required = required
        self._pressed_at = pressed_at
        self._ahead_s: dict[str, tuple[float, float]] = {}
        self._runs: dict[str, dict[str, Answer]] = {}
        self.by_robot: dict[str, Answer] = {}
        self.alarms: dict[str, str] = {}

    def shows(self, answer: Answer) -> bool:
        """Return True for an answer that shows that its robot is there.

        Where no robot is enrolled, each answer does.
        """
        return not self._keys or answer.proof is Proof.SIGNED

    def take(self, source: str, received: Received) -> bool:
        """Grade a verdict, and keep it if it outranks the robot's last; True if so."""
        key = self._keys.get(source)
        proof = proof_of(Purpose.STOP_VERDICT, source, received.params, key)
        if proof is Proof.WRONG:
            fresh = source not in self.alarms
            self.alarms[source] = "an answer in its name has a signature that is not of its enrolled key"
            return fresh
        params, stopped = received.params, received.params.get("stopped")
        answer = Answer(
            source,
            stopped if isinstance(stopped, bool) else None,
            received.latency_ms,
            _why(params),
            params,
            proof,
            required=self._required or key is not None,
            enrolled=key is not None,
        )
        runs, run = self._runs.setdefault(source, {}), "" if answer.claimed else _run(params)
        # Made-up processes leave room for the robot's answer.
        run = run if run in runs or len(runs) < RUNS_MAX else ""
        known = runs.get(run)
        if known is not None and not _outranks(answer, known):
            return False
        runs[run] = replace(answer, delay_s=self._delay_s(source, received))
        # One process that moves on outweighs the others.
        self.by_robot[source] = replace(min(runs.values(), key=_rank), runs=dict(runs))
        return True

    def settled(self) -> frozenset[str]:
        """Return the robots that have answered and were not only claimed to."""
        return frozenset(name for name, each in self.by_robot.items() if not each.claimed)

    def final(self) -> list[str]:
        """Return the robots that stopped and have no more to say about it."""
        return [
            name
            for name, each in self.by_robot.items()
            if each.stopped and not each.claimed and each.facts.get("persisted") is not False
        ]

    def unsettled(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return those of ``names`` whose own answer is missing, sorted."""
        return tuple(sorted(frozenset(names) - self.settled()))

    def _delay_s(self, source: str, received: Received) -> float | None:
        """Return the time from the press to the robot's receipt, by this clock."""
        params = received.params
        times = [seconds_of(params.get(name)) for name in ("sent_at", "received_at", "t")]
        sent, there, answered = times
        if there is None:
            return None
        if sent is not None and answered is not None and params.get("repeated") is not True:
            trip = RoundTrip(sent, there, answered, received.wall)
            known = self._ahead_s.get(source)
            if known is None or trip.on_network_s < known[1]:
                self._ahead_s[source] = (trip.ahead_s, trip.on_network_s)
        measured = self._ahead_s.get(source)
        return None if measured is None else there - measured[0] - self._pressed_at


def _outranks(new: Answer, known: Answer) -> bool:
    if new.claimed is not known.claimed:
        return known.claimed
    if {new.stopped, known.stopped} == {True, None}:
        # A resume since does not undo a stop, and a robot of unknown state may stop yet.
        return new.stopped is True
    if new.proof is Proof.SIGNED and known.proof is Proof.SIGNED:
        # The robot's latest statement counts, in whatever order they arrive.
        return (seconds_of(new.facts.get("t")) or 0.0) > (seconds_of(known.facts.get("t")) or 0.0)
    return new.stopped is False and known.stopped is not False


def _rank(answer: Answer) -> tuple[bool, int]:
    return answer.claimed, 2 if answer.stopped else 1 if answer.stopped is None else 0


def _run(params: Mapping[str, Any]) -> str:
    run = params.get("run")
    return run if isinstance(run, str) and len(run) <= RUN_MAX else ""


def _why(params: Mapping[str, Any]) -> str:
    reasons = [params.get("not_stopped"), params.get("unknown")]
    return "; ".join(f"{name}: {why}" for each in reasons if isinstance(each, Mapping) for name, why in each.items())


@dataclass(frozen=True, slots=True)
class StopReport:
    """Outcome of one emergency stop, by robot.

    ``stopped``, ``not_stopped``, ``refused`` and ``claimed`` map a robot to its answer: a robot is *claimed* to have
    stopped when its signature was needed and is missing. ``silent`` are the expected ones that gave no answer, and
    ``alarms`` those in whose name a wrong key answered, with the reason. ``link``: the stop left this machine at least
    once. ``elapsed_ms`` is the time from the press until the last answer or the deadline, ``left_ms`` until the stop
    first left this machine. ``scope`` are the robots that the press was for; ``widened``: none of them was there, and
    every robot was stopped.
    """

    estop_id: str
    stopped: Mapping[str, Answer]
    not_stopped: Mapping[str, Answer]
    refused: Mapping[str, Answer]
    silent: tuple[str, ...]
    link: bool
    elapsed_ms: float
    left_ms: float = 0.0
    claimed: Mapping[str, Answer] = field(default_factory=dict)
    alarms: Mapping[str, str] = field(default_factory=dict)
    scope: Scope = EVERY_ROBOT
    widened: bool = False

    @property
    def widening(self) -> str:
        """Reason why a stop of some robots became one of all, or ""."""
        return f"no {self.scope.meant} answered or is known here, so every robot was stopped" if self.widened else ""

    @property
    def answered(self) -> Mapping[str, Answer]:
        """The answer of each robot that gave one."""
        return {**self.stopped, **self.not_stopped, **self.refused, **self.claimed}

    @property
    def alarmed(self) -> tuple[str, ...]:
        """The robots with an alarm, and without an answer of their own."""
        return tuple(sorted(self.alarms.keys() - self.stopped.keys() - self.not_stopped.keys() - self.refused.keys()))

    @property
    def unanswered(self) -> tuple[str, ...]:
        """The robots for which a stop goes on: they have to answer, and have not."""
        return (*self.silent, *self.alarmed, *(name for name, each in self.claimed.items() if each.enrolled))

    @property
    def ok(self) -> bool:
        """True when every robot is known to be still.

        No answer at all is not ok, nor one of no robot in its scope.
        """
        missing = self.not_stopped or self.refused or self.silent or self.claimed or self.alarmed or self.widened
        return bool(self.stopped) and not missing


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a running stop, given to ``on_progress``; times as in the report."""

    estop_id: str
    answered: Mapping[str, Answer]
    unconfirmed: tuple[str, ...]
    link_up: bool
    elapsed_ms: float
    left_ms: float = 0.0
    alarms: Mapping[str, str] = field(default_factory=dict)
    scope: Scope = EVERY_ROBOT
    widened: bool = False


OnProgress = Callable[[Progress], None]


PRESSES_MAX = 64
"""Presses remembered, so that a stop that goes on under its id keeps the time of its press."""


@dataclass(frozen=True, slots=True)
class Press:
    """The moment of a press, in monotonic and in wall-clock seconds."""

    at: float
    wall: float


class Presses:
    """The latest presses by the ids of their stops; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._presses: dict[str, Press] = {}

    def note(self, estop_id: str) -> Press:
        """Record the press of a stop, once; every later call returns the same moment."""
        with self._lock:
            press = self._presses.setdefault(estop_id, Press(time.monotonic(), time.time()))
            while len(self._presses) > PRESSES_MAX:
                del self._presses[next(iter(self._presses))]
        return press
