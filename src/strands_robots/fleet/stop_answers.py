"""One answer for a stop of many robots, measured by the roster."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import Sending
from strands_robots.safety.sightings import Known
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome, StopRoster
from strands_robots.safety.stopping import explain, grade

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
