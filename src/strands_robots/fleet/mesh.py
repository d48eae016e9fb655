"""Robots on the native mesh, for the calling side.

This peer has no robot and is never the mesh's hub: without a hub or a stated endpoint there is no mesh to join.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from itertools import count
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.errors import ArgumentsError, NoAnswerError, NoSuchRobotError, UnreachableError
from strands_robots.fleet.adapter import CLOSED, FIND_S, MESH, STOP_S, FoundRobot, OnEvent, RobotEvent
from strands_robots.fleet.refusals import refusal_of_text
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.peer_answers import enrolled_peers, stop_distrust
from strands_robots.safety.statements import ALARM
from strands_robots.safety.stopping import explain, grade
from strands_robots.serving.verb_schema import described
from strands_robots.utils import MissingExtraError, ValidationError, finite, plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

DESCRIBE_S = 5.0
"""Seconds in which a peer has to describe its verbs."""

LOOK_S = 0.05
_ALIASES = {"getStatus": "status", "getState": "state", "getFeatures": "features"}
"""Reads of every robot by their names on Device Connect, which the mesh has always called otherwise."""


class MeshNetwork:
    """The mesh that this process's settings name.

    Args:
        source: the first part of this peer's id.
    """

    name = MESH
    announces_verbs = False
    reads: Mapping[str, str] = {"status": "status", "state": "state", "features": "features"}

    def __init__(self, source: str) -> None:
        self._source = source
        self._mesh: Mesh | None = None
        self._joined = math.inf
        self._subscriptions = count()
        self._discoveries = 0

    def open(self) -> None:
        """Join; raise :class:`UnreachableError` where there is no mesh."""
        from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used
        from strands_robots.mesh.core import Mesh, Parts  # noqa: PLC0415 - as above
        from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
        from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

        try:
            mesh = Mesh(None, visitor_id(self._source), "tool", parts=Parts(acquire=session.dial))
            try:
                mesh.start()
            except BaseException:
                mesh.close()
                raise
        except (TransportError, IdentityError, MissingExtraError, ValueError) as exc:
            raise UnreachableError(plain_text(str(exc))) from exc
        self._mesh, self._joined = mesh, time.monotonic()

    def find(self, timeout: float = FIND_S) -> list[FoundRobot]:
        """Return the robots in reach, once they had the time to announce themselves."""
        self._settle(timeout)
        self._discoveries += 1
        return [
            FoundRobot(str(row["peer_id"]), plain_text(row.get("type"), 100), plain_text(row.get("tool_name"), 100))
            for row in self._rows()
        ]

    def bears(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach."""
        row = self._joined_mesh.get_peer(robot)
        return row is not None and bool(row["reachable"]) and _has_robot(row)

    def session(self, robot: str) -> object:
        """Return the session of the peer, and the number of discoveries."""
        return self._joined_mesh.peer_wire_zid(robot), self._discoveries

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the peer's enrolled key."""
        return (enrolled_peers() or {}).get(robot)

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions, of an older one those of its kind."""
        from strands_robots.serving.peer_verbs import KINDS, PEER_VERBS  # noqa: PLC0415 - loaded when it is used

        del anew  # the robot is always asked
        row = self._joined_mesh.get_peer(robot) or {}
        reply = self._joined_mesh.send(robot, {"action": "describe"}, DESCRIBE_S)
        result = reply.get("result")
        functions = result.get("functions") if isinstance(result, Mapping) else None
        if isinstance(functions, list):
            return functions
        kind = row.get("robot_kind")
        actions = KINDS.get(
            kind if isinstance(kind, str) else "", KINDS["world" if row.get("type") == "sim" else "robot"]
        )
        own = row.get("own_verbs")
        named = [{"name": name, "labels": {"own": "true"}} for name in own] if isinstance(own, list) else []
        return [*(described(PEER_VERBS[name]) for name in actions), *named]

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Send the peer an action."""
        try:
            for name, value in arguments.items():
                finite(name, value)
            json.dumps(arguments, allow_nan=False)
        except (ValidationError, TypeError, ValueError, RecursionError) as exc:
            raise ArgumentsError(str(exc), robot=robot, verb=verb) from exc
        if "action" in arguments:
            raise ArgumentsError("the mesh cannot carry an argument called action", robot=robot, verb=verb)
        mesh = self._joined_mesh
        try:
            if not self._waited_for(robot):
                raise NoSuchRobotError(f"No robot {robot!r} is on the mesh", robot=robot, verb=verb)
            action = self._action(robot, verb)
        except UnreachableError:
            if self._mesh is mesh:
                raise
            raise NoAnswerError(CLOSED, robot=robot, verb=verb) from None
        reply = mesh.send(robot, {**arguments, "action": action}, timeout)
        if reply.get("type") == "response":
            result = reply.get("result")
            return dict(result) if isinstance(result, Mapping) else {"result": result}
        if reply.get("type") == "error":
            raise refusal_of_text(robot, verb, reply.get("error"))
        if self._mesh is None:
            raise NoAnswerError(CLOSED, robot=robot, verb=verb)
        if reply.get("status") == "timeout":
            raise NoAnswerError(f"It did not answer within {timeout:g} s", robot=robot, verb=verb)
        why = plain_text(reply.get("reason") or reply.get("error"))
        if why.startswith("validation: "):
            raise refusal_of_text(robot, verb, why)
        raise UnreachableError(why or "the mesh did not carry the call", robot=robot, verb=verb)

    def stop(self, robot: str, timeout: float = STOP_S, robot_name: str = "") -> Envelope | None:
        """Stop the peer; *stopped* counts only where an enrolled robot has signed it."""
        if not self._waited_for(robot, longest=FIND_S):
            return None
        one = {"robot_name": robot_name} if robot_name else {}
        reply = self._joined_mesh.send(robot, {"action": "stop", **one}, timeout)
        return _stop_answer(robot, reply, enrolled_peers())

    def stop_all(self, timeout: float = STOP_S) -> dict[str, Envelope]:
        """Stop all robots in reach, and again each that has not confirmed it."""
        mesh = self._joined_mesh
        replies = mesh.broadcast({"action": "stop"}, min(timeout, FIND_S))
        keys = enrolled_peers()
        answers = {name: _stop_answer(name, each, keys) for each in replies if (name := str(each["responder_id"]))}
        self._settle(0.0)
        rest = [row["peer_id"] for row in self._rows() if is_error(answers.get(row["peer_id"], error("no answer")))]
        for name, answer in zip(rest, side_by_side(lambda each: self.stop(each, timeout), rest), strict=True):
            answers[name] = answer or error("It is gone.", stopped=None)
        return {row["peer_id"]: answers[row["peer_id"]] for row in self._rows() if row["peer_id"] in answers}

    def subscribe(self, robot: str, on_event: OnEvent) -> Callable[[], None]:
        """Receive the robot's policy steps and safety events."""
        from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

        mesh, number = self._joined_mesh, next(self._subscriptions)
        names = []
        for name, key in (("stream", topics.stream(robot)), ("safety_event", topics.safety_event(robot))):

            def arrived(key: str, message: Mapping[str, Any], name: str = name) -> None:
                on_event(RobotEvent(robot, name, message))

            names.append(f"fleet {number} {name}")
            mesh.subscribe(key, arrived, names[-1])

        def end() -> None:
            for each in names:
                mesh.unsubscribe(each)

        return end

    def close(self) -> None:
        """Leave the mesh."""
        mesh, self._mesh = self._mesh, None
        if mesh is not None:
            mesh.close()

    @property
    def _joined_mesh(self) -> Mesh:
        if self._mesh is None:
            raise UnreachableError("The mesh is not joined: use the fleet as a context manager")
        return self._mesh

    def _rows(self) -> list[dict[str, Any]]:
        """Return the peers in reach that have a robot."""
        return [row for row in self._joined_mesh.peers if row["reachable"] and _has_robot(row)]

    def _action(self, robot: str, verb: str) -> str:
        row = self._joined_mesh.get_peer(robot) or {}
        own = row.get("own_verbs")
        return verb if isinstance(own, list) and verb in own else _ALIASES.get(verb, verb)

    def _settle(self, timeout: float) -> None:
        """Wait until peers that are linked to us have announced themselves."""
        from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, LINK_DISCOVERY_S  # noqa: PLC0415 - as above

        stated = settings.items("ZENOH_CONNECT") or settings.items("ZENOH_LISTEN")
        linked_by = self._joined + LINK_DISCOVERY_S if stated else self._joined
        until = max(self._joined + DISCOVERY_S, min(linked_by, time.monotonic() + timeout))
        while (now := time.monotonic()) < until and not (now >= self._joined + DISCOVERY_S and self._rows()):
            time.sleep(LOOK_S)

    def _waited_for(self, robot: str, longest: float = math.inf) -> bool:
        """Return whether the robot is in reach, once that can be known."""
        from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

        until = self._joined + min(discovery_timeout(DISCOVERY_S), longest)
        while not self.bears(robot):
            if time.monotonic() >= until:
                return False
            time.sleep(LOOK_S)
        return True


def _has_robot(row: Mapping[str, Any]) -> bool:
    return "locked" in row or "tool_name" in row or "robot_kind" in row


def _stop_answer(robot: str, reply: Mapping[str, Any], keys: Mapping[str, bytes] | None) -> Envelope:
    if reply.get("type") not in ("response", "error"):
        return error(f"{robot} did not answer.", stopped=None)
    result = reply.get("result")
    if not grade(result).stopped:
        return error(explain(result) if result is not None else plain_text(reply.get("error")), stopped=False)
    why = stop_distrust(reply, keys)
    if why:
        return error(why, stopped=False if why.startswith(ALARM) else None)
    return dict(result) if isinstance(result, Mapping) else error("unknown answer", stopped=None)
