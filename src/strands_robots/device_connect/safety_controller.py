"""A safety controller on Device Connect."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping
from typing import Any

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.config import enrolled_robots, network_of, usual_link
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.envelope import Envelope, error, success, text_of
from strands_robots.safety.answers import StopReport
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.roster import Roster
from strands_robots.safety.standing_roster import StandingRoster, controllers_identity
from strands_robots.safety.stop_link import STOP_ROSTER, notification
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome, robots_known_at


def safety_controller(controller_id: str, link: LinkConfig | None = None, **options: Any) -> SafetyController:
    """Return a :class:`SafetyController` on ``link``, else on the environment's.

    Further arguments are those of :class:`SafetyController`. The robots enrolled at this machine have to sign, and its
    roster says whether a stop of some robots means one that is known.
    """
    link = link or usual_link()
    options.setdefault("enrolled", lambda: enrolled_robots(link))
    options.setdefault("remembers", robots_known_at(lambda: network_of(link)))
    options.setdefault("network", network_of(link))
    return SafetyController(controller_id, lambda: stop_link(link), **options)


def stand(
    controller: SafetyController, link: LinkConfig, also: Callable[[], Collection[str]] = tuple
) -> StandingRoster:
    """Have a controller report whom it misses after the stop of another one.

    Args:
        controller: made with ``stands``.
        link: its network.
        also: returns names that it shows besides its roster.
    """
    network = network_of(link)
    standing = StandingRoster(
        controller.controller_id,
        lambda fields: controller.publish(STOP_ROSTER, notification(STOP_ROSTER, fields)),
        roster=lambda: Roster.of(network),
        keys=lambda: enrolled_robots(link),
        identity=functools.cache(lambda: controllers_identity(controller.controller_id, controller.signing_key)),
        also=also,
    )
    controller.hear_others(standing.hear)
    return standing


def envelope(report: StopReport, reasons: Mapping[str, str] | None = None) -> Envelope:
    """Return the report as an answer, an error unless every robot stopped.

    Args:
        reasons: of silent robots.
    """
    fields: dict[str, Any] = {
        "estop_id": report.estop_id,
        "stopped": {name: round(each.latency_ms, 3) for name, each in report.stopped.items()},
        "not_stopped": {name: each.why for name, each in report.not_stopped.items()},
        "refused": {name: each.why for name, each in report.refused.items()},
        "silent": list(report.silent),
        "claimed": sorted(report.claimed),
        "alarms": dict(report.alarms),
        "link": report.link,
        "elapsed_ms": round(report.elapsed_ms, 3),
        "left_ms": round(report.left_ms, 3),
        **report.scope.field(),
        **({"widened": True} if report.widened else {}),
    }
    if report.ok:
        return success(f"Stopped {', '.join(sorted(report.stopped))}.", **fields)
    failures = [f"{name} did not stop" for name in report.not_stopped]
    failures += [f"{name} did not act on it" for name in report.refused]
    failures += [f"ALARM: {name}: {report.alarms[name]}" for name in report.alarmed]
    failures += [f"{name} is only claimed to have stopped: it did not sign" for name in report.claimed]
    why = reasons or {}
    failures += [f"{name} gave no answer{f' ({why[name]})' if name in why else ''}" for name in report.silent]
    if not report.link:
        failures.append("the stop was not sent: the link is down")
    failures += [report.widening] if report.widening else []
    return error(f"{'; '.join(failures) or 'No robot answered the emergency stop'}.", **fields)


def outcome_envelope(outcome: StopOutcome) -> Envelope:
    """Return the outcome as an answer, an error unless all of the roster stand still."""
    answer = envelope(outcome.report, outcome.reasons)
    fields = {name: value for name, value in answer.items() if name not in ("status", "content", "reason")}
    free = [f"Not locked: {', '.join(outcome.not_locked)}."] if outcome.not_locked else []
    said = " ".join([text_of(answer), outcome.sentence, *free, *stop_notes(outcome)])
    fields |= {"not_locked": list(outcome.not_locked)} if outcome.not_locked else {}
    return (success if outcome.ok else error)(said, **fields, **outcome.facts())
