"""Feeds: the robots of each network, their verbs' forms, and its stop button."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import threading
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from typing import Any

from strands_robots.dashboard.fleet_model import FleetModel, key_of
from strands_robots.envelope import Envelope, is_error
from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import (
    DEVICE_CONNECT,
    EVERY,
    FoundRobot,
    NetworkAdapter,
    Resumed,
    RobotEvent,
    StopSender,
)
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.reports import answered, joint_limits, joint_units, task_of
from strands_robots.fleet.safety_console import StandingController, StopButtons
from strands_robots.fleet.stops import not_left
from strands_robots.fleet.verdicts import NetworkVerdict
from strands_robots.safety.identity import KeyFileError
from strands_robots.serving.advertised import AdvertisedParameter, AdvertisedVerb, RobotDescription
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.lead_verbs import LEAD_VERBS
from strands_robots.threads import LoopThread
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)

LEFT_OUT = frozenset({*CONTROL_VERBS, *LEAD_VERBS, "resume", "ping", "teleop_status", "teleop_receive", "teleop_stop"})
"""Verbs that the page has a control of its own for, or none."""

FORMS_MAX, PARAMETERS_MAX, TEXT_MAX = 100, 40, 600

SHOWN_AT_LEAST = 2
SHOWN = {
    "pick": ("object", "speed"),
    "place": ("on", "x", "y"),
    "moveBy": ("direction", "distance"),
    "getPicture": ("camera",),
}
"""Fields that a form shows unfolded, where they are not the required ones and those that come first."""

_UNITS = (
    (re.compile(r"\bdegrees\b", re.I), "\u00b0"),
    (re.compile(r"\bmetres\b", re.I), "m"),
    (re.compile(r"\b(in )?seconds\b|\bLongest wait\b", re.I), "s"),
    (re.compile(r"\bpixels\b", re.I), "px"),
    (re.compile(r"\bradians\b", re.I), "rad"),
)
_CHOICES = (
    (re.compile(r"\blistCameras\b"), "string", "cameras"),
    (re.compile(r"\bgetObjects\b|\bName of the object\b"), "string", "objects"),
    (re.compile(r"\bWhich robot of the world\b"), "string", "robots"),
    (re.compile(r"\bforward, back, left, right, up or down\b"), "string", "directions"),
    (re.compile(r"\bDegrees by joint name\b"), "object", "joints"),
)
"""What a parameter's description says of its values: the page lets them be chosen."""

_NUMBERS = ("number", "integer")

KEYS = {DEVICE_CONNECT: "dc"}
"""Networks that have another name in the page's messages than their adapter has."""

POLL_MIN_S = 0.4
"""Shortest time between two questions to one robot for its lockout and its holder."""

POLLS_PER_S = 30.0
"""Such questions a second, to all robots of a network together."""

ASK_S = 1.5
"""Seconds that a robot has to answer one."""

READ_S = 3.0
"""Seconds that a robot has to answer a question about what it can do."""

STOP_S = 2.0
SEARCH_S = 2.0
SEARCH_AGAIN_S, SEARCH_SOON_S = 30.0, 1.0
"""Seconds between two searches where no new robot was announced meanwhile; and after a search that failed, or where a
stranger sent an event."""

LOOK_S = 0.2
PARALLEL, PARALLEL_NEW = 8, 32
"""Robots that are asked at a time, and besides them of those that are asked for the first time.

Those that did not answer last time keep none of the others waiting.
"""

STRANGERS_MAX = 8
PARTS_MAX = 16
CAMERAS_MAX, CAMERA_NAME_MAX = 32, 128

REASON = "STOP on the operator's page"

AGAIN_S = 2.0
"""Seconds until the feed of a joined network is made again where that failed."""

JOINING = "it is being joined"


def verb_forms(verbs: Iterable[AdvertisedVerb]) -> tuple[dict[str, Any], ...]:
    """Return the forms of a robot's verbs."""
    return tuple(_form(each) for each in islice((each for each in verbs if each.name not in LEFT_OUT), FORMS_MAX))


def _form(verb: AdvertisedVerb) -> dict[str, Any]:
    needed = [each.name for each in verb.parameters if each.required]
    others = [each.name for each in verb.parameters if not each.required]
    usual = (*needed, *others[: max(0, SHOWN_AT_LEAST - len(needed))])
    shown = SHOWN[verb.name] if set(SHOWN.get(verb.name, ())) & {*needed, *others} else usual
    return {
        "name": verb.name,
        "kind": "read" if verb.reads else "motion",
        "own": verb.own,
        "changes": verb.changes,
        "lasts_s": verb.lasts_s,
        "summary": verb.summary[:TEXT_MAX],
        "parameters": [{**_field(each), "shown": each.name in shown} for each in verb.parameters[:PARAMETERS_MAX]],
    }


