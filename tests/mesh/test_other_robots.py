"""Mobile bases and Reachy Mini as peers of the mesh, on the in-memory transport."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.ros_bases import SHUT, velocities
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.adapted import adapt_world
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.mesh.core import Mesh
from strands_robots.ros.link import Goal, OnMessage, Unwatch
from strands_robots.safety.authorization import Grants
from strands_robots.serving.stops import OneRobot, robot_stop
from strands_robots.state_files import state_dir

NAV = "/navigate_to_pose"
STANDING = {"twist": {"twist": {"linear": {"x": 0.0}, "angular": {"z": 0.0}}}}


class StandingBase(MemoryLink):
    """A graph on which the odometry of a base that stands is told to each new reader."""

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        unwatch = super().watch(topic, kind, on_message)
        if topic == "/odom":
            on_message(STANDING)
        return unwatch


@pytest.fixture
def link() -> MemoryLink:
    return StandingBase()


@pytest.fixture
def goals() -> list[Goal]:
    return []


@pytest.fixture
def base(link: MemoryLink, goals: list[Goal]) -> Iterator[RosBridgedRobot]:
    link.serve(NAV, lambda goal, feedback, sent: goals.append(sent))
    link.watch("/cmd_vel", None, lambda _: link.publish("/odom", "nav_msgs/msg/Odometry", STANDING))
    robot = RosBridgedRobot("rover", "/cmd_vel", "/odom", nav_action=NAV, link=link, command_gate=SHUT)
    yield robot
    robot.disconnect()


@pytest.fixture
def console(peers: Fleet) -> Mesh:
    return peers.join(None, "console")


def send(console: Mesh, peer: str, action: str, **arguments: Any) -> dict[str, Any]:
    reply = console.send(peer, {"action": action, **arguments}, timeout=20)
    return reply if "result" not in reply else {"error": "", **reply["result"]}


def test_base_is_driven_over_the_mesh_once_approved_and_stopped_by_anyone(
    peers: Fleet, base: RosBridgedRobot, link: MemoryLink, console: Mesh
) -> None:
    peers.join(base, "base-1")
    order = {"linear": 0.5, "angular": 0.0, "duration": 30.0}
    assert "strands-robots grant drive@base-1" in send(console, "base-1", "drive", **order)["error"]
    assert not velocities(link)
    Grants(state_dir() / "grants").grant("drive", "base-1")
    assert send(console, "base-1", "drive", **order)["status"] == "success"
    eventually(lambda: (0.5, 0.0) in velocities(link), what="a velocity")
    assert send(console, "base-1", "status")["task_status"] == "running"
    assert send(console, "base-1", "stop")["ok"] is True
    assert velocities(link)[-1] == (0.0, 0.0)
    assert send(console, "base-1", "status")["task_status"] == "stopped"


def test_base_navigates_over_the_mesh(peers: Fleet, base: RosBridgedRobot, goals: list[Goal], console: Mesh) -> None:
    peers.join(base, "base-1")
    Grants(state_dir() / "grants").grant("navigateTo", "base-1")
    assert send(console, "base-1", "navigateTo", x=1.0, y=2.0)["status"] == "success"
    eventually(lambda: goals, what="the goal")
    goals[0].end(4, {})
    eventually(lambda: send(console, "base-1", "status")["task_status"] == "completed", what="the arrival")


@pytest.mark.parametrize(
    ("action", "arguments", "says"),
    [
        ("drive", {"linear": float("nan"), "angular": 0.0, "duration": 1.0}, "linear"),
        ("drive", {"linear": 0.1, "angular": 0.0, "duration": True}, "duration"),
        ("navigateTo", {"x": 1.0}, "y is missing"),
        ("look", {"pitch": 41}, "pitch"),
        ("playMove", {"move_name": "a b"}, "move_name"),
        ("playMove", {"move_name": "joy", "library": "films"}, "library"),
    ],
)
def test_argument_outside_its_domain_is_refused_by_name(
    peers: Fleet, base: RosBridgedRobot, link: MemoryLink, console: Mesh, action: str, arguments: Any, says: str
) -> None:
    peers.join(base, "base-1")
    assert says in str(send(console, "base-1", action, **arguments))
    assert not velocities(link)


@pytest.mark.parametrize(
    ("action", "arguments", "says"),
    [
        ("drive", {"linear": 0.1, "angular": 0.0, "duration": 1.0}, "no mobile base"),
        ("navigateTo", {"x": 1.0, "y": 0.0}, "no navigation stack"),
        ("look", {"pitch": 10}, "no Reachy Mini"),
        ("playMove", {"move_name": "joy"}, "no Reachy Mini"),
    ],
)
def test_verb_of_another_kind_of_robot_is_refused_by_name(
    peers: Fleet, console: Mesh, action: str, arguments: Any, says: str
) -> None:
    peers.join(World("left"), "sim-1", "sim")
    answer = send(console, "sim-1", action, **arguments)
    assert answer["status"] == "error"
    assert says in answer["reason"]


def test_reachy_that_is_away_says_so_over_the_mesh(peers: Fleet, console: Mesh) -> None:
    reachy = ReachyDriver("127.0.0.1", api_port=1)
    peers.join(reachy, "head-1")
    status = send(console, "head-1", "status")
    assert (status["task_status"], status["connected"]) == ("idle", False)
    assert "strands-robots grant look@head-1" in send(console, "head-1", "look", pitch=10)["error"]
    Grants(state_dir() / "grants").grant("look", "head-1")
    assert send(console, "head-1", "look", pitch=10)["status"] == "error"
    assert "look, a gesture such as nod, or playMove" in str(reachy.start_task("wave"))
    answer = send(console, "head-1", "stop")
    assert answer["ok"] is False, "nobody could ask the daemon"
    assert "did not answer GET /api/move/running" in answer["error"]


def test_presence_names_the_kind_whose_actions_the_tool_lists(
    peers: Fleet, base: RosBridgedRobot, console: Mesh
) -> None:
    for robot, peer in ((base, "base-1"), (Arm(), "arm-1"), (ReachyDriver("127.0.0.1", api_port=1), "head-1")):
        peers.join(robot, peer)
    eventually(lambda: peers.meet() or len(console.peers) == 3, what="three peers")
    kinds = {row["peer_id"]: row.get("robot_kind") for row in console.peers}
    assert kinds == {"base-1": "navigating_base", "arm-1": "robot", "head-1": "reachy_mini"}


class Cell:
    """A world of others', whose arms may be real."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def list_robots(self) -> list[str]:
        return ["left", "right"]

    def start_policy(self, robot_name: str, **policy: Any) -> dict[str, Any]:
        self.calls.append(f"start {robot_name}")
        return {"status": "success"}

    def stop_policy(self, robot_name: str) -> dict[str, Any]:
        self.calls.append(f"stop {robot_name}")
        return {"status": "success"}


