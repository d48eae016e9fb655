"""Robots of the page by their rows: called on one network, stopped on all.

An id on several networks is one robot where one key signs on all of them, and has one row. Otherwise each network has
a row and a robot of its own, and a motion is sent to none of them, unless the key of one is enrolled.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from strands_robots.dashboard.feeds import Feeds, FleetFeed
from strands_robots.dashboard.fleet_model import FleetModel, key_of
from strands_robots.dashboard.history import RobotRow
from strands_robots.envelope import Envelope, error
from strands_robots.errors import AmbiguousRobotError
from strands_robots.fleet.adapter import NetworkAdapter, bears
from strands_robots.fleet.safety_console import StopButton
from strands_robots.fleet.shared_id import DECIDED_S, SharedId, decided
from strands_robots.fleet.stops import for_all
from strands_robots.fleet.verdicts import NetworkVerdict
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.controller import UNCONFIRMED_S
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.statements import Proof
from strands_robots.safety.stop_notes import stop_notes
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.safety.stopping import grade
from strands_robots.utils import ValidationError, plain_text, shown

logger = logging.getLogger(__name__)

ASK_AGAIN_S = 5.0
"""Seconds until robots of one id of which no key decides are asked again for their keys."""

PARALLEL = 8

AMBIGUOUS = "ambiguous"
"""Code of the refusal of a motion that no key decides."""

_ORDER = (False, None, True)
"""Answers to a stop from the worst: it did not stop, it is not known, it did."""

NOTES_MAX = 16
SILENT_S = 0.9
"""A network whose robots were all silent for longer may be gone."""


@dataclass(slots=True)
class _Shared:
    """An id on several networks: what its keys prove, and when they were asked for."""

    proof: SharedId = field(default_factory=SharedId)
    sessions: object = None
    asked_at: float = float("-inf")
    asking: asyncio.Future[Any] | None = None


@dataclass(frozen=True, slots=True)
class PageRobot:
    """One row's robot.

    Attributes:
        feed: the network that it is called on.
        id: its id there.
    """

    feed: FleetFeed
    id: str
    _robots: PageRobots

    async def call(self, verb: str, params: Mapping[str, Any], seconds: float, *, moves: bool = False) -> Envelope:
        """Call a verb; every failure is an answer of status error.

        Args:
            verb: its name on the network.
            params: the arguments.
            seconds: in which it has to answer.
            moves: it moves the robot, so that only one robot of this id may get it.
        """
        why = await self._robots.refusal(self, verb) if moves else ""
        return error(why, code=AMBIGUOUS) if why else await self.feed.call(self.id, verb, params, seconds)

    async def stop(self) -> Envelope:
        """Stop every robot of this id, without a lockout; graded, never raises.

        Of one robot on several networks the first answer that settles it counts, of several robots the worst.
        """
        return await self._robots.stop(self)


class PageRobots:
    """Robots by the keys of their rows.

    Args:
        model: the fleet.
        feeds: of the joined networks.
    """

    def __init__(self, model: FleetModel, feeds: Feeds) -> None:
        self._model, self._feeds = model, feeds
        self._shared: dict[str, _Shared] = {}
        self._stops: set[asyncio.Task[Envelope]] = set()
        # A robot that is silent keeps a thread for seconds.
        self._pool = ThreadPoolExecutor(PARALLEL, "dashboard keys")

    def of(self, key: str) -> PageRobot:
        """Return the robot of a row.

        Raises:
            ValidationError: no such row, or its network is not joined.
        """
        row = self._model.row(key)
        if row is None:
            raise ValidationError(f"No robot {shown(key)} is known.")
        feed = self._feeds.get(row.network)
        if feed is None:
            raise ValidationError(f"{row.id} is out of reach: its network is not joined.")
        return PageRobot(feed, row.id, self)

    async def refusal(self, robot: PageRobot, verb: str) -> str:
        """Return why a motion is not sent to a robot, or ""."""
        bearers, joining = self._bearers(robot), self._feeds.networks
        several = len(bearers) > 1
        if not several and len(joining.joined) == len(joining.stated):
            return ""
        proof = self._shared.setdefault(robot.id, _Shared()).proof
        alive = [each.there for each in bearers if each is robot.feed or self._alive(each, robot.id)]

        def choose() -> NetworkAdapter:
            absent = joining.enrolled_on_absent(robot.id)
            if not several and not absent:
                return robot.feed.there
            # A network on which the robot is silent is not waited for, as long as its key proves it.
            proven = proof.key is not None and proof.decide(robot.id, alive, absent)
            if proven and proof.key is not None:
                return proven
            return decided(proof, robot.id, verb, [each.there for each in bearers], absent)

        try:
            network = await asyncio.to_thread(choose)
        except AmbiguousRobotError as refused:
            return f"{refused.why}.{' Give one of them another id.' if several else ''}"
        if proof.key is not None or network is robot.feed.there:
            return ""
        return f"{verb} is not sent to {robot.feed.there.name}: the enrolled robot of this id is on {network.name}."

    async def stop(self, robot: PageRobot) -> Envelope:
        """Stop every robot of an id; see :meth:`PageRobot.stop`."""
        bearers = self._bearers(robot)
        if len(bearers) == 1:
            return await robot.feed.stop(robot.id)
        sent = [asyncio.create_task(each.stop(robot.id)) for each in bearers]
        for each in sent:
            # One that is waited for no more goes on by itself.
            self._stops.add(each)
            each.add_done_callback(self._stops.discard)
        shared = self._shared.get(robot.id)
        if shared is None or shared.proof.key is None:
            return min(await asyncio.gather(*sent), key=lambda answer: _ORDER.index(grade(answer).stopped))
        for answered in asyncio.as_completed(sent):
            answer = await answered
            if grade(answer).stopped is not None:
                break
        return answer

    def look(self, in_use: Collection[str]) -> None:
        """Show robots that are on several networks once; called repeatedly.

        Args:
            in_use: keys of rows that a page looks at or holds, which stay.
        """
        hidden, namesakes = set[str](), set[str]()
        several = self._model.on_several_networks()
        for name, rows in several.items():
            ordered = sorted(rows, key=self._place)
            shared = self._shared.setdefault(name, _Shared())
            self._ask(name, shared, ordered)
            if shared.proof.key is not None:
                lasting = self._lasting(ordered)
                after = [each for each in ordered[ordered.index(lasting) + 1 :] if each.key not in in_use]
                hidden |= {each.key for each in after if not self._model.unsettled(each) or _says_it(lasting, each)}
            seen = {each.key for each in ordered} - hidden
            namesakes |= seen if len(seen) > 1 else set()
        self._model.arrange(hidden, namesakes)
        for name in self._shared.keys() - several.keys():
            del self._shared[name]

    def network_key(self, feed: FleetFeed) -> NetworkKey | None:
        """Return the name under which the robots of a network are remembered, or None."""
        sender = self._feeds.senders.get(feed.network)
        return None if sender is None else sender.network

    def close(self) -> None:
        """Ask for no more keys."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def twins(self, key: str) -> list[str]:
        """Return the keys of a row and of the hidden rows of the same robot."""
        row = self._model.row(key)
        rows = () if row is None else self._model.on_several_networks().get(row.id, ())
        return [key, *(each.key for each in rows if each.hidden and each.key != key)]

    def _ask(self, name: str, shared: _Shared, rows: Sequence[RobotRow]) -> None:
        """Have the keys asked for where a robot may be another one than before."""
        feeds = [self._feeds.get(each.network) for each in rows if not self._model.silent(each)]
        alive = [each for each in feeds if each is not None]
        if len(alive) < 2 or (shared.asking is not None and not shared.asking.done()):
            return
        sessions, now = [each.session(name) for each in alive], time.monotonic()
        again = ASK_AGAIN_S if shared.proof.decided is None else DECIDED_S
        if sessions == shared.sessions and now - shared.asked_at < again:
            return
        shared.sessions, shared.asked_at = sessions, now

        def ask() -> None:
            try:
                shared.proof.decide(name, [each.there for each in alive])
            except Exception:
                logger.exception("Robots could not be asked for their keys.")

        shared.asking = asyncio.get_running_loop().run_in_executor(self._pool, ask)

    def _bearers(self, robot: PageRobot) -> list[FleetFeed]:
        return [each for each in self._feeds.joined if each is robot.feed or bears(each.there, robot.id)]

    def _alive(self, feed: FleetFeed, name: str) -> bool:
        row = self._model.row(key_of(feed.network, name))
        return row is not None and not self._model.silent(row)

    def _lasting(self, rows: Sequence[RobotRow]) -> RobotRow:
        """Return the row to show: the first, or one heard since that fell silent."""
        first = rows[0]
        heard, since = first.heard or 0.0, self._model.history.silent_s / 2
        alive = (each for each in rows if not self._model.silent(each) and (each.heard or 0.0) > heard + since)
        return next(alive, first) if self._model.silent(first) else first

    def _place(self, row: RobotRow) -> int:
        networks = [each.network for each in self._feeds.joined]
        return networks.index(row.network) if row.network in networks else len(networks)


