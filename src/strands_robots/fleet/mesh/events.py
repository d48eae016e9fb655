"""Messages of the mesh's peers as events in the shape of the calling side."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.fleet.adapter import EVERY, Detail, OnEvent, RobotEvent
from strands_robots.fleet.reports import task_of
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

LOAD_MAX = 1000.0

STREAM, STEP = "stream", "streamStep"
"""Name of a policy step: as an event, and in a recording."""

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
        topics.stream(robot): (STREAM, _named(STEP, on_event)),
        topics.camera(robot, "*"): ("camera", picture),
        topics.safety_event(robot): ("safety_event", _named("safety_event", on_event)),
        topics.estop(): ("estop", of_fleet("emergencyStop")),
        topics.resume(): ("resume", of_fleet("resume")),
    }


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
        topics.state(EVERY): ("state", state),
        topics.presence(EVERY): ("presence", presence),
        topics.sensor(EVERY, "health"): ("health", health),
        topics.safety_event(EVERY): ("safety_event", safety_event),
    }


def _sender(key: str) -> str:
    """Return the peer that a key names, behind the root."""
    return key.split("/", 2)[1]
