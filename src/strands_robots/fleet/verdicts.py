"""Verdicts of stops: answers measured by the roster, by robot and by network."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.fleet.joining import side_by_side
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import Sending
from strands_robots.safety.sightings import Known
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome, StopRoster
from strands_robots.safety.stopping import StopVerdict, explain, grade, graded
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)


def by_bearer(robot: str, answers: Mapping[str, Envelope]) -> dict[str, Envelope]:
    """Return answers by network under names that tell their robots apart."""
    several = len(answers) > 1
    return {f"{robot} on {network}" if several else robot: said for network, said in answers.items()}


def answer_of_bearers(robot: str, answers: Mapping[str, Envelope], stale: str = "") -> Envelope:
    """Return the answers of all robots of an id as one, that of one network as it is.

    Args:
        robot: the id.
        answers: by network.
        stale: as of :func:`combined_verdict`, where several networks have answered.
    """
    first, *others = answers.values() or (unanswered(robot),)
    return combined_verdict(by_bearer(robot, answers), stale) if others else first


def stop_outcome(answer: Envelope) -> tuple[bool | None, str]:
    """Return whether a robot stopped, None when unknown, and the text of its answer."""
    stopped = grade(answer).stopped
    return stopped, text_of(answer) or ("" if stopped else explain(answer))


def combined_verdict(answers: Mapping[str, Envelope], stale: str = "") -> Envelope:
    """Return one answer for several stops: success when all were confirmed.

    Args:
        answers: by robot.
        stale: why there may be more robots than these; then it is unknown whether all have stopped.
    """
    if not answers:
        return error(f"No robot that can be stopped answered. {stale}".strip(), stopped=None, robots={})
    outcomes = {name: stop_outcome(answer) for name, answer in answers.items()}
    moving = [name for name, (stopped, _) in outcomes.items() if stopped is False]
    silent = [name for name, (stopped, _) in outcomes.items() if stopped is None]
    fields: dict[str, Any] = {
        "stopped": False if moving else None if silent or stale else True,
        "not_stopped": moving,
        "silent": silent,
        "robots": {name: said for name, (_, said) in outcomes.items()},
    }
    if fields["stopped"]:
        return success(f"Stopped: {', '.join(answers)}.", **fields)
    problems = [f"DID NOT STOP: {', '.join(moving)}"] if moving else []
    problems += [f"no answer, state unknown: {', '.join(silent)}"] if silent else []
    problems += [f"stopped: {', '.join(answers)}. {stale.rstrip('.')}"] if not problems else []
    return error("; ".join(problems) + ".", **fields)


def measured(
    answers: Mapping[str, Envelope], roster: StopRoster, sending: Sending, estop_id: str = "", problem: str = ""
) -> StopOutcome:
    """Measure answers by the roster; one of unknown outcome is no answer.

    Args:
        answers: by robot.
        roster: of the stop.
        sending: how it was sent.
        estop_id: of an emergency stop.
        problem: why there may be more robots than these.
    """
    graded = {name: stop_outcome(answer) for name, answer in answers.items()}
    rows = {name: Answer(name, stopped, 0.0, said) for name, (stopped, said) in graded.items() if stopped is not None}
    report = StopReport(
        estop_id,
        {name: each for name, each in rows.items() if each.stopped},
        {name: each for name, each in rows.items() if not each.stopped},
        {},
        (),
        sending.left,
        0.0,
    )
    return with_reasons(roster.outcome(report, sending, problem), answers)


def not_reached(network: NetworkKey, *, left: bool = False) -> StopOutcome:
    """Return the outcome of a stop that no robot answered, with reasons.

    Args:
        network: whose roster it is. A disk that hangs is waited for within a bound.
        left: the stop left this machine.
    """
    roster = StopRoster(network)
    threading.Thread(target=roster.read, name="stop roster", daemon=True).start()
    return measured({}, roster, Sending(left=left))


def remembered(
    robot: str, keys: Mapping[str, Callable[[], NetworkKey]], whys: Mapping[str, str]
) -> dict[str, Envelope]:
    """Return by network the answer of a silent robot that is remembered there.

    Args:
        robot: its id.
        keys: return the names under which robots of each network are remembered.
        whys: the reasons why the stop did not leave on a network; empty where it did.
    """
    names = list(keys)
    said = side_by_side(lambda name: _silence_of(robot, name, keys[name], whys[name]), names)
    return {name: each for name, each in zip(names, said, strict=True) if each is not None}


def _silence_of(robot: str, network: str, key: Callable[[], NetworkKey], why: str) -> Envelope | None:
    """Return the answer of a silent robot that this machine remembers, else None.

    Args:
        robot: its id.
        network: the name of the network where it is remembered.
        key: returns the name under which its robots are.
        why: the reason why the stop did not leave there; empty where it did.
    """
    try:
        outcome = not_reached(key(), left=not why)
    except Exception as exc:  # noqa: BLE001 - a memory that cannot be read hides no answer of another network
        logger.warning("The roster of %s cannot be read: %s", network, exc)
        return None
    # One that said that it left may be on another network now.
    if not any(row.name == robot and not row.departed for row in outcome.roster.rows):
        return None
    reasons = [f"it did not leave on {network}: {why.rstrip('.')}" if why else "", outcome.reasons.get(robot, "")]
    said = "; ".join(filter(None, reasons)) or "it is remembered there"
    return error(f"{robot} did not answer: {said}.", stopped=None)


def with_reasons(outcome: StopOutcome, answers: Mapping[str, Envelope], *, plain: bool = False) -> StopOutcome:
    """Return the outcome with what silent robots said of themselves.

    Args:
        outcome: of the stop.
        answers: by robot.
        plain: they are answers to a plain stop after an emergency stop.
    """
    reasons = dict(outcome.reasons)
    for name in outcome.report.silent:
        said = text_of(answers[name]).rstrip(".") if name in answers else ""
        if plain and name in answers and stop_outcome(answers[name])[0]:
            said = "a plain stop was answered in its name, which proves nothing of a robot with a key"
        if said and said != text_of(unanswered(name)).rstrip("."):
            reasons[name] = f"{said}: {reasons[name]}" if name in reasons else said
    return replace(outcome, reasons=reasons)


def with_plain_stops(report: StopReport, outcome: StopOutcome, answers: Mapping[str, Envelope]) -> StopReport:
    """Return the report of an emergency stop with the answers to a plain one.

    Those are not signed and lock nothing. *Stopped* counts of a device that was only heard, and in whose name nothing
    came that its key should have signed; *not stopped* counts of every robot.

    Args:
        report: of the emergency stop.
        outcome: of that report.
        answers: to the plain stop, by robot.
    """
    unproven = outcome.report.claimed.keys() | outcome.report.alarms.keys()
    bare = {row.name for row in outcome.roster.rows if row.known is Known.HEARD and not row.processes} - unproven
    stopped, moving, claimed = dict(report.stopped), dict(report.not_stopped), dict(report.claimed)
    for name, answer in answers.items():
        still, said = stop_outcome(answer)
        if still is False:
            moving[name] = Answer(name, False, 0.0, said)
            claimed.pop(name, None)
        elif still and name in bare:
            stopped[name] = Answer(name, True, 0.0, "stopped, and NOT LOCKED: it did not act on the emergency stop")
    return replace(report, stopped=stopped, not_stopped=moving, claimed=claimed)


def unanswered(robot: str) -> Envelope:
    """Return what stands for the answer of a robot that gave none."""
    return error(f"{robot} did not answer.", stopped=None)


def roster_verdict(outcome: StopOutcome) -> Envelope:
    """Return one answer: success when every robot of the roster was confirmed."""
    report = outcome.report
    rows = {
        name: success(each.why, stopped=True) if each.stopped else error(each.why, stopped=each.stopped)
        for name, each in report.answered.items()
    }
    for name in report.silent:
        why = outcome.reasons.get(name, "")
        rows[name] = error(f"{why}.", stopped=None) if why else unanswered(name)
    verdict = combined_verdict(rows, " ".join(outcome.problems))
    fields = {name: value for name, value in verdict.items() if name not in ("status", "content", "reason")}
    said = " ".join([text_of(verdict), outcome.sentence, *stop_notes(outcome)])
    return (error if is_error(verdict) else success)(said, **fields, **outcome.facts())


HALTED_MAX = 64


@dataclass(frozen=True, slots=True)
class NetworkVerdict:
    """A stop on one network.

    Attributes:
        network: its name.
        outcome: measured by the network's roster; None where nothing is known of the network.
        answers: of the robots to a plain stop, by id.
        absent: why it did not leave on this network; empty where it did.
    """

    network: str
    outcome: StopOutcome | None = None
    answers: Mapping[str, Envelope] | None = None
    absent: str = ""

    @property
    def problems(self) -> Sequence[str]:
        """Reasons why there may be more robots than the verdicts name."""
        return self.outcome.problems if self.outcome is not None else ()

    @property
    def counted(self) -> frozenset[str]:
        """Robots that had to answer.

        Where robots are enrolled, a name that was only heard need not.
        """
        if self.outcome is None or not self.outcome.size:
            return frozenset(self.verdicts())
        report = self.outcome.report
        return frozenset({*report.answered, *report.silent, *report.alarms})

    @property
    def silent(self) -> Sequence[str]:
        """Robots that had to answer, and did not."""
        return self.outcome.report.silent if self.outcome is not None else ()

    def has(self, robot: str) -> bool:
        """Return whether a robot answered, or is known as one of this network."""
        outcome = self.outcome
        return outcome is not None and any(row.name == robot and not row.named for row in outcome.roster.rows)

    def without(self, robots: Collection[str]) -> NetworkVerdict:
        """Return the verdict without silent robots, which are of another network."""
        if self.outcome is None or not robots:
            return self
        outcome = self.outcome
        report = replace(outcome.report, silent=tuple(name for name in outcome.report.silent if name not in robots))
        rows = tuple(row for row in outcome.roster.rows if row.name not in robots)
        reasons = {name: why for name, why in outcome.reasons.items() if name not in robots}
        roster = replace(outcome.roster, rows=rows)
        return replace(self, outcome=replace(outcome, report=report, roster=roster, reasons=reasons))

    @property
    def sentence(self) -> str:
        """Outcome in words."""
        left = f"It did not leave on {self.network}: {self.absent.rstrip('.')}." if self.absent else ""
        if self.outcome is None:
            return left
        free = f"Not locked: {', '.join(self.outcome.not_locked)}." if self.outcome.not_locked else ""
        return " ".join(filter(None, [left, self.outcome.sentence, free, *stop_notes(self.outcome)]))

    def facts(self) -> dict[str, Any]:
        """Return what a script reads of it besides the verdicts."""
        facts = {} if self.outcome is None else self.outcome.facts()
        return {"absent": self.absent, **facts} if self.absent else facts

    def verdicts(self) -> dict[str, StopVerdict]:
        """Return the verdict of each robot that answered or had to.

        A network that failed, and of which no robot is known, has one verdict for all its robots.
        """
        outcome = self.outcome
        if self.absent and (outcome is None or not outcome.size):
            all_of_them = f"the robots on {self.network}"
            return {all_of_them: StopVerdict(unknown={all_of_them: self.absent})}
        if outcome is None:
            return {}
        verdicts = dict[str, StopVerdict]()
        for part in (outcome.others, outcome.report):
            verdicts |= {name: _verdict(name, each) for name, each in part.answered.items()}
            verdicts |= {name: StopVerdict(unknown={name: f"ALARM: {why}"}) for name, why in part.alarms.items()}
        for name in outcome.report.silent:
            verdicts[name] = StopVerdict(unknown={name: outcome.reasons.get(name, "no answer")})
        for name in outcome.no_stop:
            verdicts.setdefault(name, StopVerdict(unknown={name: "it has no stop"}))
        for name, answer in (self.answers or {}).items():
            if name in verdicts and verdicts[name].stopped:
                verdicts[name] = verdict_of_answer(answer, name)
        return verdicts


class FleetVerdict(Mapping[str, StopVerdict]):
    """Verdicts of a stop of all robots, by id::

        stop = fleet.estop("a hand in the cell")
        if not stop.ok:
            print(stop)          # how many stand still, and who is missing
        stop["arm-1"].stopped    # True, False, or None where it is not known

    A robot that must answer and did not is in it as well, with an unknown verdict.

    Attributes:
        networks: the stop on each network.
        unreached: networks on which it did not leave, and of which no robot is known.
        estop_id: the epoch of the lockout; empty for a stop without one.
        ignored: notes on arguments that could not be read.
    """

    def __init__(
        self,
        networks: Sequence[NetworkVerdict],
        estop_id: str = "",
        known: Sequence[str] = (),
        ignored: Sequence[str] = (),
        unreached: Sequence[NetworkVerdict] = (),
    ) -> None:
        self.networks, self.unreached = tuple(networks), tuple(unreached)
        self.estop_id, self.ignored = estop_id, tuple(ignored)
        by_robot: dict[str, list[StopVerdict]] = {name: [] for name in known}
        for each in self.networks:
            for name, verdict in each.verdicts().items():
                by_robot.setdefault(name, []).append(verdict)
        self._verdicts = {name: combined(name, by_robot[name], 0.0) for name in sorted(by_robot)}
        self._counted = frozenset(known).union(*(each.counted for each in self.networks))

    @property
    def reporting(self) -> tuple[NetworkVerdict, ...]:
        """Networks that have robots, or that the stop did not reach in full."""
        return tuple(
            each for each in self.networks if each.absent or each.problems or (each.outcome and each.outcome.size)
        )

    @property
    def ok(self) -> bool:
        """True when every robot that had to answer is known to stand still, and one did."""
        stopped = any(each.stopped for each in self._verdicts.values())
        return stopped and not self.missing and not any(each.problems for each in self.networks)

    @property
    def missing(self) -> tuple[str, ...]:
        """Robots that had to answer, and are not known to stand still."""
        return tuple(name for name, each in self._verdicts.items() if name in self._counted and not each.stopped)

    def __getitem__(self, robot: str) -> StopVerdict:
        return self._verdicts[robot]

    def __iter__(self) -> Iterator[str]:
        return iter(self._verdicts)

    def __len__(self) -> int:
        return len(self._verdicts)

    def __str__(self) -> str:
        said = [f"Ignored: {note}." for note in self.ignored]
        said += [f"{name} did not stop." for name, each in self._verdicts.items() if each.stopped is False]
        said += [
            f"{name}: {why.rstrip('.')}." for name, each in self._verdicts.items() for why in each.unknown.values()
        ]
        several = len(self.reporting) > 1
        said += [f"{each.network}: {each.sentence}" if several else each.sentence for each in self.reporting]
        return " ".join(filter(None, said)) or "No robot is known."

    def __repr__(self) -> str:
        robots = "1 robot" if len(self) == 1 else f"{len(self)} robots"
        return f"<FleetVerdict of {robots}: {'ok' if self.ok else str(self)}>"


def verdict_of_answer(answer: object, name: str) -> StopVerdict:
    """Return the answer to a stop of a remote robot as a verdict on ``name``."""
    verdict = graded(answer, name)
    if verdict.stopped and isinstance(answer, Mapping):
        return StopVerdict(_halted(answer, name), settling=answer.get("settling") is True)
    return StopVerdict(
        verdict.halted,
        {each: plain_text(why, 500) for each, why in verdict.not_stopped.items()},
        {each: plain_text(why, 500) for each, why in verdict.unknown.items()},
    )


def combined(robot: str, verdicts: Sequence[StopVerdict], elapsed_ms: float) -> StopVerdict:
    """Return the verdicts of all bearers of an id as one; unknown without any."""
    if not verdicts:
        return StopVerdict(unknown={robot: "it did not answer, or has no stop"}, elapsed_ms=elapsed_ms)
    return StopVerdict(
        tuple(dict.fromkeys(name for each in verdicts for name in each.halted)),
        {name: why for each in verdicts for name, why in each.not_stopped.items()},
        {name: why for each in verdicts for name, why in each.unknown.items()},
        elapsed_ms,
        any(each.settling for each in verdicts),
    )


def _verdict(name: str, answer: Answer) -> StopVerdict:
    """Return an answer to an emergency stop as a verdict.

    What is not proven is unknown.
    """
    why = plain_text(answer.why, 500)
    if answer.stopped is False:
        return StopVerdict(not_stopped={name: why or "it did not stop"})
    if answer.stopped is None or answer.refused:
        return StopVerdict(unknown={name: why or "it does not know"})
    if answer.claimed:
        return StopVerdict(unknown={name: "it is claimed to have stopped; its key did not sign that"})
    return StopVerdict(_halted(answer.facts, name), settling=answer.facts.get("settling") is True)


def _halted(fields: Mapping[str, Any], name: str) -> tuple[str, ...]:
    listed = fields.get("halted", fields.get("stopped"))
    halted = [plain_text(each, 100) for each in listed[:HALTED_MAX]] if isinstance(listed, list) else [name]
    return tuple(filter(None, halted))
