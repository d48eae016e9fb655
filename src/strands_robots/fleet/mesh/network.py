"""Robots on the native mesh, for the calling side.

This peer has no robot and is never the mesh's hub: it joins a mesh by a hub on this machine, a
stated endpoint or multicast.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any, Self, TypeVar

from strands_robots.envelope import Envelope, error, is_error
from strands_robots.errors import (
    ArgumentsError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
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
    LockoutReport,
    NetworkBusyError,
    OnEvent,
    Place,
    ReceivedCall,
    Resumed,
    StopRequest,
    StopSender,
)
from strands_robots.fleet.mesh.config import MeshSettings, no_hub
from strands_robots.fleet.mesh.peers import (
    CALLER,
    CONSOLE,
    LOOK_S,
    awaited,
    discover,
    follow,
    functions_of,
    functions_of_each,
    functions_of_kind,
    has_robot,
    in_reach,
    is_in_reach,
    is_older,
)
from strands_robots.fleet.mesh.stops import (
    MeshController,
    ask_peer,
    ask_peers,
    lock_peers,
    lockable_peers,
    mesh_network,
    resume_peers,
    stand_on_mesh,
    stop_peer,
    stop_peers,
)
from strands_robots.fleet.reports import refusal_of, refusal_of_text, with_meaning
from strands_robots.fleet.shared_id import CachedKeys
from strands_robots.fleet.verdicts import roster_verdict
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.statements import enrolled_peers, lockout_distrust
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.tags import read_tags
from strands_robots.utils import MissingExtraError, ValidationError, finite, json_value, near, plain_text, shown

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


IN_FLIGHT = 64
"""Requests of one kind that wait for an answer at a time; threads are started as they are needed."""

STOPS_IN_FLIGHT = 1024
"""The same of stops: as many as a page has robots, so that the last one begins as soon as the first."""

T = TypeVar("T")


class PeerRequests:
    """Threads of one peer's requests; none waits for one of another kind."""

    def __init__(self) -> None:
        self.calls = ThreadPoolExecutor(IN_FLIGHT, "mesh call")
        self.stops = ThreadPoolExecutor(STOPS_IN_FLIGHT, "mesh stop")
        self.questions = ThreadPoolExecutor(IN_FLIGHT, "mesh question")

    def close(self) -> None:
        """Begin no more requests."""
        for pool in (self.calls, self.stops, self.questions):
            pool.shutdown(wait=False, cancel_futures=True)