def _field(parameter: AdvertisedParameter) -> dict[str, Any]:
    meaning, kind, default = parameter.meaning[:TEXT_MAX], parameter.type or "string", parameter.default
    guessed = next((unit for words, unit in _UNITS if words.search(meaning)), "") if kind in _NUMBERS else ""
    return {
        "name": parameter.name,
        "type": kind,
        "meaning": meaning,
        "unit": parameter.unit or guessed,
        "low": parameter.low,
        "high": parameter.high,
        "enum": list(parameter.choices),
        "choices": next((of for words, wanted, of in _CHOICES if kind == wanted and words.search(meaning)), ""),
        "default": default[:TEXT_MAX] if isinstance(default, str) else default,
        "required": parameter.required,
    }


class FleetFeed:
    """Robots of one network.

    ``call`` and ``stop`` run on the caller's event loop, everything else on a loop of the feed's own.

    Args:
        model: takes what the robots say.
        there: a joined network.

    Attributes:
        network: the name of the network in the page's messages.
        there: as given.
    """

    def __init__(self, model: FleetModel, there: NetworkAdapter) -> None:
        self.network = page_name(there.name)
        self._model, self.there = model, there
        self._names: set[str] = set()
        self._passed: set[str] = set()
        self._strangers: set[str] = set()
        self._answered: dict[str, bool] = {}
        self._described: set[str] = set()
        self._functions: dict[str, object] = {}
        self._asked: dict[str, float] = {}
        self._searched, self._found = float("-inf"), True
        self._tasks: dict[tuple[str, str], asyncio.Task[None]] = {}
        most = {True: PARALLEL, False: PARALLEL, None: PARALLEL_NEW}
        self._limits = {answered: asyncio.Semaphore(number) for answered, number in most.items()}
        # Both may block for seconds: a search waits for no robot.
        self._searcher = ThreadPoolExecutor(1, "dashboard search")
        self._describers = ThreadPoolExecutor(PARALLEL, "dashboard verbs")
        self._stack = contextlib.ExitStack()
        for pool in (self._searcher, self._describers):
            self._stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        try:
            thread = LoopThread(f"dashboard-{self.network}")
            self._stack.callback(thread.close)
            self._stack.callback(there.subscribe(EVERY, self._take))
        except BaseException:
            self._stack.close()
            raise
        thread.submit(self._run())

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        """Call a verb; every failure is an answer of status error."""
        return await answered(self.there.call_async(robot, verb, params, seconds))

    async def stop(self, robot: str) -> Envelope:
        """End a robot's motion without a lockout, as after a jog; graded, never raises."""
        return await self.there.stop_async(robot, STOP_S)

    def session(self, robot: str) -> object:
        """Return what differs once another robot may answer to this id; asks no one."""
        try:
            return self.there.session(robot)
        except RefusalError:
            return None

    async def look_closer(self, robot: str) -> None:
        """Read the limits and the cameras of a robot, and its idle joints."""
        reads = self.there.reads
        asked = (reads["features"], "listCameras", reads["state"])
        features, cameras, state = await asyncio.gather(*(self.call(robot, verb, {}, READ_S) for verb in asked))
        found = cameras.get("cameras")
        names = tuple(str(each)[:CAMERA_NAME_MAX] for each in found[:CAMERAS_MAX]) if isinstance(found, list) else ()
        limits = joint_limits(features) if not is_error(features) else {}
        self._model.update(self.network, robot, cameras=names, limits=limits, units=joint_units(features))
        if isinstance(state.get("joints"), Mapping):
            self._model.observe(self.network, robot, state["joints"])

    def resume(self, robots: list[str], signer: Any, seconds: float) -> dict[str, Resumed]:
        """Free robots with the operator's key; blocks, and returns each outcome."""
        try:
            return self.there.resume(self.there.lockouts(robots, seconds), signer, seconds)
        except (KeyFileError, RefusalError) as exc:
            return dict.fromkeys(robots, (False, exc.why if isinstance(exc, RefusalError) else str(exc)))

    def close(self) -> None:
        """End the feed; the network is left by whoever joined it."""
        self._stack.close()

    # On a thread of the network: returns at once and may not raise.

    def _take(self, event: RobotEvent) -> None:
        name = event.robot
        if name not in self._names:
            if len(self._strangers) < STRANGERS_MAX and not self.there.bears(name):
                self._strangers.add(name)
            return
        if event.alive:
            self._model.sign_of_life(self.network, name)
        if event.joints is not None:
            self._model.observe(self.network, name, event.joints, event.part)
        if event.task is not None:
            self._model.task(self.network, name, **event.task)
        if event.load is not None:
            self._model.load(self.network, name, event.load)
        if not event.frequent:
            self._model.note(self.network, name, event.name, event.payload)

    # On this feed's own loop.

    async def _run(self) -> None:
        while True:
            try:
                self._look()
            except RefusalError as exc:
                logger.debug("Robots on %s cannot be looked for: %s", self.network, exc)
            await asyncio.sleep(LOOK_S if len(self._names) > 1 else LOOK_S / 2)

    def _look(self) -> None:
        """Begin what is due: a search, and a question to each robot."""
        now = time.monotonic()
        waited = now - self._searched
        new = {*self.there.announced()} - self._names - self._passed
        soon = not self._found or self._strangers
        if (new and self._found) or waited > (SEARCH_SOON_S if soon else SEARCH_AGAIN_S):
            self._searched = now if self._begin("search", "", self._search) else self._searched
        every = poll_interval(len(self._names))
        for name in sorted(self._names):
            if now - self._asked.get(name, float("-inf")) >= every and self._begin("lockout", name, self._ask):
                self._asked[name] = now

    def _begin(self, what: str, name: str, work: Callable[[str], Awaitable[None]]) -> bool:
        """Begin a task; False while the one before is under way."""
        running = self._tasks.get((what, name))
        if running is not None and not running.done():
            return False

        async def guarded() -> None:
            try:
                await work(name)
            except (LookupError, TimeoutError, RuntimeError) as exc:
                logger.warning("%s %s failed: %s", what, name, exc)

        self._tasks[what, name] = asyncio.create_task(guarded())
        return True

    async def _search(self, _: str) -> None:
        self._strangers.clear()
        self._found = False
        found = await asyncio.get_running_loop().run_in_executor(self._searcher, self.there.find, SEARCH_S)
        for each in found:
            # A world has one card, with all of its robots.
            if not each.world:
                self._meet(each)
        self._passed, self._found = {each.id for each in found} - self._names, True

    def _meet(self, robot: FoundRobot) -> None:
        kind, model = robot.type[:80], robot.model[:80]
        self._model.update(self.network, robot.id, kind=kind, model=model, expected=robot.must_answer)
        row = self._model.row(key_of(self.network, robot.id))
        if row is None:
            return
        self._names.add(robot.id)
        if not row.forms:
            self._described.discard(robot.id)
        # A robot that was asked has said more than it announces.
        if robot.id not in self._described:
            self._describe(robot.id, self.there.announced_functions(robot.id))

    def _describe(self, name: str, functions: object) -> None:
        row = self._model.row(key_of(self.network, name))
        # The same functions again are compared, which is faster than to make their forms.
        if row is not None and not (row.forms and functions == self._functions.get(name)):
            self._functions[name] = functions
            description = RobotDescription.of(functions)
            forms, known = verb_forms(description.verbs.values()), isinstance(functions, list | tuple)
            lacking = ", ".join(f"no {each}" for each in description.lacking) if known else ""
            can = {fact: verb in description.verbs for fact, verb in (("holdable", "acquireControl"), ("led", "lead"))}
            self._model.update(self.network, name, forms=forms, lacking=lacking, **can)

    async def _ask_verbs(self, name: str) -> None:
        loop = asyncio.get_running_loop()
        functions = await loop.run_in_executor(self._describers, self.there.describe, name)
        self._described.add(name)
        self._describe(name, functions)

    async def _ask(self, name: str) -> None:
        answered = self._answered.get(name)
        async with self._limits[answered]:
            report = await self.there.lockout_async(name, ASK_S)
        if self._model.row(key_of(self.network, name)) is None:
            self._forget(name)
            return
        if not report.facts:
            # A robot that does not answer is shown by the age of what it said last.
            self._answered[name] = False
            return
        self._answered[name] = True
        self._model.sign_of_life(self.network, name, report.round_trip_ms)
        self._model.report(self.network, report)
        if "task_status" in report.facts or "running_policies" in report.facts:
            self._model.task(self.network, name, **task_of(report.facts))
        robots = report.facts.get("robots")
        for part, joints in list(robots.items())[:PARTS_MAX] if isinstance(robots, Mapping) else ():
            if isinstance(joints, Mapping):
                self._model.observe(self.network, name, joints, str(part))
        if not self.there.announces_verbs and not (answered and name in self._described):
            # Only one that answers is asked. One that was silent may be another program by now.
            self._begin("verbs", name, self._ask_verbs)

    def _forget(self, name: str) -> None:
        """Forget a robot that an operator has removed; it is met anew when it is found."""
        self._names.discard(name)
        self._described.discard(name)
        for each in (self._functions, self._asked, self._answered):
            each.pop(name, None)
        for what in ("verbs", "lockout"):
            self._tasks.pop((what, name), None)


