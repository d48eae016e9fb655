"""Peers of the mesh: waited for, their verbs, and their messages as events."""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from strands_robots.fleet.adapter import EVERY, Detail, OnEvent, RobotEvent
from strands_robots.fleet.reports import task_of
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

LOOK_S = 0.05

CALLER, CONSOLE = "tool", "controller"
"""Types of peers of ours that call robots, or stop them, and have none."""


def has_robot(row: Mapping[str, Any]) -> bool:
    """Return whether a peer states that it has a robot."""
    return "locked" in row or "tool_name" in row or "robot_kind" in row


def only_calls(row: Mapping[str, Any]) -> bool:
    """Return whether a peer is a program that has no robot; such ones come and go."""
    return row.get("type") in (CALLER, CONSOLE) and not has_robot(row)


def must_answer(mesh: Mesh) -> list[str]:
    """Return the peers in reach that have to answer a stop."""
    return [row["peer_id"] for row in mesh.peers if row["reachable"] and not only_calls(row)]


def in_reach(mesh: Mesh) -> list[str]:
    """Return the ids of the peers in reach, without a robot or with one."""
    return [row["peer_id"] for row in mesh.peers if row["reachable"]]


def discover(
    mesh: Mesh,
    meanwhile: Callable[[], object] = lambda: None,
    *,
    since: float | None = None,
    within: float = math.inf,
) -> None:
    """Wait until the peers in reach are known, calling ``meanwhile`` repeatedly.

    A link to a stated endpoint that failed is retried with back-off, so such a peer may be silent for up to 8 s.

    Args:
        mesh: the peer that waits.
        meanwhile: called each time it has looked.
        since: when it joined, in monotonic seconds; just now by default.
        within: seconds from now that are waited at most for such links.
    """
    from strands_robots.mesh.transport.config import (  # noqa: PLC0415 - loaded when it is used
        DISCOVERY_S,
        LINK_DISCOVERY_S,
        stated_endpoints,
    )

    now, patient = time.monotonic(), math.isinf(within)
    began = now if since is None else since
    ends = min(began + LINK_DISCOVERY_S, max(began + DISCOVERY_S, now + within))
    connects, listens = stated_endpoints()
    found = began if in_reach(mesh) and not patient else math.inf
    while (now := time.monotonic()) < ends:
        if in_reach(mesh):
            found = min(found, now)
        # A listener cannot know how many will still connect to it.
        known = now >= found + DISCOVERY_S if connects or (listens and not patient) else now >= began + DISCOVERY_S
        if known and not (listens and patient):
            return
        meanwhile()
        time.sleep(LOOK_S)


def awaited(mesh: Mesh, peer: str, until: float) -> bool:
    """Wait for a peer until a monotonic time; return whether it is in reach."""
    while not is_in_reach(mesh, peer):
        if time.monotonic() >= until:
            return False
        time.sleep(LOOK_S)
    return True


def is_in_reach(mesh: Mesh, peer: str) -> bool:
    """Return whether a peer is in reach."""
    row = mesh.get_peer(peer)
    return row is not None and bool(row["reachable"])


LIST_S, LISTED_AT_ONCE = 1.0, 32
"""Seconds in which many peers have to describe their verbs, and how many are asked at once."""


def functions_of(mesh: Mesh, peer: str, seconds: float) -> list[Any] | None:
    """Return the functions that a peer describes; None if it does not.

    A peer of a 0.5 release is not asked: it refuses the question.
    """
    if is_older(mesh.get_peer(peer)):
        return None
    result = mesh.send(peer, {"action": "describe"}, seconds).get("result")
    functions = result.get("functions") if isinstance(result, Mapping) else None
    return functions if isinstance(functions, list) else None


def functions_of_each(mesh: Mesh, peers: Collection[str]) -> dict[str, list[Any]]:
    """Return the functions of the peers that describe them in time."""
    ends, found = time.monotonic() + LIST_S, dict[str, list[Any]]()

    def described(peer: str) -> None:
        left = ends - time.monotonic()
        functions = functions_of(mesh, peer, left) if left > 0 else None
        if functions is not None:
            found[peer] = functions

    if peers:
        with ThreadPoolExecutor(min(len(peers), LISTED_AT_ONCE), "describe") as pool:
            list(pool.map(described, peers))
    return found


