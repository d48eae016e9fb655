"""A network of scripted robots for tests of the calling side."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import NoSuchRobotError, UnknownVerbError, UnreachableError
from strands_robots.fleet.adapter import (
    DEVICE_CONNECT,
    FIND_S,
    STOP_S,
    Detail,
    FoundRobot,
    LockoutReport,
    OnEvent,
    Place,
    ReceivedCall,
    Resumed,
    RobotEvent,
    StopRequest,
)
from strands_robots.fleet.reports import answered
from strands_robots.fleet.verdicts import measured, roster_verdict, unanswered
from strands_robots.safety import network_key
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.lockout import Lockout
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import Sending
from strands_robots.safety.scope import EVERY_ROBOT, KnownRobots, Scope
from strands_robots.safety.statements import Purpose
from strands_robots.safety.statements import signed as signed_by
from strands_robots.safety.stop_roster import StopOutcome, StopRoster
from strands_robots.serving.advertised import AdvertisedVerb, find_verb

Answer = Callable[[Mapping[str, Any]], Envelope]

LEASE = {"lease_id": {"type": "string", "default": ""}, "lease_ttl_s": {"type": "number", "default": 0.0}}


def function(name: str, direction: str = "write", required: tuple[str, ...] = (), **properties: Any) -> dict[str, Any]:
    """Return a function as a robot describes it on the wire."""
    return {
        "name": name,
        "description": f"Do {name}.",
        "parameters": {"type": "object", "properties": properties, "required": list(required)},
        "labels": {"direction": direction},
    }


OURS = (
    function(
        "moveTo", required=("x",), x={"type": "number", "unit": "m"}, speed={"type": "number", "default": 0.5}, **LEASE
    ),
    function("getStatus", "read"),
    function("stop"),
    function("resume", assertion={"type": "object"}),
    function("acquireControl", ttl_s={"type": "number", "default": 60.0}, **LEASE),
    function("renewControl", lease_id={"type": "string"}),
    function("releaseControl", lease_id={"type": "string"}),
)
"""What a robot of ours describes, in short."""


def key_of(network: str) -> NetworkKey:
    """Return the key of a scripted network."""
    return NetworkKey.of({DEVICE_CONNECT: network_key.DEVICE_CONNECT}.get(network, network), ["tcp/127.0.0.1:1"])


class ScriptedNetwork:
    """Robots whose verbs, answers and stops a test sets; it notes what they were asked."""

    has_stop_link = False
    tells_absence = False
    announces_verbs = True
    reads: Mapping[str, str] = {"status": "getStatus", "state": "getState", "features": "getFeatures"}
    starts = "execute"
    place = Place("They were looked for in a script.")

    def __init__(self, name: str = DEVICE_CONNECT, robots: Mapping[str, object] | None = None) -> None:
        self.name = name
        self.robots: dict[str, object] = {"arm-1": OURS} if robots is None else dict(robots)
        self.answers: dict[str, Answer | Exception] = {}
        self.stops: Envelope | Exception | None = success("stopped", stopped=True, halted=["task"])
        self.calls: list[tuple[str, str, dict[str, Any], float]] = []
        self.stopped: list[str] = []
        self.unreachable = ""
        self.subscribers: list[OnEvent] = []
        self.joined = False
        self.sessions = 0
        self.enrolled: dict[str, bytes] = {}
        self.estops: list[tuple[str, Scope, str]] = []
        self.locked: dict[str, str] = {}
        self.silent: list[str] = []
        self.known_elsewhere: KnownRobots | None = None
        self.signers: list[Any] = []
        self.keys: dict[str, SigningIdentity] = {}
        self.children: dict[str, str] = {}
        self.mute: set[str] = set()
        self.controller: Any = object()
        self.standing_for: list[Callable[[], Collection[str]]] = []
        self.asked: list[str] = []
        self.searches = 0
        self.of_kind: object = ()

    def open(self) -> None:
        if self.unreachable:
            raise UnreachableError(self.unreachable)
        self.joined = True

    @property
    def remembered(self) -> bool:
        """A robot of the last emergency stop's scope is known on some network."""
        return self.known_elsewhere is not None and self.known_elsewhere.known

    def sign_with(self, key: SigningIdentity) -> None:
        """Have every robot sign its status."""

        def status(arguments: Mapping[str, Any]) -> Envelope:
            fields = {"nonce": arguments.get("nonce", "")}
            return success("idle", statement=signed_by(key, Purpose.LOCKOUT_STATE, self.calls[-1][0], fields))

        self.answers["getStatus"] = status

    def find(self, timeout: float | None = FIND_S, *, peers: bool = False) -> list[FoundRobot]:
        self.searches += 1
        if self.unreachable:
            raise UnreachableError(self.unreachable)
        return [
            FoundRobot(name, "strands_robot", "so100", must_answer=True, world=self.children.get(name, ""))
            for name in self.robots
        ]

    def announced(self) -> Collection[str]:
        return tuple(self.robots)

    def known(self, robot: str) -> FoundRobot:
        return FoundRobot(robot)

    def bears(self, robot: str) -> bool:
        return robot in self.robots

    def reaches(self, robot: str) -> bool:
        self.asked.append(robot)
        return robot in self.robots

    def session(self, robot: str) -> object:
        return self.sessions

    def enrolled_key(self, robot: str) -> bytes | None:
        return self.enrolled.get(robot)

    def announced_functions(self, robot: str) -> object:
        return self.robots[robot] if self.announces_verbs else self.of_kind

    def describe(self, robot: str, *, anew: bool = False) -> object:
        if robot not in self.robots:
            raise NoSuchRobotError("gone", robot=robot)
        return self.robots[robot]

    def describe_each(self, robots: Iterable[str]) -> Mapping[str, object]:
        return {name: self.robots[name] for name in robots}

    def verb(self, robot: str, name: str) -> AdvertisedVerb | None:
        return find_verb(self.robots.get(robot), name)

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        self.calls.append((robot, verb, dict(arguments), timeout))
        if robot not in self.robots:
            raise NoSuchRobotError("gone", robot=robot, verb=verb)
        answer = self.answers.get(verb)
        if isinstance(answer, Exception):
            raise answer
        if answer is not None:
            return answer(arguments)
        described = self.robots[robot]
        if isinstance(described, list | tuple) and verb not in {each["name"] for each in described}:
            raise UnknownVerbError("Method not found")
        return success("done", verb=verb)

    def stop(
        self, robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False
    ) -> Envelope | None:
        if robot not in self.robots:
            return unanswered(robot) if insist else None
        self.stopped.append(f"{robot}/{robot_name}" if robot_name else robot)
        if isinstance(self.stops, Exception):
            raise self.stops
        return self.stops

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        return self.call(robot, verb, arguments, within)

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        if robot not in self.robots:
            raise NoSuchRobotError("gone", robot=robot)
        return FoundRobot(robot, "strands_robot", "so100", functions=self.robots[robot])

    def received(self, robot: str, verb: str, arguments: Mapping[str, Any]) -> ReceivedCall:
        return ReceivedCall("scripted", verb, arguments)

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        return self.stop(robot, within, robot_name) or error(f"No device {robot}.", stopped=None, in_reach=False)

    @property
    def key(self) -> NetworkKey:
        return key_of(self.name)

    @property
    def stale(self) -> str:
        return ""

    def stop_all(self, timeout: float = STOP_S) -> tuple[dict[str, Envelope], StopOutcome]:
        answers = {name: self.stop(name) or error("none") for name in self.robots}
        return answers, measured(answers, self._roster(), Sending())

    def emergency_stop(self, request: StopRequest) -> StopOutcome:
        scope, estop_id = request.scope, request.estop_id
        self.estops.append((request.reason, scope, estop_id))
        self.signers.append(request.signing_key)
        self.known_elsewhere = None if request.remembers is None else KnownRobots(scope, request.remembers)
        if self.unreachable:
            raise UnreachableError(self.unreachable)
        answers = {name: self.stop(name) or error("none") for name in self.robots if scope.covers(name, frozenset())}
        self.locked |= dict.fromkeys(answers, estop_id)
        return measured(answers, self._roster(scope, request.named), Sending(), estop_id)

    def verdict(self, outcome: StopOutcome) -> Envelope:
        return roster_verdict(outcome)

    def _roster(self, scope: Scope = EVERY_ROBOT, named: Collection[str] = ()) -> StopRoster:
        roster = StopRoster(self.key, named, scope)
        inside = [name for name in (*self.robots, *self.silent) if scope.covers(name, frozenset())]
        roster.find(dict.fromkeys(inside, True))
        roster.read()
        return roster

    @contextmanager
    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> Iterator[Any]:
        self.standing_for.append(known)
        try:
            yield self.controller
        finally:
            self.standing_for.remove(known)

    def beats(self, robots: Iterable[str]) -> Mapping[str, float | None]:
        return dict.fromkeys(robots)

    def lockable(self, timeout: float = FIND_S) -> list[str]:
        if self.unreachable:
            raise UnreachableError(self.unreachable)
        return list(self.robots)

    def lockouts(self, robots: Iterable[str], timeout: float, *, signed: bool = False) -> list[LockoutReport]:
        def report(name: str) -> LockoutReport:
            lockouts = (Lockout(self.locked[name], "desk", "", 1.0),) if name in self.locked else ()
            key = self.keys.get(name)
            facts = {} if key is None else {"statement": signed_by(key, Purpose.LOCKOUT_STATE, name, {"nonce": "n"})}
            return LockoutReport(name, lockouts, facts=facts)

        return [report(name) for name in robots]

    async def lockout_async(self, robot: str, within: float) -> LockoutReport:
        """Report the lockouts and the answer to ``getStatus``; a mute robot none."""
        self.asked.append(robot)
        if robot in self.mute:
            await asyncio.sleep(within)
            return LockoutReport(robot, problem="it did not answer")
        facts = await answered(self.call_async(robot, "getStatus", {}, within))
        return replace(self.lockouts([robot], within)[0], facts=facts, round_trip_ms=1.0)

    def resume(self, reports: Sequence[LockoutReport], signer: Any, timeout: float) -> dict[str, Resumed]:
        for each in reports:
            self.locked.pop(each.name, None)
        return {each.name: (True, "free") for each in reports}

    def beats_every(self, robot: str) -> float:
        return 5.0

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        self.subscribers.append(on_event)
        return lambda: self.subscribers.remove(on_event)

    def say(self, robot: str, name: str, payload: Mapping[str, Any] | None = None, **said: Any) -> None:
        """Have a robot send an event."""
        for each in list(self.subscribers):
            each(RobotEvent(robot, name, payload or {}, **said))

    def close(self) -> None:
        self.joined = False