def page_name(network: str) -> str:
    """Return the name that a network has in the page's messages."""
    return KEYS.get(network, network)


def poll_interval(robots: int) -> float:
    """Return the seconds between two questions to one of so many robots."""
    return max(POLL_MIN_S, robots / POLLS_PER_S)


class Feeds:
    """Feeds and stop buttons, by the names that networks have on the page.

    Args:
        model: takes what the robots say.
        networks: which :meth:`begin` joins; whoever made them leaves them.
        signing_key: signs emergency stops; then only enrolled robots can confirm one.

    Attributes:
        networks: as given.
        buttons: of the networks on which a stop can leave.
        senders: of emergency stops, by network.
    """

    def __init__(self, model: FleetModel, networks: Networks, signing_key: Any = None) -> None:
        self._model, self.networks = model, networks
        self.buttons = StopButtons(REASON)
        self.senders: Mapping[str, StopSender] = {}
        self._feeds: Mapping[str, FleetFeed] = {}
        self._failed: dict[str, str] = {}
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._standing = StandingController(
            "dashboard",
            networks,
            signing_key,
            lambda network: model.expected(page_name(network)),
            lambda network, sender: self.add_button(page_name(network.name), sender),
            waits=True,
        )
        networks.on_joined(self._joined)

    def begin(self) -> None:
        """Begin to join the networks; returns at once."""
        # A press leaves where stops have a connection of their own before that network is joined.
        self._standing.open()
        self.networks.begin()

    def add(self, feed: FleetFeed) -> None:
        """Show the robots of a feed, which is closed with the others."""
        with self._lock:
            closed = self._closing.is_set()
            if not closed:
                # Whoever reads the old ones goes on with them.
                feeds = {**self._feeds, feed.network: feed}
                order = [page_name(each.name) for each in self.networks.stated]
                self._feeds = dict(sorted(feeds.items(), key=lambda each: (each[0] not in order, *each[:1])))
        if closed:
            feed.close()

    def add_button(self, network: str, sender: StopSender) -> None:
        """Send stops on a network, the one of its page's name, by ``sender``."""
        with self._lock:  # each network has a thread that comes here
            self.senders = {**self.senders, network: sender}
        self.buttons.add(network, sender, lambda scope: scope.only or self._model.expected(network, scope))

    @property
    def joined(self) -> tuple[FleetFeed, ...]:
        """The feeds of the joined networks, that whose robots win an id first."""
        return tuple(self._feeds.values())

    def get(self, network: str) -> FleetFeed | None:
        """Return the feed of a network, or None."""
        return self._feeds.get(network)

    @property
    def unsent(self) -> dict[str, Callable[[], NetworkVerdict]]:
        """Networks without a stop button, each with the verdict of a stop, once called."""
        absences = {**self.networks.absent, **self._failures}
        keys = self.networks.keys | {each.name: partial(getattr, each, "key") for each in self.networks.stated}
        without = {page_name(name): (name, key) for name, key in keys.items() if page_name(name) not in self.senders}
        return {
            page: partial(not_left, name, key, absences.get(name, JOINING)) for page, (name, key) in without.items()
        }

    @property
    def missing(self) -> dict[str, str]:
        """Reasons why networks that someone asked for have no feed."""
        absences = {**self.networks.missing, **self._failures}.items()
        return {page: why for name, why in absences if (page := page_name(name)) not in self._feeds}

    @property
    def _failures(self) -> dict[str, str]:
        return {**{name: _why(exc) for name, exc in self._standing.failures.items()}, **self._failed}

    def close(self) -> None:
        """Give up stops that wait for a link, and end the feeds."""
        self.buttons.close()
        with self._lock:
            self._closing.set()
        for each in self.joined:
            each.close()
        self._standing.close()

    def _joined(self, network: NetworkAdapter) -> None:
        """Make the feed of a network, on the thread that has joined it."""
        self._standing.stand(network)
        while not self._closing.is_set() and not self._show(network):
            self._closing.wait(AGAIN_S)

    def _show(self, network: NetworkAdapter) -> bool:
        """Add the feed of a network; return whether that could be made."""
        try:
            self.add(FleetFeed(self._model, network))
        except Exception as exc:  # noqa: BLE001 - the other networks are shown all the same
            self._failed[network.name] = _why(exc)
            logger.warning("%s cannot be shown: %s", network.name, exc)
            return False
        self._failed.pop(network.name, None)
        return True


def _why(exc: Exception) -> str:
    return plain_text(str(exc)) or type(exc).__name__