async def _done(pool: ThreadPoolExecutor, work: Callable[[], T], failed: Callable[[str], T]) -> T:
    """Return what ``work`` returns on a thread of the pool.

    Where it does not, return what ``failed`` makes of the reason.
    """
    try:
        begun = pool.submit(work)
    except RuntimeError:
        return failed(CLOSED)
    try:
        return await asyncio.wrap_future(begun)
    except asyncio.CancelledError:
        # Of the pool that is closed, not of the task that waits.
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        return failed(CLOSED)
    except Exception as exc:  # noqa: BLE001 - a request that fails is answered, whatever it raised
        return failed(plain_text(str(exc)) or type(exc).__name__)


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
    # A hub may relay for other machines, and be another user's peer.
    place = Place("They were looked for on the native mesh.")

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
        self._keys = CachedKeys(enrolled_peers)

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
            self._mesh = _dialled(self._source, console=self._console)
        except BaseException:
            self._settings.give_back()
            raise
        self._joined, self._requests = time.monotonic(), PeerRequests()
        self._keys = CachedKeys(enrolled_peers)

    def find(self, timeout: float | None = FIND_S, *, peers: bool = False) -> list[FoundRobot]:
        """Return the robots in reach, once they had the time to announce themselves.

        Raises:
            UnreachableError: no stated endpoint answers.
        """
        if timeout is None:
            discover(self.peer, since=self._fresh)
        elif peers:
            time.sleep(max(0.0, self._joined + timeout - time.monotonic()))
        else:
            discover(self.peer, since=self._joined, within=timeout)
        _require_link(self.peer)
        if peers:
            return [_found(row) for row in _judged(self.peer)]
        self._discoveries += 1
        lockable, rows = {*lockable_peers(self.peer)}, {str(row["peer_id"]): row for row in _judged(self.peer)}
        return [
            replace(
                _found(row),
                must_answer=name in lockable,
                world=world if (world := name.rpartition("__")[0]) in rows else "",
            )
            for name, row in rows.items()
            if has_robot(row)
        ]

    def known(self, robot: str) -> FoundRobot:
        """Return what the peer announced last."""
        return _found(self.peer.get_peer(robot) or {"peer_id": robot})

    def announced(self) -> Collection[str]:
        """Return the robots in reach."""
        return [str(row["peer_id"]) for row in self.peer.peers if row["reachable"] and has_robot(row)]

    def bears(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach."""
        mesh = self.peer
        return is_in_reach(mesh, robot) and has_robot(mesh.get_peer(robot) or {})

    def reaches(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach, once peers are known."""
        return self._waited_for(robot) and self.bears(robot)

    def session(self, robot: str) -> object:
        """Return the session of the peer, and the number of discoveries."""
        return self.peer.peer_wire_zid(robot), self._discoveries

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the peer's enrolled key."""
        return (enrolled_peers() or {}).get(robot)

    def announced_functions(self, robot: str) -> object:
        """Return the functions of the peer's kind."""
        row = self.peer.get_peer(robot) or {}
        return functions_of_kind(row, usual="world" if row.get("type") == "sim" else "robot")

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions, of an older one those of its kind."""
        del anew  # the robot is always asked
        if not (self._waited_for(robot) and _linked()):
            raise _absent(self.peer, robot, "describe")
        functions = functions_of(self.peer, robot, DESCRIBE_S)
        return self.announced_functions(robot) if functions is None else functions

    def describe_each(self, robots: Iterable[str]) -> Mapping[str, object]:
        """Ask many peers at once; of a silent one return the functions of its kind."""
        rows = self.peer.peers_by_id
        stated = {name: rows[name] for name in robots if "robot_kind" in rows.get(name, ())}
        functions = functions_of_each(self.peer, stated)
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
            raise _absent(self.peer, robot, name)
        return find_verb(functions_of(self.peer, robot, VERB_S), name)

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Send the peer an action."""
        arguments = _carried(robot, verb, arguments)
        mesh = self.peer
        try:
            there = self._waited_for(robot)
            if verb not in ALWAYS_SENT and not (there and _linked()):
                raise _absent(self.peer, robot, verb)
            action = _action(mesh, robot, verb)
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
                raise _absent(self.peer, robot, verb)
            raise NoAnswerError(f"{robot} did not answer", robot=robot, verb=verb)
        refusal = reply.get("refusal")
        if reply.get("type") == "error" and isinstance(refusal, dict) and is_error(refusal):
            raise refusal_of(robot, verb, refusal)
        why = plain_text(reply.get("error") or reply.get("reason"))
        said = error(f"{robot}: {with_meaning(why) or 'refused'}")
        if reply.get("type") != "error" and why.startswith("validation: "):
            _require_verb(mesh, robot, verb, action)
        if reply.get("type") == "error" or why.startswith("validation: "):
            raise refusal_of_text(robot, verb, why, said)
        raise UnreachableError(why or "the mesh did not carry the call", robot=robot, verb=verb, envelope=said)

    def stop(
        self, robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False
    ) -> Envelope | None:
        """Stop the peer; *stopped* counts only where an enrolled robot has signed it."""
        from strands_robots.mesh.transport.config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - loaded when it is used

        # It leaves at once, and again until the peers in reach are known: a hub may not have linked it yet.
        mesh, longest = self.peer, discovery_timeout(DISCOVERY_S)
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

        mesh = self.peer
        action = _action(mesh, robot, verb)
        given = _given_to(mesh, robot, action, arguments)
        try:
            sent = given if _owns(mesh, robot, action) else validate_command({**given, "action": action})
        except ValidationError as exc:
            raise ArgumentsError(str(exc), robot=robot, verb=verb) from exc
        left_out = LEASE_NAMES | {"action"}
        return ReceivedCall(mesh.peer_id, action, {name: value for name, value in sent.items() if name not in left_out})

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        """Send the peer an action, without the arguments that are empty.

        A verb of the robot's own gets them all.
        """

        def answered() -> Envelope | RefusalError:
            try:
                return self.call(robot, verb, _given_to(self._mesh, robot, verb, arguments), within)
            except RefusalError as refusal:
                return refusal

        answer = await _done(self._requests.calls, answered, NoAnswerError)
        if isinstance(answer, RefusalError):
            raise answer
        return answer

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        """Return the peer as it describes itself, an older one by its kind."""
        if self._mesh is not None and is_older(self._mesh.get_peer(robot)):
            return replace(self.known(robot), functions=self.announced_functions(robot))
        try:
            functions = (await self.call_async(robot, "describe", {}, within)).get("functions")
        except UnknownVerbError:
            functions = None
        told = functions if isinstance(functions, list) else self.announced_functions(robot)
        return replace(self.known(robot), functions=told)

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        """Stop the peer on a thread that no call takes.

        *Stopped* counts only where an enrolled robot has signed it.
        """
        mesh = self._mesh
        if mesh is None:
            return error(CLOSED, stopped=None)
        return await _done(
            self._requests.stops,
            lambda: stop_peer(mesh, robot, within, robot_name),
            lambda why: error(why, stopped=None),
        )

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
    def stale(self) -> str:
        """Nothing: each peer announces itself."""
        return ""

    def stop_all(self, timeout: float = STOP_S) -> tuple[dict[str, Envelope], StopOutcome]:
        """Stop all peers in reach, and again while one has not confirmed it."""
        del timeout  # the mesh's own deadlines count
        return stop_peers(self.peer, self._fresh)

    def emergency_stop(self, request: StopRequest) -> StopOutcome:
        """Stop and lock the peers.

        The mesh tells no progress, and its own deadlines count.
        """
        return lock_peers(self.peer, request, self._fresh)

    def verdict(self, outcome: StopOutcome) -> Envelope:
        """Return the outcome with the stop's id and scope."""
        report = outcome.report
        return {**roster_verdict(outcome), "estop_id": report.estop_id, **report.scope.field()}

    @contextmanager
    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> Iterator[StopSender]:
        """Make a controller that stops the peers under this peer's id."""
        mesh = self.peer
        with closing(stand_on_mesh(mesh, signing_key, known)):
            yield MeshController(mesh, signing_key)

    def beats(self, robots: Iterable[str]) -> Mapping[str, float | None]:
        """Return the times of the presence of those in reach."""
        rows, now = self.peer.peers_by_id, time.monotonic()
        living = {name: now - row["age"] for name, row in rows.items() if row["reachable"]}
        return {name: living.get(name) for name in robots}

    def lockable(self, timeout: float = FIND_S) -> list[str]:
        """Return the peers that have a robot, once those in reach are known."""
        del timeout  # which is the mesh's own
        discover(self.peer, since=self._joined)
        return lockable_peers(self.peer)

    def lockouts(self, robots: Iterable[str], timeout: float, *, signed: bool = False) -> list[LockoutReport]:
        """Ask each peer for its status; a robot of ours signs in any case."""
        del signed
        # The answer of a peer that was not seen yet is refused.
        discover(self.peer, since=self._joined)
        return ask_peers(self.peer, robots, timeout)

    async def lockout_async(self, robot: str, within: float) -> LockoutReport:
        """Ask the peer for its status."""
        mesh = self._mesh
        if mesh is None:
            return LockoutReport(robot, problem=CLOSED)
        return await _done(
            self._requests.questions,
            lambda: ask_peer(mesh, robot, within, self._keys.read()),
            lambda why: LockoutReport(robot, problem=why),
        )

    def resume(self, reports: Sequence[LockoutReport], signer: Any, timeout: float) -> dict[str, Resumed]:
        """Send the resumes of these peers, which relay them."""
        return resume_peers(self.peer, reports, signer, timeout)

    def beats_every(self, robot: str) -> float:
        """Return twice the time between two heartbeats, as one may come late."""
        from strands_robots.mesh import topics  # noqa: PLC0415 - loaded when it is used

        del robot
        return 2 / topics.BY_NAME["presence"].rate_hz

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        """Receive a robot's policy steps and safety events, or what all say."""
        return follow(self.peer, robot, on_event, next(self._subscriptions), detail)

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
    def peer(self) -> Mesh:
        """This caller as a peer, once it has joined."""
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

    def _waited_for(self, robot: str) -> bool:
        """Return whether the peer is in reach, once that can be known."""
        from strands_robots.mesh.transport.config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

        # A loaded machine gets twice the time.
        return awaited(self.peer, robot, self._joined + max(discovery_timeout(DISCOVERY_S), 2 * DISCOVERY_S))


def _dialled(source: str, *, console: bool) -> Mesh:
    """Join the mesh as a peer without a robot.

    Raises:
        UnreachableError: there is none.
    """
    from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.core import Mesh, Parts  # noqa: PLC0415 - as above
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
    from strands_robots.mesh.transport.config import stated_endpoints  # noqa: PLC0415 - as above
    from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

    try:
        name, kind = (source, CONSOLE) if console else (visitor_id(source), CALLER)
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


def _require_verb(mesh: Mesh, robot: str, verb: str, action: str) -> None:
    """Raise :class:`UnknownVerbError` where the robot lacks the verb."""
    from strands_robots.serving.advertised import verb_names  # noqa: PLC0415 - loaded when it is used

    names = verb_names(functions_of(mesh, robot, VERB_S))
    if names and action not in names:
        text = f"{robot} has no verb {shown(verb)}.{near(verb, names)}"
        raise UnknownVerbError(text, robot=robot, verb=verb, envelope=error(text))


def _judged(mesh: Mesh) -> list[dict[str, Any]]:
    """Return the peers in reach, each with why its lockout is not believed."""
    rows, keys = [row for row in mesh.peers if row["reachable"]], enrolled_peers()
    for row in rows:
        row["tags"] = list(read_tags(row.get("tags")))
        if "locked" in row and (why := lockout_distrust(row["peer_id"], row, row.get("epochs") or [], keys)):
            row["distrusted"] = why
    return rows


def _action(mesh: Mesh, robot: str, verb: str) -> str:
    return verb if _owns(mesh, robot, verb) else _ALIASES.get(verb, verb)


def _owns(mesh: Mesh, robot: str, verb: str) -> bool:
    own = (mesh.get_peer(robot) or {}).get("own_verbs")
    return isinstance(own, list) and verb in own


def _given_to(mesh: Mesh | None, robot: str, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the arguments that an action of ours is sent with."""
    from strands_robots.serving.advertised import STOPS  # noqa: PLC0415 - loaded when it is used
    from strands_robots.serving.peer_verbs import PEER_VERBS  # noqa: PLC0415 - as above

    if mesh is None or _owns(mesh, robot, verb):
        return arguments
    given = {name: value for name, value in arguments.items() if value not in ("", None)}
    known, names = PEER_VERBS.get(verb), (mesh.get_peer(robot) or {}).get("sim_robots")
    # Where none is named the first robot of a world is meant; a stop then means all of them.
    if known is not None and "robot_name" in known.by_name and verb not in STOPS and isinstance(names, list):
        given = {"robot_name": next(iter(names), ""), **given}
    return given


def _linked() -> bool:
    """Return whether the mesh has a hub, once another peer had time to become it."""
    from strands_robots.mesh import session  # noqa: PLC0415 - loaded when it is used

    until = time.monotonic() + HUB_S
    while session.cut_off():
        if time.monotonic() >= until:
            return False
        time.sleep(LOOK_S)
    return True


def _require_link(mesh: Mesh) -> None:
    """Raise :class:`UnreachableError` where no stated endpoint answers."""
    from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.transport.config import stated_endpoints  # noqa: PLC0415 - as above

    connects, _ = stated_endpoints()
    if connects and not in_reach(mesh) and session.cut_off():
        raise UnreachableError(f"the mesh does not answer at {', '.join(connects)}")


def _absent(mesh: Mesh, robot: str, verb: str) -> NoSuchRobotError:
    remedy = near(robot, {*in_reach(mesh)} - {robot}).strip()
    return NoSuchRobotError(f"No peer {robot!r} is on the mesh", robot=robot, verb=verb, remedy=remedy)


def _carried(robot: str, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the arguments as the mesh can carry them, else raise.

    A stop is never refused for its arguments: without them it stops all that the robot has.
    """
    problem = "the mesh cannot carry an argument called action" if "action" in arguments else ""
    try:
        for name, value in arguments.items():
            finite(name, value)
        json.dumps(arguments, allow_nan=False, default=json_value)
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
