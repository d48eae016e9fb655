"""Messages of the mesh's peers as events in the shape of the calling side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.fleet.adapter import EVERY, OnEvent, RobotEvent
from strands_robots.fleet.robot_task import task_of
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

LOAD_MAX = 1000.0

OnMessage = Callable[[str, dict[str, Any]], None]


def follow(mesh: Mesh, robot: str, on_event: OnEvent, number: int) -> Callable[[], None]:
    """Receive events of a robot, or of all; return the function that ends it.

    Args:
        mesh: a joined peer.
        robot: an id, whose policy steps, safety events, and heartbeats that tell of another task or lockout are
            received, or :data:`EVERY`.
        on_event: takes each event.
        number: tells this subscription from the others of the peer.
    """
    receivers = _of_all(mesh, on_event) if robot == EVERY else _of_one(mesh, robot, on_event)
    names = []
    for key, (name, receive) in receivers.items():
        names.append(f"fleet {number} {name}")
        mesh.subscribe(key, receive, names[-1])

    def end() -> None:
        for each in names:
            mesh.unsubscribe(each)

    return end


def _of_one(mesh: Mesh, robot: str, on_event: OnEvent) -> dict[str, tuple[str, OnMessage]]:
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

    last = [_condition(mesh.get_peer(robot))]

    def receiver(name: str) -> OnMessage:
        return lambda key, message: on_event(RobotEvent(robot, name, message))

    def presence(key: str, message: Mapping[str, Any]) -> None:
        row = mesh.get_peer(robot) if message.get("robot_id") == robot else None
        if row is not None and last[0] != (now := _condition(row)):
            last[0] = now
            on_event(RobotEvent(robot, "presence", message, task=task_of(row)))

    named = {topics.stream(robot): "stream", topics.safety_event(robot): "safety_event"}
    receivers = {key: (name, receiver(name)) for key, name in named.items()}
    return {**receivers, topics.presence(robot): ("presence", presence)}


def _condition(row: Mapping[str, Any] | None) -> object:
    """Return the task and the lockouts that a heartbeat tells, without the step."""
    return None if row is None else ({**task_of(row), "step": None}, row.get("locked"), row.get("epochs"))


def _of_all(mesh: Mesh, on_event: OnEvent) -> dict[str, tuple[str, OnMessage]]:
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

    def state(key: str, message: Mapping[str, Any]) -> None:
        robot, joints = _sender(key), message.get("joints")
        if message.get("peer_id") == robot:
            found = joints if isinstance(joints, Mapping) else None
            on_event(RobotEvent(robot, "state", message, joints=found, frequent=True))

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