def is_older(row: Mapping[str, Any] | None) -> bool:
    """Return True for a peer of a 0.5 release."""
    return row is not None and row.get("older") is True


OLDER_ACTIONS = (
    *("status", "stop", "features", "state", "execute", "start", "step", "reset", "resume", "ping"),
    *("teleop_status", "teleop_receive", "teleop_stop"),
)
"""Actions of 0.5 releases."""

OLDER_LACK = frozenset({"nonce", "lease_id", "lease_ttl_s"})
"""Arguments of these that they refuse."""


def functions_of_kind(row: Mapping[str, Any], usual: str = "") -> list[Any]:
    """Return the functions of a peer by its presence alone.

    Args:
        row: its presence.
        usual: the kind where it states none that is known; without one it has its own verbs alone. A peer of a 0.5
            release has no leases, and fewer actions.
    """
    from strands_robots.serving.peer_verbs import KINDS, PEER_VERBS  # noqa: PLC0415 - loaded when it is used
    from strands_robots.serving.verbs import described  # noqa: PLC0415 - as above

    kind, own = row.get("robot_kind"), row.get("own_verbs")
    actions = KINDS.get(kind if isinstance(kind, str) else "", KINDS.get(usual, ()))
    named = [{"name": name, "labels": {"own": "true"}} for name in own] if isinstance(own, list) else []
    older = is_older(row)
    functions = [described(PEER_VERBS[name]) for name in actions if name in OLDER_ACTIONS or not older]
    for each in functions if older else ():
        known = each["parameters"]["properties"].items()
        each["parameters"]["properties"] = {name: stated for name, stated in known if name not in OLDER_LACK}
    return [*functions, *named]


LOAD_MAX = 1000.0

STREAM, STEP = "stream", "streamStep"
"""Name of a policy step: as an event, and in a recording."""

TURN = "turnChanged"
"""Event of another driver, of a robot that a leader elsewhere has."""

OF_FLEET = "strands/safety/"
"""Topics of emergency stops and resumes, which are no robot's."""

OnMessage = Callable[[str, dict[str, Any]], None]


def follow(
    mesh: Mesh, robot: str, on_event: OnEvent, number: int, detail: Detail = Detail.EVENTS
) -> Callable[[], None]:
    """Receive events of a robot, or of all; return the function that ends it.

    Args:
        mesh: a joined peer.
        robot: an id, whose policy steps, safety events, and heartbeats that tell of another task or lockout are
            received, or :data:`EVERY`.
        on_event: takes each event.
        number: tells this subscription from the others of the peer.
        detail: the messages that are received besides.
    """
    if detail is Detail.ALL:
        receivers = _recorded(robot, on_event)
    elif robot == EVERY:
        receivers = _of_all(mesh, on_event)
    else:
        receivers = _of_one(mesh, robot, on_event, states=detail is Detail.STATES)
    names = []
    for key, (name, receive) in receivers.items():
        # Those of the fleet arrive once, however many robots are recorded.
        names.append(f"fleet {name}" if key.startswith(OF_FLEET) else f"fleet {number} {name}")
        mesh.subscribe(key, receive, names[-1])

    def end() -> None:
        for each in names:
            mesh.unsubscribe(each)

    return end


def _of_one(mesh: Mesh, robot: str, on_event: OnEvent, *, states: bool) -> dict[str, tuple[str, OnMessage]]:
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

    last = [_condition(mesh.get_peer(robot))]

    def state(_key: str, message: Mapping[str, Any]) -> None:
        if message.get("peer_id") == robot:
            on_event(RobotEvent(robot, "state", message, joints=_positions(message), task=_task(message)))

    def presence(_key: str, message: Mapping[str, Any]) -> None:
        row = mesh.get_peer(robot) if message.get("robot_id") == robot else None
        if row is not None and last[0] != (now := _condition(row)):
            last[0] = now
            on_event(RobotEvent(robot, "presence", message, task=task_of(row)))

    receivers = {
        topics.stream(robot): (STREAM, _named(STREAM, on_event)),
        topics.turn(robot): ("turn", _named(TURN, on_event)),
        topics.safety_event(robot): ("safety_event", _named("safety_event", on_event)),
        topics.presence(robot): ("presence", presence),
    }
    return {**receivers, topics.state(robot): ("state", state)} if states else receivers


