"""Emergency stop of the page: one press for every network, answers by name."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

from strands_robots.dashboard.feeds import Feeds
from strands_robots.dashboard.fleet_model import FleetModel, key_of
from strands_robots.fleet.all_stops import for_all
from strands_robots.fleet.fleet_verdict import NetworkVerdict
from strands_robots.fleet.stop_button import StopButton
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.controller import UNCONFIRMED_S
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.statements import Proof
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.utils import plain_text

NOTES_MAX = 16
SILENT_S = 0.9
"""A network whose robots were all silent for longer may be gone."""


class FleetStop:
    """STOP on all networks at once; the answers go into the model.

    The networks' controllers send on connections and threads of their own. A press runs until every expected robot has
    answered, and a further one meanwhile is part of it. On a network that comes later it leaves as
    :class:`~strands_robots.fleet.stop_button.StopButtons` says.
    """

    def __init__(self, model: FleetModel, feeds: Feeds) -> None:
        self._model, self._feeds, self._buttons = model, feeds, feeds.buttons
        self._not_left: Mapping[str, NetworkVerdict] = {}
        self._seen: dict[tuple[str, Scope], tuple[object, bool, frozenset[str]]] = {}
        self._pressed_at: float | None = None
        self._by = ""
        self._for: tuple[Scope, Collection[StopButton]] = (EVERY_ROBOT, ())

    def press(self, who: str = "") -> None:
        """Stop every robot of every network; returns at once.

        Args:
            who: of whose robot the button was, for the timeline; a robot's own button stops all robots, too.
        """
        self._press(EVERY_ROBOT, (), who)
        unsent = self._feeds.unsent
        if unsent:
            threading.Thread(target=self._name_missed, args=(unsent,), name="missed robots", daemon=True).start()

    def press_one(self, robot: str) -> None:
        """Stop and lock every robot of an id, or all where there is none."""
        scope = Scope.named([robot])
        having = [name for name in self._feeds.senders if self._model.row(key_of(name, robot)) is not None]
        if not having or scope.everything:
            self.press(robot)
        else:
            self._press(scope, having, robot)

    def press_cell(self, cell: str) -> None:
        """Stop and lock the robots of a cell and those without one; returns at once.

        It is sent on each network on which such a robot is known. Every robot stops where none is known in the cell.
        """
        scope = Scope.read({"cell": cell})
        if scope.everything or all(row.cell != scope.cell for row in self._model.rows()):
            self.press(cell)
        else:
            self._press(scope, [name for name in self._feeds.senders if self._model.expected(name, scope)], cell)

    def _press(self, scope: Scope, networks: Collection[str], who: str) -> None:
        self._buttons.press(scope, networks)
        self._pressed_at, self._by, self._for = time.time(), who, (scope, self._buttons.latest.values())
        self._not_left = {}

    def _name_missed(self, unsent: Mapping[str, Callable[[], NetworkVerdict]]) -> None:
        """Show the robots of the roster on networks on which a stop of all did not leave."""
        about = {"id": new_epoch(), "at": self._pressed_at, "state": "silent", "ms": None, "signed": False}
        for name, not_left in unsent.items():
            verdict = not_left()
            # Of a network whose roster cannot be read it is not known whether a robot is there.
            if verdict.outcome is not None and not verdict.outcome.size:
                continue
            self._not_left = {**self._not_left, name: verdict}
            for robot in () if verdict.outcome is None else verdict.outcome.report.silent:
                self._model.verdict(name, robot, {**about, "why": f"the stop did not leave: {verdict.absent}"[:300]})

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        running = {network for (network, _), each in self._buttons.every.items() if each.running}
        # Without a link, and without a robot of it, there is nothing to wait for.
        return bool(running) and not running.isdisjoint(self._links())

    def refresh(self) -> None:
        """Put the answers that came since into the model; called repeatedly."""
        self._buttons.review()
        for (network, scope), button in self._buttons.every.items():
            running, progress, report = button.running, button.progress, button.report
            outcome = button.outcome
            latest = report if report is not None and not running else progress
            wider = EVERY_ROBOT if latest is not None and latest.widened else scope
            expected = frozenset(wider.only or self._model.expected(network, wider))
            seen = (latest, running, expected)
            if latest is None or self._seen.get((network, scope)) == seen:
                continue
            self._seen[network, scope] = seen
            measured = outcome if latest is report else None
            for name, verdict in self._verdicts(latest, expected, measured).items():
                self._model.verdict(network, name, verdict)

    def state(self) -> dict[str, Any]:
        """Return whether a stop would leave now, and how the latest one goes on."""
        now, links = self._model.clock(), self._links()
        heard = [row.heard for row in self._model.rows() if row.heard is not None]
        silent_s = round(now - max(heard), 2) if heard else None
        silent = silent_s is not None and silent_s > SILENT_S
        not_left = {name: each for name, each in self._not_left.items() if name not in self._feeds.senders}
        rosters = {name: _roster(each) for name, each in self._measured().items()}
        rosters |= {name: {"ok": False, "sentence": each.sentence, "notes": []} for name, each in not_left.items()}
        return {
            "type": "link",
            "links": links,
            "missing": self._feeds.missing,
            "silent_s": silent_s,
            "silent": silent,
            "can_stop": bool(links) and all(links.values()) and not silent,
            "running": self.running,
            "roster": rosters,
            "pressed_at": self._pressed_at,
            "pressed_by": self._by,
            "pressed_for": self._pressed_for(),
        }

    def _links(self) -> dict[str, bool]:
        """Return by network whether a stop would leave.

        A network without a link and without a robot is left out.
        """
        up = {name: each.link_up for name, each in self._feeds.senders.items()}
        if all(up.values()):
            return up
        having = self._model.networks()
        return {name: is_up for name, is_up in up.items() if is_up or name in having}

    def _measured(self) -> dict[str, StopOutcome]:
        """Return the outcomes of the latest stop of all, where there are robots."""
        found = {name: each.outcome for (name, scope), each in self._buttons.every.items() if scope.everything}
        told = zip(found, for_all([*found.values()]), strict=True)
        outcomes = {name: each for name, each in told if each is not None}
        return {name: each for name, each in outcomes.items() if each.size or each.problems} or outcomes

    def _pressed_for(self) -> str:
        """Return the scope of the latest press; empty for every robot.

        A stop that was widened is one of every robot.
        """
        scope, buttons = self._for
        latest = [each.progress if each.running else each.report for each in buttons]
        widened = any(each is not None and each.widened for each in latest)
        return "" if scope.everything or widened else str(scope)

    def _verdicts(
        self, latest: Progress | StopReport, expected: frozenset[str], outcome: StopOutcome | None
    ) -> dict[str, dict[str, Any]]:
        about = {"id": latest.estop_id, "at": self._pressed_at}
        answered = latest.answered
        late = latest.elapsed_ms >= UNCONFIRMED_S * 1000
        found = {name: verdict_of(answer, latest.left_ms) for name, answer in answered.items()}
        reasons = {} if outcome is None else outcome.reasons
        told = set() if outcome is None else {*outcome.others.silent}
        missing = {*expected, *(latest.unconfirmed if isinstance(latest, Progress) else ())}
        missing |= {*outcome.report.silent} if outcome is not None else set()
        for name in missing - answered.keys():
            state = "heard_only" if name in told else "silent" if late else "waiting"
            found[name] = {"state": state, "why": reasons.get(name, "")[:300], "ms": None, "signed": False}
        for name, why in latest.alarms.items():
            own = found.get(name)
            if own is None or own["state"] in ("silent", "waiting", "claimed"):
                found[name] = {"state": "alarm", "why": why, "ms": None, "signed": False}
            else:
                own["alarm"] = why
        return {name: {**verdict, **about} for name, verdict in found.items()}


def verdict_of(answer: Answer, left_ms: float) -> dict[str, Any]:
    """Return one robot's answer as the page shows it.

    Its ``state`` is stopped, claimed, not_stopped, refused or unknown: *stopped* only for a robot that said so itself,
    with the signature that it owes.
    """
    if answer.refused:
        state = "refused"
    elif answer.stopped is True:
        state = "claimed" if answer.claimed else "stopped"
    elif answer.stopped is False:
        state = "not_stopped"
    else:
        state = "unknown"
    settling = answer.facts.get("settling") is True
    return {
        "state": state,
        "why": answer.why[:300],
        "ms": round(max(answer.latency_ms, 0.0), 1),
        "left_ms": round(left_ms, 1),
        "signed": answer.proof is Proof.SIGNED,
        **({"settling": True} if settling else {}),
    }


def _roster(outcome: StopOutcome) -> dict[str, Any]:
    """Return what the page says of a stop besides each robot's answer."""
    return {
        "ok": outcome.ok,
        "sentence": outcome.sentence,
        "notes": [plain_text(each, 300) for each in stop_notes(outcome)[:NOTES_MAX]],
    }
