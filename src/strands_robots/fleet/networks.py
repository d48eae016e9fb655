"""Networks of one caller as one: each robot is called on the network that has it."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Self, TypeVar

from strands_robots.envelope import Envelope, error
from strands_robots.errors import NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.fleet.adapter import (
    CLOSED,
    FIND_S,
    STOP_S,
    Detail,
    FoundRobot,
    NetworkAdapter,
    OnEvent,
    bears,
    reaches,
    silent,
)
from strands_robots.fleet.joining import Joining, on_own_thread, side_by_side, those
from strands_robots.serving.advertised import READS, RESUMES, STOPS
from strands_robots.utils import near, plain_text

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

    from strands_robots.fleet.shared_id import SharedId
    from strands_robots.safety.network_key import NetworkKey
    from strands_robots.safety.stopping import StopVerdict
    from strands_robots.serving.advertised import AdvertisedVerb

logger = logging.getLogger(__name__)

BUSY_S = 3.0
"""Seconds in which a stop tries to join a network that takes connections and does not answer."""

SHARED_IDS_MAX = 1024
"""Ids on several networks of which the decided network is remembered."""

ASKING_MAX = 64
"""Robots at a time of which callers on an event loop ask which network has them."""

R = TypeVar("R")

STILL = READS | STOPS | RESUMES | {"wait"}
"""Verbs of our robots that move nothing."""


class Networks:
    """Networks as one: robots of all of them, each called on the network that has it.

    An id on several networks is one robot where one key signs both of its answers, as
    :class:`~strands_robots.fleet.shared_id.SharedId` decides; motions go to the network that it names. A stop goes to
    every network, as soon as that is joined.

    Args:
        stated: the networks to join, the one whose robots win an id first.
        absent: networks that are not joined, with the reason.
        keys: names of absent networks under which their robots are remembered, so that a stop names these.
        stays: go on trying to join those that are not there yet.
        unasked: networks that no one asked for, so that their absence is not told.

    Attributes:
        stated: as given.
        keys: as given.
        unasked: as given.
        absent: networks that are not joined or do not answer, with the reason.
    """

    def __init__(
        self,
        stated: Sequence[NetworkAdapter],
        absent: Mapping[str, str] | None = None,
        keys: Mapping[str, Callable[[], NetworkKey]] | None = None,
        *,
        stays: bool = False,
        unasked: Collection[str] = (),
    ) -> None:
        self.stated = tuple(stated)
        self.unasked = frozenset(unasked)
        self.absent: dict[str, str] = dict(absent or {})
        self.keys = dict(keys or {})
        self._stays = stays
        self._opened = self._closed = False
        self._joinings: tuple[Joining, ...] = ()
        self._last: tuple[Joining, ...] = ()
        self._change = threading.Condition()
        self._listeners: list[Callable[[NetworkAdapter], None]] = []
        self._told: list[NetworkAdapter] = []
        self._shared_ids: dict[str, SharedId] = {}
        self._asking: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def open(self, *, in_turn: bool = False) -> None:
        """Begin to join all networks; return once one of them is joined.

        Args:
            in_turn: join the others only once the first one cannot be joined, or lacks what is asked for.

        Raises:
            UnreachableError: none of them can be reached, and they do not stay.
        """
        self._closed = False
        try:
            if in_turn and self.stated and not self._stays:
                self._attempts()[0].begin(here=True)
            if not self.joined:
                self.begin(here=len(self.stated) == 1 and not self._stays)
            with self._change:
                self._change.wait_for(lambda: self.joined or all(each.attempted.is_set() for each in self._joinings))
        except BaseException:
            self.close()
            raise
        unexpected = next((each.unexpected for each in self._joinings if each.unexpected), None)
        if not self.joined and (unexpected or not self._stays):
            self.close()
            raise unexpected or UnreachableError(self.absences)

    def begin(self, *, here: bool = False) -> None:
        """Begin to join all networks, and return at once.

        Args:
            here: join them on this thread, and return once that is over.
        """
        self._closed = False
        for each in self._attempts():
            each.begin(here=here)

    def close(self) -> None:
        """Leave the networks."""
        with self._change:
            self._closed, self._opened = True, False
            joinings, self._joinings = self._joinings, ()
            asking, self._asking = self._asking, None
            self._told.clear()
        if asking is not None:
            asking.shutdown(wait=False)
        for each in joinings:
            each.close()

    def on_joined(self, callback: Callable[[NetworkAdapter], None]) -> None:
        """Call back with each network that is joined, now or later; on any thread."""
        with self._change:
            self._listeners.append(callback)
            joined = tuple(self._told)
        for each in joined:
            _tell(callback, each)

    @property
    def joined(self) -> tuple[NetworkAdapter, ...]:
        """The networks that are joined now."""
        return tuple(each.network for each in self._joinings if each.up)

    def check_opened(self) -> None:
        """Refuse networks that were not opened, or are closed.

        Raises:
            UnreachableError: as it says.
        """
        if not self._opened:
            raise UnreachableError("not joined: use it as a context manager", remedy="with connect() as fleet: ...")

    def settled(self) -> tuple[NetworkAdapter, ...]:
        """Return the joined networks, once the first attempt to join each is over.

        Raises:
            UnreachableError: there is none.
        """
        self.check_opened()
        for each in self._joinings:
            each.begin()
        for each in self._joinings:
            each.attempted.wait()
        joined = self.joined
        if not joined:
            raise UnreachableError(self.absences or CLOSED)
        return joined

    def awaited(self, network: NetworkAdapter, *, stops: bool = False) -> str:
        """Wait for the first attempt to join; return why it is not joined, or "".

        The attempt is made here where none was begun. For a stop, a network that is busy is tried again: on a loaded
        machine it may answer late.
        """
        joining = next((each for each in self._attempts() if each.network is network), None)
        if joining is None:
            return CLOSED
        joining.begin(here=not self._stays)
        joining.attempted.wait()
        if stops:
            joining.insist(BUSY_S)
        return "" if joining.up else joining.why or CLOSED

    @property
    def missing(self) -> dict[str, str]:
        """The absent networks that someone asked for, with their reasons."""
        return {name: why for name, why in self.absent.copy().items() if name not in self.unasked}

    @property
    def absences(self) -> str:
        """Reasons why networks are absent, first of those that someone asked for."""
        stated = self.missing or self.absent.copy()
        if len(stated) == 1:
            return next(iter(stated.values()))
        return "; ".join(f"{name}: {why.rstrip('.')}" for name, why in stated.items())

    @property
    def reach(self) -> str:
        """The places where robots are looked for, in words."""
        return " ".join(each.place.text for each in self.joined)

    @property
    def stale(self) -> str:
        """Reasons why the last search may have missed robots, or ""."""
        return " ".join(filter(None, (each.stale for each in self.joined)))

    def on_each(
        self,
        work: Callable[[NetworkAdapter], list[Any]],
        failed: str,
        fatal: tuple[type[Exception], ...] = (),
    ) -> list[tuple[NetworkAdapter, list[Any]]]:
        """Return what ``work`` lists on each network, side by side.

        One that fails is named in :attr:`absent` until it answers again.

        Args:
            work: asks one network.
            failed: the log's words for one that fails.
            fatal: exceptions that are raised, because no network is at fault.

        Raises:
            UnreachableError: all fail.
        """

        def asked(network: NetworkAdapter) -> list[Any] | str:
            try:
                return work(network)
            except RefusalError as exc:
                return exc.why
            except fatal:
                raise
            except Exception as exc:  # noqa: BLE001 - the other networks have their robots
                return plain_text(f"{type(exc).__name__}: {exc}")

        joined, listed = self.settled(), list[tuple[NetworkAdapter, list[Any]]]()
        for network, answer in zip(joined, side_by_side(asked, joined), strict=True):
            self.absent.pop(network.name, None)
            if isinstance(answer, str):
                logger.warning("%s: %s: %s", network.name, failed, answer)
                self.absent[network.name] = answer
            else:
                listed.append((network, answer))
        if not listed:
            raise UnreachableError(self.absences)
        return listed

    def find(
        self, timeout: float | None = FIND_S, *, peers: bool = False
    ) -> dict[str, tuple[FoundRobot, NetworkAdapter]]:
        """Look for robots; return each with the network that it is called on.

        Args:
            timeout: seconds at most, as of :meth:`NetworkAdapter.find`.
            peers: peers without a robot, too.

        Raises:
            UnreachableError: no network answers.
        """
        found: dict[str, tuple[FoundRobot, NetworkAdapter]] = {}
        # The first network is the last to write, so its robots win an id.
        for network, robots in reversed(
            self.on_each(lambda each: each.find(timeout, peers=peers), "robots cannot be looked for")
        ):
            # Locked on one of two networks is locked.
            locked = {each.id for each in robots if each.id in found and found[each.id][0].locked}
            found |= {each.id: (replace(each, locked=True) if each.id in locked else each, network) for each in robots}
        return found

    def bearers(self, robot: str) -> list[NetworkAdapter]:
        """Return the networks on which a robot of this id is known; asks no one."""
        return [each for each in self.joined if bears(each, robot)]

    def of(self, robot: str, verb: str = "", *, moves: bool = False) -> NetworkAdapter:
        """Return the network on which a robot is called.

        It is waited for as long as a network takes to know its robots; a motion waits for every network.

        Args:
            robot: its id.
            verb: for the refusal.
            moves: the verb moves the robot, so that only one robot of this id may get it.

        Raises:
            NoSuchRobotError: no network has it; the message names similar ones.
            AmbiguousRobotError: two have it, and no key decides.
        """
        joined = self.settled()
        if (network := self._at_once(robot, moves=moves)) is not None:
            return network
        bearers = self.bearers(robot)
        if len(bearers) < len(joined):
            bearers = those(lambda each: reaches(each, robot), joined, every=moves)
        if not bearers:
            remedy = near(robot, {name for each in joined for name in each.announced()}).strip()
            raise NoSuchRobotError(f"No robot {robot[:100]!r} is in reach", robot=robot, verb=verb, remedy=remedy)
        return self._chosen(robot, verb, bearers, moves=moves)

    def instead(self, robot: str, verb: str, gone: NetworkAdapter, *, moves: bool) -> NetworkAdapter | None:
        """Return the network that still has a robot which left another one, or None.

        Args:
            robot: its id.
            verb: for the refusal.
            gone: the network that no longer has it.
            moves: as of :meth:`of`, which names what is raised.
        """
        others = [each for each in self.bearers(robot) if each is not gone and not silent(each, robot)]
        return self._chosen(robot, verb, others, moves=moves) if others else None

    def enrolled_on_absent(self, robot: str) -> dict[str, bytes]:
        """Return the keys of an id that are enrolled on absent networks, by network."""
        joined, keys = self.joined, dict[str, bytes]()
        for each in self.stated:
            if each not in joined:
                # A mesh of this machine that is not there has none.
                with suppress(RefusalError):
                    if key := each.enrolled_key(robot):
                        keys[each.name] = key
        return keys

    def decided(self, robot: str) -> NetworkAdapter | None:
        """Return the network that was decided on, where it still has the robot."""
        known = self._shared_ids.get(robot)
        return known.decided if known is not None and known.decided in self.bearers(robot) else None

    def announced(self) -> Collection[str]:
        """Return robots that have announced themselves; asks no one."""
        return {name: None for each in self.joined for name in each.announced()}

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions as they came over the wire; raises as :meth:`of`."""
        return self.of(robot).describe(robot, anew=anew)

    def described(self, robot: str, verb: str) -> tuple[NetworkAdapter, AdvertisedVerb | None]:
        """Return the network that a call goes to, and the verb as its robot describes it.

        Whether it moves the robot is known by its name, or else by that description.

        Raises:
            RefusalError: as :meth:`of`.
        """
        network = self.of(robot, verb)
        described = network.verb(robot, verb)
        if verb in STILL or (described is not None and described.kind != "motion"):
            return network, described
        decided = self.of(robot, verb, moves=True)
        return decided, described if decided is network else decided.verb(robot, verb)

    def call(
        self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float, *, moves: bool = True
    ) -> Envelope:
        """Call a verb on the network that has the robot; stop it on every network.

        Raises:
            RefusalError: as :meth:`NetworkAdapter.call`, or as :meth:`of`.
        """
        if verb in STOPS and len(self.stated) > 1:
            name, unread = _meant(arguments)
            return _one_answer(robot, self.stop(robot, timeout, name), unread)
        if len(self.joined) == 1 and not moves:
            # The others are not joined before the first one lacks the robot.
            try:
                return self.joined[0].call(robot, verb, arguments, timeout)
            except NoSuchRobotError:
                if len(self.settled()) == 1:
                    raise
        network = self.of(robot, verb, moves=moves)
        try:
            return network.call(robot, verb, arguments, timeout)
        except NoSuchRobotError:
            other = self.instead(robot, verb, network, moves=moves)
            if other is None:
                raise
        return other.call(robot, verb, arguments, timeout)

    async def call_async(
        self, robot: str, verb: str, arguments: Mapping[str, Any], within: float, *, moves: bool = True
    ) -> Envelope:
        """Call a verb from an event loop; every failure is an answer of status error."""

        async def called() -> Envelope:
            if verb in STOPS and len(self.stated) > 1:
                name, unread = _meant(arguments)
                return _one_answer(robot, await self.stop_async(robot, within, name), unread)
            return await self.called_on(
                robot, verb, lambda network: network.call_async(robot, verb, arguments, within), moves=moves
            )

        from strands_robots.fleet.reports import answered  # noqa: PLC0415 - a stop need not load it

        return await answered(called())

    async def called_on(
        self, robot: str, verb: str, call: Callable[[NetworkAdapter], Awaitable[R]], *, moves: bool
    ) -> R:
        """Call on the network of a robot, or on that to which it has just moved."""
        network = await self.of_async(robot, verb, moves=moves)
        try:
            return await call(network)
        except NoSuchRobotError:
            other = await self._off_loop(partial(self.instead, robot, verb, network, moves=moves))
            if other is None:
                raise
        return await call(other)

    async def of_async(self, robot: str, verb: str = "", *, moves: bool = False) -> NetworkAdapter:
        """Do as :meth:`of`, without blocking the event loop."""
        if (network := self._at_once(robot, moves=moves)) is not None:
            return network
        return await self._off_loop(partial(self.of, robot, verb, moves=moves))

    async def _off_loop(self, work: Callable[[], R]) -> R:
        """Return what ``work`` returns, on a thread that no stop needs."""
        from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415 - a command need not load it

        with self._change:
            if self._closed:
                raise UnreachableError(CLOSED)
            if self._asking is None:
                self._asking = ThreadPoolExecutor(ASKING_MAX, "networks")
            begun = self._asking.submit(work)
        return await asyncio.wrap_future(begun)

    def stop(self, robot: str, timeout: float = STOP_S, robot_name: str = "") -> dict[str, Envelope]:
        """Stop every bearer of an id; return the answers by network.

        It is sent on every network as soon as that is up. One that does not know the robot has no answer; one that
        remembers it, and where it is silent or the stop did not leave, has one of unknown outcome. Of a robot that none
        knows the first network's answer is returned. The networks need not be opened. It never raises for one that
        fails.

        Args:
            robot: its id.
            timeout: seconds in which it has to answer.
            robot_name: stops one robot of a world alone.
        """
        alone = len(self.stated) == 1
        said = self._stopped(self.stated, robot, timeout, robot_name, insist=alone)
        again: dict[NetworkAdapter, Envelope | None] = {}
        if not alone and not any(_graded(each) for each in said.values()):
            # A robot that no network knows may be slow to answer: it is stopped again, and waited for.
            rest = [network for network, each in said.items() if each is None]
            again = self._stopped(rest, robot, timeout, robot_name, insist=True)
            said |= {network: each for network, each in again.items() if _graded(each)}
        unknown = {each.name: answer for each, answer in again.items() if answer is not None}
        return self._with_silent(robot, said) or dict(list(unknown.items())[:1])

    def halt(self, robot: str, robot_name: str = "") -> StopVerdict:
        """Stop every bearer of an id; return the verdict."""
        from strands_robots.fleet.verdicts import (  # noqa: PLC0415 - a call need not load it
            by_bearer,
            combined,
            verdict_of_answer,
        )

        began, answers = time.monotonic(), self.stop(robot, robot_name=robot_name)
        name = f"{robot}/{robot_name}" if robot_name else robot
        verdicts = [verdict_of_answer(said, bearer) for bearer, said in by_bearer(name, answers).items()]
        return combined(name, verdicts, (time.monotonic() - began) * 1000)

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> dict[str, Envelope]:
        """Do as :meth:`stop`, from an event loop.

        Once a robot has answered, networks that are still being joined, or may never know that they lack it, are not
        waited for.
        """

        async def stopped(joining: Joining) -> Envelope | None:
            if not joining.attempted.is_set():
                # Not on a thread of the loop's, which may all be taken.
                await asyncio.wrap_future(on_own_thread(joining.attempted.wait))
            if not joining.up:
                return None
            try:
                return await joining.network.stop_async(robot, within, robot_name)
            except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
                return _failed(exc)

        joinings = {asyncio.ensure_future(stopped(each)): each for each in self._joinings}
        answers = dict[NetworkAdapter, Envelope | None](dict.fromkeys(self.stated))
        pending = set(joinings)
        while pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            answers |= {joinings[each].network: _result(each) for each in done}
            rest = [joinings[each] for each in pending if joinings[each].up]
            if any(map(_graded, answers.values())) and not any(
                each.network.tells_absence or bears(each.network, robot) for each in rest
            ):
                break
        said = {each: None if _absent(each, robot, answer) else answer for each, answer in answers.items()}
        known = await asyncio.wrap_future(on_own_thread(lambda: self._with_silent(robot, said)))
        unknown = {each.name: answer for each, answer in answers.items() if answer is not None}
        return (
            known
            or dict(list(unknown.items())[:1])
            or {each.name: _not_left(each, self.absent) for each in self.stated}
        )

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        """Receive a robot's events on every network, also on those that are joined later.

        Returns:
            What ends it.
        """
        ends, lock, over = list[Callable[[], None]](), threading.Lock(), threading.Event()

        def follow(network: NetworkAdapter) -> None:
            try:
                end = network.subscribe(robot, on_event, detail)
            except RefusalError as exc:
                logger.warning("Events on %s cannot be received: %s", network.name, exc)
                return
            with lock:
                if not over.is_set():
                    ends.append(end)
                    return
            end()

        self.on_joined(follow)

        def end_all() -> None:
            with self._change:
                self._listeners[:] = [each for each in self._listeners if each is not follow]
            with lock:
                over.set()
                begun, ends[:] = list(ends), []
            for end in begun:
                end()

        return end_all

    def _attempts(self) -> tuple[Joining, ...]:
        """Return the attempts to join each network; none once they were left."""
        with self._change:
            if not self._opened and not self._closed:
                self._opened = True
                self._joinings = self._last = tuple(
                    Joining(each, again=self._stays, changed=self._changed, before=last)
                    for each, last in zip_longest(self.stated, self._last)
                )
            return self._joinings

    def _changed(self, joining: Joining) -> None:
        if joining.up:
            self.absent.pop(joining.network.name, None)
        elif joining.why:
            self.absent[joining.network.name] = joining.why
        with self._change:
            self._change.notify_all()
            listeners = list(self._listeners) if joining.up else []
            self._told += [joining.network] if joining.up else []
        for each in listeners:
            _tell(each, joining.network)

    def _stopped(
        self, networks: Sequence[NetworkAdapter], robot: str, timeout: float, robot_name: str, *, insist: bool
    ) -> dict[NetworkAdapter, Envelope | None]:
        """Stop a robot on each network; return the answers, None where it is not."""

        def stopped(network: NetworkAdapter) -> Envelope | None:
            try:
                # Each stop leaves as soon as its network is up.
                if not self.awaited(network, stops=True):
                    return network.stop(robot, timeout, robot_name, insist=insist)
            except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
                return _failed(exc)
            return _not_left(network, self.absent) if insist and not self.joined else None

        return dict(zip(networks, side_by_side(stopped, networks), strict=True))

    def _with_silent(self, robot: str, answers: Mapping[NetworkAdapter, Envelope | None]) -> dict[str, Envelope]:
        """Return the answers by network, also for those that remember the robot.

        Args:
            robot: the id.
            answers: to the stop, None of a network where it is not, or that is gone.
        """
        # A mesh that is not there has no key as long as it is not asked for.
        keys = {each.name: partial(getattr, each, "key") for each, said in answers.items() if said is None} | self.keys
        known = {each.name: said for each, said in answers.items() if said is not None}
        if not keys:
            return known
        from strands_robots.fleet.verdicts import remembered  # noqa: PLC0415 - loaded once the stop has left

        joined = {each.name for each in self.joined}
        whys = {name: "" if name in joined else self.absent.get(name) or "it is not joined" for name in keys}
        return known | remembered(robot, keys, whys)

    def _at_once(self, robot: str, *, moves: bool) -> NetworkAdapter | None:
        """Return the network of a robot where it is known without a question."""
        joined = self.joined
        if len(joined) == 1 and all(each.attempted.is_set() for each in self._joinings):
            return None if moves and self.enrolled_on_absent(robot) else joined[0]
        bearers = self.bearers(robot)
        return None if moves or not bearers else self._chosen(robot, "", bearers, moves=False)

    def _chosen(self, robot: str, verb: str, bearers: Sequence[NetworkAdapter], *, moves: bool) -> NetworkAdapter:
        if not moves:
            return self.decided(robot) or bearers[0]
        absent = self.enrolled_on_absent(robot)
        if len(bearers) == 1 and not absent:
            return bearers[0]
        from strands_robots.fleet.shared_id import SharedId, decided  # noqa: PLC0415 - few ids are on two networks

        with self._change:
            if len(self._shared_ids) >= SHARED_IDS_MAX and robot not in self._shared_ids:
                del self._shared_ids[next(iter(self._shared_ids))]
            shared_id = self._shared_ids.setdefault(robot, SharedId())
        return decided(shared_id, robot, verb, bearers, absent)