def _says_it(shown: RobotRow, other: RobotRow) -> bool:
    """Return whether a row says of the latest stop all that another row says of it."""
    stop, same = other.stop or {}, shown.stop or {}
    repeats = all(each in same and same[each] == stop.get(each) for each in ("id", "state"))
    return repeats and not (other.alarm or other.doubt or "alarm" in stop)


class FleetStop:
    """STOP on all networks at once; the answers go into the model.

    The networks' controllers send on connections and threads of their own. A press runs until every expected robot has
    answered, and a further one meanwhile is part of it. On a network that comes later it leaves as
    :class:`~strands_robots.fleet.safety_console.StopButtons` says.
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
        measured = zip(found, for_all([*found.values()]), strict=True)
        outcomes = {name: each for name, each in measured if each is not None}
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
        heard_only = set() if outcome is None else {*outcome.others.silent}
        missing = {*expected, *(latest.unconfirmed if isinstance(latest, Progress) else ())}
        missing |= {*outcome.report.silent} if outcome is not None else set()
        for name in missing - answered.keys():
            state = "heard_only" if name in heard_only else "silent" if late else "waiting"
            found[name] = {"state": state, "why": reasons.get(name, "")[:300], "ms": None, "signed": False}
        for name, why in latest.alarms.items():
            known = found.get(name)
            if known is None or known["state"] in ("silent", "waiting", "claimed"):
                found[name] = {"state": "alarm", "why": why, "ms": None, "signed": False}
            else:
                known["alarm"] = why
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