@pytest.mark.parametrize(("peer_type", "started"), [("robot", []), ("sim", ["start left", "start left"])])
def test_world_of_others_moves_by_itself_only_as_a_simulation(
    peers: Fleet, console: Mesh, peer_type: str, started: list[str]
) -> None:
    cell = Cell()
    peers.join(cell, "cell", peer_type)
    assert eventually(lambda: "cell__left" in {row["peer_id"] for row in console.peers})
    task = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    for command, to in (({**task, "robot_name": "left"}, "cell"), (task, "cell__left")):
        reply = console.send(to, command, timeout=20)
        assert (reply["type"] == "error") is (peer_type == "robot"), reply
    assert cell.calls == started
    assert console.send("cell", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    assert cell.calls == [*started, "stop left", "stop right"]


@pytest.mark.parametrize("to", ["cell", "cell__left"])
def test_stop_of_one_robot_does_not_wait_for_the_list_of_a_world_of_others(
    peers: Fleet, console: Mesh, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    hangs, released = threading.Event(), threading.Event()

    class Stuck(Cell):
        def list_robots(self) -> list[str]:
            if hangs.is_set():
                released.wait(20)
            return super().list_robots()

    cell = Stuck()
    peers.join(cell, "cell", "sim")
    assert eventually(lambda: "cell__left" in {row["peer_id"] for row in console.peers})
    hangs.set()
    try:
        for times in (1, 2):
            body = {"sender_id": "other", "turn_id": f"t{times}", "timestamp": peers.clock()}
            stop = {**body, "command": {"action": "stop", "robot_name": "left"}}
            began = time.monotonic()
            peers.stranger().put(f"strands/{to}/cmd", stop)
            assert time.monotonic() - began < 5
            assert eventually(lambda least=times: cell.calls.count("stop left") >= least)
    finally:
        released.set()


@pytest.mark.parametrize(
    ("name", "listed", "stopped"),
    [
        ("left", ["left"], True),
        ("right", ["left"], False),
        ("other", ["left"], False),
        ("left", [{"name": "left"}], True),
        ("left", RuntimeError("torn down"), None),
    ],
)
def test_stop_of_one_robot_of_a_world_of_others_counts_where_it_is_there(
    name: str, listed: Any, stopped: bool | None
) -> None:
    class Told(Cell):
        def list_robots(self) -> Any:
            if isinstance(listed, Exception):
                raise listed
            return listed

        def stop_policy(self, robot_name: str) -> dict[str, Any]:
            super().stop_policy(robot_name)
            return {"status": "error" if robot_name == "right" else "success"}

    cell = Told()
    assert robot_stop(adapt_world(cell), name).halt().stopped is stopped
    assert cell.calls == [f"stop {name}"]
    gone = OneRobot(adapt_world(cell), name).halt()
    assert gone.stopped is (True if stopped is False else stopped)
