"""A network of scripted robots for tests of the calling side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import NoSuchRobotError, UnknownVerbError, UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, FIND_S, STOP_S, FoundRobot, OnEvent
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.statements import Purpose, signed

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


class ScriptedNetwork:
    """Robots whose verbs, answers and stops a test sets; it notes what they were asked."""

    announces_verbs = True
    reads: Mapping[str, str] = {"status": "getStatus", "state": "getState", "features": "getFeatures"}

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

    def open(self) -> None:
        if self.unreachable:
            raise UnreachableError(self.unreachable)
        self.joined = True

    def sign_with(self, key: SigningIdentity) -> None:
        """Have every robot sign its status."""

        def status(arguments: Mapping[str, Any]) -> Envelope:
            fields = {"nonce": arguments.get("nonce", "")}
            return success("idle", statement=signed(key, Purpose.LOCKOUT_STATE, self.calls[-1][0], fields))

        self.answers["getStatus"] = status

    def find(self, timeout: float = FIND_S) -> list[FoundRobot]:
        return [FoundRobot(name, "strands_robot", "so100") for name in self.robots]

    def bears(self, robot: str) -> bool:
        return robot in self.robots

    def session(self, robot: str) -> object:
        return self.sessions

    def enrolled_key(self, robot: str) -> bytes | None:
        return self.enrolled.get(robot)

    def describe(self, robot: str, *, anew: bool = False) -> object:
        return self.robots[robot]

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

    def stop(self, robot: str, timeout: float = STOP_S, robot_name: str = "") -> Envelope | None:
        if robot not in self.robots:
            return None
        self.stopped.append(robot)
        if isinstance(self.stops, Exception):
            raise self.stops
        return self.stops

    def stop_all(self, timeout: float = STOP_S) -> dict[str, Envelope]:
        return {name: self.stop(name) or error("none") for name in self.robots}

    def subscribe(self, robot: str, on_event: OnEvent) -> Callable[[], None]:
        self.subscribers.append(on_event)
        return lambda: self.subscribers.remove(on_event)

    def close(self) -> None:
        self.joined = False
