"""Outcome of a stop of all robots, on every network of a fleet."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from strands_robots.envelope import Envelope
from strands_robots.safety.answers import Answer
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.safety.stopping import StopVerdict, graded
from strands_robots.utils import plain_text

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
