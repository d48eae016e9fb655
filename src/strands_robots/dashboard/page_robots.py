"""Robots of the page by their rows: called on one network, stopped on all.

An id on several networks is one robot where one key signs on all of them, and has one row. Otherwise each network has
a row and a robot of its own, and a motion is sent to none of them, unless the key of one is enrolled.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from strands_robots.dashboard.feed import FleetFeed
from strands_robots.dashboard.feeds import Feeds
from strands_robots.dashboard.fleet_model import FleetModel, RobotRow, key_of
from strands_robots.envelope import Envelope, error
from strands_robots.errors import AmbiguousRobotError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.networks import bears
from strands_robots.fleet.shared_id import DECIDED_S, SharedId, decided
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.stopping import grade
from strands_robots.utils import ValidationError, shown

logger = logging.getLogger(__name__)

ASK_AGAIN_S = 5.0
"""Seconds until robots of one id of which no key decides are asked again for their keys."""

PARALLEL = 8

AMBIGUOUS = "ambiguous"
"""Code of the refusal of a motion that no key decides."""


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
        networks = [each.there for each in alive]
        work: Callable[[], object] = lambda: _quietly(lambda: shared.proof.decide(name, networks))  # noqa: E731
        shared.asking = asyncio.get_running_loop().run_in_executor(self._pool, work)

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


_ORDER = (False, None, True)
"""Answers to a stop from the worst: it did not stop, it is not known, it did."""


def _says_it(shown: RobotRow, other: RobotRow) -> bool:
    """Return whether a row says of the latest stop all that another row says of it."""
    stop, same = other.stop or {}, shown.stop or {}
    told = all(each in same and same[each] == stop.get(each) for each in ("id", "state"))
    return told and not (other.alarm or other.doubt or "alarm" in stop)


def _quietly(work: Callable[[], object]) -> None:
    try:
        work()
    except Exception:
        logger.exception("Robots could not be asked for their keys.")