def _recorded(robot: str, on_event: OnEvent) -> dict[str, tuple[str, OnMessage]]:
    from strands_robots.mesh import topics  # noqa: PLC0415 - as above

    def picture(key: str, message: Mapping[str, Any]) -> None:
        camera = key.rpartition("/")[2]
        try:
            jpeg: bytes | None = base64.b64decode(message.get("data", ""), validate=True)
        except (TypeError, ValueError):
            jpeg = None
        on_event(RobotEvent(_sender(key), f"camera_{camera}", message, part=camera, picture=jpeg))

    def of_fleet(name: str) -> OnMessage:
        return lambda _, message: on_event(RobotEvent(str(message.get("peer_id") or "mesh"), name, message))

    return {
        topics.state(robot): ("state", _named("state", on_event)),
        topics.stream(robot): (
            STREAM,
            lambda key, message: on_event(RobotEvent(_sender(key), STEP, _of_one_robot(message))),
        ),
        topics.turn(robot): ("turn", _named(TURN, on_event)),
        topics.camera(robot, "*"): ("camera", picture),
        topics.safety_event(robot): ("safety_event", _named("safety_event", on_event)),
        topics.estop(): ("estop", of_fleet("emergencyStop")),
        topics.resume(): ("resume", of_fleet("resume")),
    }


def _of_one_robot(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a step of a robot of a world with its joints by their own names."""
    if "robot_name" not in message:
        return message
    prefix = f"{message['robot_name']}/"
    own = {
        name: {key.removeprefix(prefix): value for key, value in message[name].items()}
        for name in ("observation", "action")
        if isinstance(message.get(name), Mapping)
    }
    return {**message, **own}


def _named(name: str, on_event: OnEvent) -> OnMessage:
    return lambda key, message: on_event(RobotEvent(_sender(key), name, message))


def _positions(message: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the joints' positions; those of a world come with velocities."""
    joints = message.get("joints")
    if not isinstance(joints, Mapping):
        return None
    return {name: each.get("position") if isinstance(each, Mapping) else each for name, each in joints.items()}


def _task(message: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the task of a state; a world without one is idle."""
    task, degraded = message.get("task", {}), message.get("degraded")
    if not isinstance(task, Mapping) or (isinstance(degraded, Mapping) and "task" in degraded):
        return None
    return task_of({**task, "task_status": task.get("status"), "step_count": task.get("steps")})


def _condition(row: Mapping[str, Any] | None) -> object:
    """Return the task and the lockouts that a heartbeat tells, without the step."""
    return None if row is None else ({**task_of(row), "step": None}, row.get("locked"), row.get("epochs"))


def _of_all(mesh: Mesh, on_event: OnEvent) -> dict[str, tuple[str, OnMessage]]:
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

    def state(key: str, message: Mapping[str, Any]) -> None:
        robot = _sender(key)
        if message.get("peer_id") == robot:
            on_event(RobotEvent(robot, "state", message, joints=_positions(message), frequent=True))

    # An idle robot's states are further apart than its heartbeats.
    def presence(key: str, message: Mapping[str, Any]) -> None:
        robot = _sender(key)
        # The row has only what this peer accepts of a heartbeat.
        row = mesh.get_peer(robot) if message.get("robot_id") == robot else None
        if row is not None:
            on_event(RobotEvent(robot, "presence", message, task=task_of(row), frequent=True))

    def health(key: str, message: Mapping[str, Any]) -> None:
        load = message.get("cpu_load")
        if isinstance(load, int | float) and not isinstance(load, bool) and 0 <= load < LOAD_MAX:
            on_event(RobotEvent(_sender(key), "health", message, load=float(load), frequent=True, alive=False))

    def safety_event(key: str, message: Mapping[str, Any]) -> None:
        name = message.get("event", message.get("type"))
        on_event(RobotEvent(_sender(key), plain_text(name, 100) or "safety event", message, alive=False))

    return {
        topics.turn(EVERY): ("turn", _named(TURN, on_event)),
        topics.state(EVERY): ("state", state),
        topics.presence(EVERY): ("presence", presence),
        topics.sensor(EVERY, "health"): ("health", health),
        topics.safety_event(EVERY): ("safety_event", safety_event),
    }


def _sender(key: str) -> str:
    """Return the peer that a key names, behind the root."""
    return key.split("/", 2)[1]
