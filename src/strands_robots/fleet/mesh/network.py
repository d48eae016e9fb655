"""Robots on the native mesh, for the calling side.

This peer has no robot and is never the mesh's hub: it joins a mesh by a hub on this machine, a
stated endpoint or multicast.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any, Self

from strands_robots.envelope import Envelope, error, is_error
from strands_robots.errors import (
    ArgumentsError,
    NoAnswerError,
    NoSuchRobotError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import (
    CLOSED,
    FIND_S,
    MESH,
    STOP_S,
    Detail,
    FoundRobot,
    NetworkBusyError,
    OnEvent,
    ReceivedCall,
)
from strands_robots.fleet.lockout_report import LockoutReport, Resumed
from strands_robots.fleet.mesh.controller import MeshController
from strands_robots.fleet.mesh.descriptions import functions_of, functions_of_each, functions_of_kind
from strands_robots.fleet.mesh.discovery import (
    CALLER,
    CONSOLE,
    LOOK_S,
    awaited,
    discover,
    has_robot,
    in_reach,
    is_in_reach,
)
from strands_robots.fleet.mesh.events import follow
from strands_robots.fleet.mesh.lockouts import ask_peers, lockable_peers, resume_peers
from strands_robots.fleet.mesh.requests import PeerRequests
from strands_robots.fleet.mesh.standing import mesh_network, stand_on_mesh
from strands_robots.fleet.mesh.stops import lock_peers, stop_peer, stop_peers
from strands_robots.fleet.mesh_settings import MeshSettings, no_hub
from strands_robots.fleet.refusals import refusal_of, refusal_of_text, with_meaning
from strands_robots.fleet.stop_answers import roster_verdict
from strands_robots.fleet.stop_button import StopSender
from strands_robots.safety.answers import OnProgress
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope
from strands_robots.safety.statements import enrolled_peers, lockout_distrust
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.tags import read_tags
from strands_robots.utils import MissingExtraError, ValidationError, finite, near, plain_text, shown

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.serving.advertised import AdvertisedVerb

DESCRIBE_S = 5.0
"""Seconds in which a peer has to describe its verbs."""

VERB_S = 2.0
"""Seconds in which a peer has to describe a verb of its own before that is called."""

HUB_S = 1.0
"""Seconds in which a mesh that lost its hub has to have one again before a call counts as not to be delivered."""

UNSEEN_S = 0.2
"""Seconds in which an unseen peer has to answer a stop, once peers are known."""

ALWAYS_SENT = ("stop", "releaseTorque")
"""Actions that take energy away: they are sent to a peer that was not seen, too."""

_ALIASES = {"getStatus": "status", "getState": "state", "getFeatures": "features"}
"""Reads of every robot by their names on Device Connect, which the mesh has always called otherwise."""


class MeshNetwork:
    """The mesh that this process's settings name.

    Args:
        source: the first part of this peer's id.
        stated: settings of the mesh that a connection profile states, by variable; they hold while it is joined.
        console: ``source`` is the whole id, by which robots may know a safety controller.
    """

    name = MESH
    has_stop_link = False
    tells_absence = False
    announces_verbs = False
    reads: Mapping[str, str] = {"status": "status", "state": "state", "features": "features"}
    starts = "start"

    def __init__(self, source: str, stated: Mapping[str, str] | None = None, *, console: bool = False) -> None:
        self._source, self._console = source, console
        self._settings = MeshSettings(stated or {})
        # Of a profile's mesh it is known once its settings are put.
        self._key = None if stated else mesh_network()
        self._mesh: Mesh | None = None
        self._joined = math.inf
        self._subscriptions = count()
        self._discoveries = 0
        self._given = False
        self._requests = PeerRequests()

    @classmethod
    def joined(cls, mesh: Mesh) -> Self:
        """Return the mesh that a peer has just joined, which is left by whoever joined."""
        network = cls(mesh.peer_id)
        network._mesh, network._joined, network._given = mesh, time.monotonic(), True
        return network

    def open(self) -> None:
        """Join; raise :class:`UnreachableError` where there is no mesh."""
        self._settings.take()
        self._key = mesh_network()
        try:
            self._mesh = self._dialled()
        except BaseException:
            self._settings.give_back()
            raise
        self._joined, self._requests = time.monotonic(), PeerRequests()

    def _dialled(self) -> Mesh:
        from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used
        from strands_robots.mesh.core import Mesh, Parts  # noqa: PLC0415 - as above
        from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
        from strands_robots.mesh.transport.config import stated_endpoints  # noqa: PLC0415 - as above
        from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

        try:
            name, kind = (self._source, CONSOLE) if self._console else (visitor_id(self._source), CALLER)
            mesh = Mesh(None, name, kind, parts=Parts(acquire=session.dial))
            try:
                mesh.start()
            except BaseException:
                mesh.close()
                raise
        except (TransportError, IdentityError, MissingExtraError, ValueError) as exc:
            busy = isinstance(exc, TransportError) and not any(stated_endpoints()) and not no_hub()
            raise (NetworkBusyError if busy else UnreachableError)(plain_text(str(exc))) from exc
        return mesh

    @property
    def peer(self) -> Mesh:
        """This caller as a peer, once it has joined."""
        return self._joined_mesh

    def find(self, timeout: float = FIND_S) -> list[FoundRobot]:
        """Return the robots in reach, once they had the time to announce themselves."""
        discover(self._joined_mesh, since=self._joined, within=timeout)
        self._discoveries += 1
        lockable, rows = {*lockable_peers(self._joined_mesh)}, {str(row["peer_id"]): row for row in self._judged()}
        return [
            replace(
                _found(row),
                must_answer=name in lockable,
                world=world if (world := name.rpartition("__")[0]) in rows else "",
            )
            for name, row in rows.items()
            if has_robot(row)
        ]

    def listed(self, timeout: float | None = None) -> list[FoundRobot]:
        """Return every peer in reach; ``timeout`` is waited to its end."""
        if timeout is None:
            discover(self._joined_mesh, since=self._fresh)
        else:
            time.sleep(max(0.0, self._joined + timeout - time.monotonic()))
        return [_found(row) for row in self._judged()]

    def known(self, robot: str) -> FoundRobot:
        """Return what the peer announced last."""
        return _found(self._joined_mesh.get_peer(robot) or {"peer_id": robot})

    def announced(self) -> Collection[str]:
        """Return the robots in reach."""
        return [str(row["peer_id"]) for row in self._rows() if has_robot(row)]

    def bears(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach."""
        mesh = self._joined_mesh
        return is_in_reach(mesh, robot) and has_robot(mesh.get_peer(robot) or {})

    def reaches(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach, once peers are known."""
        return self._waited_for(robot) and self.bears(robot)

    def session(self, robot: str) -> object:
        """Return the session of the peer, and the number of discoveries."""
        return self._joined_mesh.peer_wire_zid(robot), self._discoveries

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the peer's enrolled key."""
        return (enrolled_peers() or {}).get(robot)

    def announced_functions(self, robot: str) -> object:
        """Return the functions of the peer's kind."""
        row = self._joined_mesh.get_peer(robot) or {}
        return functions_of_kind(row, usual="world" if row.get("type") == "sim" else "robot")

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions, of an older one those of its kind."""
        del anew  # the robot is always asked
        if not (self._waited_for(robot) and self._linked()):
            raise self._absent(robot, "describe")
        functions = functions_of(self._joined_mesh, robot, DESCRIBE_S)
        return self.announced_functions(robot) if functions is None else functions

    def describe_each(self, robots: Iterable[str]) -> Mapping[str, object]:
        """Ask many peers at once; of a silent one return the functions of its kind."""
        rows = self._joined_mesh.peers_by_id
        stated = {name: rows[name] for name in robots if "robot_kind" in rows.get(name, ())}
        functions = functions_of_each(self._joined_mesh, stated)
        return {name: functions[name] if name in functions else functions_of_kind(row) for name, row in stated.items()}

    def verb(self, robot: str, name: str) -> AdvertisedVerb | None:
        """Return a verb of the robot's own; the others are known without a description."""
        if name in ALWAYS_SENT:
            return None
        from strands_robots.serving.advertised import find_verb  # noqa: PLC0415 - loaded when it is used
        from strands_robots.serving.peer_verbs import PEER_VERBS  # noqa: PLC0415 - as above

        if _ALIASES.get(name, name) in PEER_VERBS:
            return None
        if not self._waited_for(robot):
            raise self._absent(robot, name)
        return find_verb(functions_of(self._joined_mesh, robot, VERB_S), name)

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Send the peer an action."""
        arguments = _carried(robot, verb, arguments)
        mesh = self._joined_mesh
        try:
            there = self._waited_for(robot)
            if verb not in ALWAYS_SENT and not (there and self._linked()):
                raise self._absent(robot, verb)
            action = self._action(robot, verb)
        except UnreachableError:
            if self._mesh is mesh:
                raise
            raise NoAnswerError(CLOSED, robot=robot, verb=verb) from None
        reply = mesh.send(robot, {**arguments, "action": action}, timeout if there else min(timeout, STOP_S))
        if reply.get("type") == "response":
            result = reply.get("result")
            return _named_as(verb, result) if isinstance(result, Mapping) else {"result": result}
        if self._mesh is None:
            raise NoAnswerError(CLOSED, robot=robot, verb=verb)
        if reply.get("status") == "timeout":
            if not there:
                raise self._absent(robot, verb)
            raise NoAnswerError(f"{robot} did not answer", robot=robot, verb=verb)
        refusal = reply.get("refusal")
        if reply.get("type") == "error" and isinstance(refusal, dict) and is_error(refusal):
            raise refusal_of(robot, verb, refusal)
        why = plain_text(reply.get("error") or reply.get("reason"))
        said = error(f"{robot}: {with_meaning(why) or 'refused'}")
        if reply.get("type") != "error" and why.startswith("validation: "):
            self._require_verb(robot, verb, action)
        if reply.get("type") == "error" or why.startswith("validation: "):
            raise refusal_of_text(robot, verb, why, said)
        raise UnreachableError(why or "the mesh did not carry the call", robot=robot, verb=verb, envelope=said)

    def _require_verb(self, robot: str, verb: str, action: str) -> None:
        """Raise :class:`UnknownVerbError` where the robot lacks the verb."""
        from strands_robots.serving.advertised import verb_names  # noqa: PLC0415 - loaded when it is used

        names = verb_names(functions_of(self._joined_mesh, robot, VERB_S))
        if names and action not in names:
            text = f"{robot} has no verb {shown(verb)}.{near(verb, names)}"
            raise UnknownVerbError(text, robot=robot, verb=verb, envelope=error(text))

    def stop(
        self, robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False
    ) -> Envelope | None:
        """Stop the peer; *stopped* counts only where an enrolled robot has signed it."""
        from strands_robots.mesh.transport.config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - loaded when it is used

        # It leaves at once, and again until the peers in reach are known: a hub may not have linked it yet.
        mesh, longest = self._joined_mesh, discovery_timeout(DISCOVERY_S)
        if not is_in_reach(mesh, robot):
            known_in = max(UNSEEN_S, self._joined + (longest if insist else min(longest, FIND_S)) - time.monotonic())
            answer = stop_peer(mesh, robot, known_in, robot_name)
            if "in_reach" not in answer:
                return answer
            if not insist and not answer["in_reach"]:
                return None
        return stop_peer(mesh, robot, timeout, robot_name)

    def received(self, robot: str, verb: str, arguments: Mapping[str, Any]) -> ReceivedCall:
        """Return the call with the defaults of an action of ours."""
        from strands_robots.mesh.security import validate_command  # noqa: PLC0415 - loaded when it is used
        from strands_robots.serving.verbs import LEASE_NAMES  # noqa: PLC0415 - as above

        mesh, action = self._joined_mesh, self._action(robot, verb)
        given = self._given_to(robot, action, arguments)
        try:
            sent = given if self._owns(robot, action) else validate_command({**given, "action": action})
        except ValidationError as exc:
            raise ArgumentsError(str(exc), robot=robot, verb=verb) from exc
        left_out = LEASE_NAMES | {"action"}
        return ReceivedCall(mesh.peer_id, action, {name: value for name, value in sent.items() if name not in left_out})

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        """Send the peer an action, without the arguments that are empty.

        A verb of the robot's own gets them all.
        """
        return await self._requests.call(lambda: self.call(robot, verb, self._given_to(robot, verb, arguments), within))

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        """Return the peer as it describes itself, an older one by its kind."""
        try:
            functions = (await self.call_async(robot, "describe", {}, within)).get("functions")
        except UnknownVerbError:
            functions = None
        told = functions if isinstance(functions, list) else self.announced_functions(robot)
        return replace(self.known(robot), functions=told)

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        """Stop the peer on a thread that no call takes."""
        mesh = self._mesh
        if mesh is None:
            return error(CLOSED, stopped=None)
        return await self._requests.stop(mesh, robot, within, robot_name)

    @property
    def key(self) -> NetworkKey:
        """The name of the mesh that the settings, or a profile's, name.

        Raises:
            UnreachableError: the settings of a profile could not be put.
        """
        if self._key is None:
            raise UnreachableError("the mesh of the connection profile is not joined")
        return self._key

    @property
    def reach(self) -> str:
        """The mesh in words."""
        return "They were looked for on the native mesh."

    @property
    def on_this_machine(self) -> bool:
        """False: a hub may relay for other machines."""
        return False

    @property
    def meeting_port(self) -> int | None:
        """None: the hub may be another user's peer."""
        return None

    @property
    def stale(self) -> str:
        """Nothing: each peer announces itself."""
        return ""

    def stop_all(self, timeout: float = STOP_S) -> tuple[dict[str, Envelope], StopOutcome]:
        """Stop all peers in reach, and again while one has not confirmed it."""
        del timeout  # the mesh's own deadlines count
        return stop_peers(self._joined_mesh, self._fresh)

    def emergency_stop(
        self,
        reason: str,
        *,
        scope: Scope = EVERY_ROBOT,
        signing_key: Any = None,
        estop_id: str = "",
        remembers: Remembers | None = None,
        named: Collection[str] = (),
        deadline_s: float | None = None,
        on_progress: OnProgress = lambda progress: None,
    ) -> StopOutcome:
        """Stop and lock the peers; the mesh tells no progress."""
        del deadline_s, on_progress  # the mesh's own deadlines count
        return lock_peers(
            self._joined_mesh,
            signing_key,
            scope,
            reason=reason,
            estop_id=estop_id,
            since=self._fresh,
            remembers=remembers,
            named=named,
        )

    def verdict(self, outcome: StopOutcome) -> Envelope:
        """Return the outcome with the stop's id and scope."""
        report = outcome.report
        return {**roster_verdict(outcome), "estop_id": report.estop_id, **report.scope.field()}

    @contextmanager
    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> Iterator[StopSender]:
        """Make a controller that stops the peers under this peer's id."""
        mesh = self._joined_mesh
        with closing(stand_on_mesh(mesh, signing_key, known)):
            yield MeshController(mesh, signing_key)

    def beats(self, robots: Iterable[str]) -> Mapping[str, float | None]:
        """Return the times of the presence of those in reach."""
        rows, now = self._joined_mesh.peers_by_id, time.monotonic()
        living = {name: now - row["age"] for name, row in rows.items() if row["reachable"]}
        return {name: living.get(name) for name in robots}

    def lockable(self, timeout: float = FIND_S) -> list[str]:
        """Return the peers that have a robot, once those in reach are known."""
        del timeout  # which is the mesh's own
        discover(self._joined_mesh, since=self._joined)
        return lockable_peers(self._joined_mesh)

    def lockouts(self, robots: Iterable[str], timeout: float, *, signed: bool = False) -> list[LockoutReport]:
        """Ask each peer for its status; a robot of ours signs in any case."""
        del signed
        # The answer of a peer that was not seen yet is refused.
        discover(self._joined_mesh, since=self._joined)
        return ask_peers(self._joined_mesh, robots, timeout)

    async def lockout_async(self, robot: str, within: float) -> LockoutReport:
        """Ask the peer for its status."""
        mesh = self._mesh
        return (
            LockoutReport(robot, problem=CLOSED) if mesh is None else await self._requests.lockout(mesh, robot, within)
        )

    def resume(self, reports: Sequence[LockoutReport], signer: Any, timeout: float) -> dict[str, Resumed]:
        """Send the resumes of these peers, which relay them."""
        return resume_peers(self._joined_mesh, reports, signer, timeout)

    def beats_every(self, robot: str) -> float:
        """Return twice the time between two heartbeats, as one may come late."""
        from strands_robots.mesh import topics  # noqa: PLC0415 - loaded when it is used

        del robot
        return 2 / topics.BY_NAME["presence"].rate_hz

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        """Receive a robot's policy steps and safety events, or what all say."""
        return follow(self._joined_mesh, robot, on_event, next(self._subscriptions), detail)

    def close(self) -> None:
        """Leave the mesh."""
        self._requests.close()
        if self._given:
            return
        mesh, self._mesh = self._mesh, None
        if mesh is None:
            return
        try:
            mesh.close()
        finally:
            self._settings.give_back()

    @property
    def _joined_mesh(self) -> Mesh:
        if self._mesh is None:
            raise UnreachableError("The mesh is not joined: use the fleet as a context manager")
        return self._mesh

    @property
    def _fresh(self) -> float | None:
        """Time of joining, None where that was just now.

        The first stop of a command then waits for the others from its own sending on.
        """
        from strands_robots.mesh.transport.config import DISCOVERY_S  # noqa: PLC0415 - loaded when it is used

        return None if self._given and time.monotonic() < self._joined + DISCOVERY_S else self._joined

    def _rows(self) -> list[dict[str, Any]]:
        """Return the peers in reach, with a robot or without one."""
        return [row for row in self._joined_mesh.peers if row["reachable"]]

    def _judged(self) -> list[dict[str, Any]]:
        """Return the peers in reach, each with why its lockout is not believed."""
        rows, keys = self._rows(), enrolled_peers()
        for row in rows:
            row["tags"] = list(read_tags(row.get("tags")))
            if "locked" in row and (why := lockout_distrust(row["peer_id"], row, row.get("epochs") or [], keys)):
                row["distrusted"] = why
        return rows

    def _action(self, robot: str, verb: str) -> str:
        return verb if self._owns(robot, verb) else _ALIASES.get(verb, verb)

    def _owns(self, robot: str, verb: str) -> bool:
        own = (self._joined_mesh.get_peer(robot) or {}).get("own_verbs")
        return isinstance(own, list) and verb in own

    def _given_to(self, robot: str, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the arguments that an action of ours is sent with."""
        from strands_robots.serving.advertised import STOPS  # noqa: PLC0415 - loaded when it is used
        from strands_robots.serving.peer_verbs import PEER_VERBS  # noqa: PLC0415 - as above

        mesh = self._mesh
        if mesh is None or self._owns(robot, verb):
            return arguments
        given = {name: value for name, value in arguments.items() if value not in ("", None)}
        known, names = PEER_VERBS.get(verb), (mesh.get_peer(robot) or {}).get("sim_robots")
        # Where none is named the first robot of a world is meant; a stop then means all of them.
        if known is not None and "robot_name" in known.by_name and verb not in STOPS and isinstance(names, list):
            given = {"robot_name": next(iter(names), ""), **given}
        return given

    def _waited_for(self, robot: str) -> bool:
        """Return whether the peer is in reach, once that can be known."""
        from strands_robots.mesh.transport.config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

        # A loaded machine gets twice the time.
        return awaited(self._joined_mesh, robot, self._joined + max(discovery_timeout(DISCOVERY_S), 2 * DISCOVERY_S))

    @staticmethod
    def _linked() -> bool:
        """Return whether the mesh has a hub, once another peer had time to become it."""
        from strands_robots.mesh import session  # noqa: PLC0415 - loaded when it is used

        until = time.monotonic() + HUB_S
        while session.cut_off():
            if time.monotonic() >= until:
                return False
            time.sleep(LOOK_S)
        return True

    def _absent(self, robot: str, verb: str) -> NoSuchRobotError:
        remedy = near(robot, {*in_reach(self._joined_mesh)} - {robot}).strip()
        return NoSuchRobotError(f"No peer {robot!r} is on the mesh", robot=robot, verb=verb, remedy=remedy)


def _carried(robot: str, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the arguments as the mesh can carry them, else raise.

    A stop is never refused for its arguments: without them it stops all that the robot has.
    """
    problem = "the mesh cannot carry an argument called action" if "action" in arguments else ""
    try:
        for name, value in arguments.items():
            finite(name, value)
        json.dumps(arguments, allow_nan=False)
    except (ValidationError, TypeError, ValueError, RecursionError) as exc:
        problem = problem or str(exc)
    if problem and verb != "stop":
        raise ArgumentsError(problem, robot=robot, verb=verb)
    return {} if problem else arguments


def _named_as(verb: str, result: Mapping[str, Any]) -> Envelope:
    """Return an answer with the fields that its verb has on Device Connect."""
    rows = result.get("policies")
    if verb != "getStatus" or not isinstance(rows, list):
        return dict(result)
    running = {str(row.get("robot", "")): row for row in rows if isinstance(row, Mapping)}
    return {**result, "running_policies": running}


def _found(row: Mapping[str, Any]) -> FoundRobot:
    locked = row.get("locked")
    return FoundRobot(
        str(row["peer_id"]),
        plain_text(row.get("type"), 100),
        plain_text(row.get("tool_name"), 100),
        read_tags(row.get("tags")),
        status=plain_text(row.get("task_status"), 100),
        age_s=row.get("age"),
        # Of a peer whose key is another one only the lock is believed.
        locked=locked if locked is True or (locked is False and "distrusted" not in row) else None,
        facts=row,
    )