def _meant(arguments: Mapping[str, Any]) -> tuple[str, str]:
    """Return the robot of a world that a stop means, empty for all, and a note."""
    if not arguments:
        return "", ""
    from strands_robots.serving.stop_arguments import robot_of_world  # noqa: PLC0415 - a call need not load it

    return robot_of_world(arguments)


def _one_answer(robot: str, answers: Mapping[str, Envelope], unread: str) -> Envelope:
    from strands_robots.fleet.verdicts import answer_of_bearers  # noqa: PLC0415 - loaded once the stop has left
    from strands_robots.serving.stop_arguments import noted  # noqa: PLC0415 - as above

    return noted(answer_of_bearers(robot, answers), unread)


def _not_left(network: NetworkAdapter, absent: Mapping[str, str]) -> Envelope:
    return error(absent.get(network.name) or CLOSED, stopped=None)


def _graded(answer: Envelope | None) -> bool:
    """Return whether an answer says that a robot has stopped, or not."""
    return answer is not None and answer.get("stopped") is not None


def _absent(network: NetworkAdapter, robot: str, answer: Envelope | None) -> bool:
    """Return whether no robot of this id took a stop."""
    return answer is None or (answer.get("in_reach") is False and not bears(network, robot))


def _failed(exc: BaseException) -> Envelope | None:
    """Return what stands for the answer to a stop that failed."""
    return None if isinstance(exc, NoSuchRobotError) else error(f"{type(exc).__name__}: {exc}", stopped=None)


def _result(stop: asyncio.Future[Envelope | None]) -> Envelope | None:
    try:
        return stop.result()
    except asyncio.CancelledError:
        # Of one network, which hides no answer of another one.
        return error(CLOSED, stopped=None)


def _tell(listener: Callable[[NetworkAdapter], None], network: NetworkAdapter) -> None:
    """Call a listener, whose failure keeps no other one from hearing."""
    try:
        listener(network)
    except Exception:
        logger.exception("A listener failed for %s.", network.name)
