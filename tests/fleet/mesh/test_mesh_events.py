"""Messages of the mesh's peers, read for the calling side."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, fleet

from strands_robots.fleet.adapter import EVERY, Detail, RobotEvent
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.mesh.peers import LOAD_MAX

Say = Callable[[str, dict[str, Any]], None]


class Followed:
    """A console that follows every robot of a mesh with one arm."""

    def __init__(self, peers: Fleet) -> None:
        self.peers = peers
        self.arm = Arm("arm-1")
        peers.join(self.arm, "arm-1")
        self.there = MeshNetwork.joined(peers.join(None, "console"))
        self.events: list[RobotEvent] = []
        self.end = self.there.subscribe(EVERY, self.events.append)
        self._stranger = peers.stranger()

    def say(self, topic: str, message: dict[str, Any]) -> None:
        """Publish as a peer without an identity."""
        self._stranger.put(f"strands/{topic}", json.dumps(message).encode())

    def arrived(self, name: str) -> RobotEvent:
        """Wait for an event of this name."""
        eventually(lambda: any(each.name == name for each in list(self.events)), what=name)
        return next(each for each in self.events if each.name == name)


@contextmanager
def _followed(folder: Path) -> Iterator[Followed]:
    with fleet(folder) as peers:
        yield Followed(peers)


@pytest.fixture
def followed(tmp_path: Path) -> Iterator[Followed]:
    with _followed(tmp_path) as one:
        yield one
        one.there.close()


def test_heartbeat_is_a_sign_of_life_with_the_task_of_the_registry(followed: Followed) -> None:
    heard = followed.arrived("presence")
    assert (heard.robot, heard.alive, heard.frequent) == ("arm-1", True, True)
    assert heard.task is not None
    assert heard.task["state"] == "idle"


def test_state_has_the_joints(followed: Followed) -> None:
    heard = followed.arrived("state")
    assert (heard.robot, heard.joints, heard.frequent) == ("arm-1", {"shoulder": 1.5}, True)


def test_state_and_steps_of_one_robot_come_with_joints_and_task(followed: Followed) -> None:
    seen: list[RobotEvent] = []
    end = followed.there.subscribe("arm-1", seen.append, Detail.STATES)
    eventually(lambda: [each for each in seen if each.name == "state"], what="a state")
    state = next(each for each in seen if each.name == "state")
    assert (state.robot, state.joints) == ("arm-1", {"shoulder": 1.5})
    assert state.task == {"state": "idle", "instruction": "", "step": 0}
    followed.say("arm-1/state", {"peer_id": "arm-9", "joints": {"forged": 1.0}})
    followed.say("arm-1/stream", {"step": 1})
    followed.say("arm-1/safety/event", {"event": "last"})
    eventually(lambda: {"stream", "safety_event"} <= {each.name for each in seen}, what="a step and an event")
    assert "forged" not in str(seen)
    end()


@pytest.mark.parametrize(
    ("message", "joints", "task"),
    [
        ({"joints": {"pan": {"position": 0.5, "velocity": None}}}, {"pan": 0.5}, {"state": "idle", "instruction": ""}),
        (
            {"task": {"status": "running", "instruction": "wave", "steps": 7}},
            None,
            {"state": "running", "instruction": "wave", "step": 7},
        ),
        ({"degraded": {"task": {"reason": "refused"}}}, None, None),
        ({"task": "nonsense", "joints": ["nonsense"]}, None, None),
        ({"degraded": "nonsense"}, None, {"state": "idle", "instruction": ""}),
    ],
)
def test_state_is_read_as_positions_and_task(
    followed: Followed, message: dict[str, Any], joints: object, task: object
) -> None:
    seen: list[RobotEvent] = []
    end = followed.there.subscribe("sim-1", seen.append, Detail.STATES)
    followed.say("sim-1/state", {"peer_id": "sim-1", **message})
    eventually(lambda: seen, what="the state")
    assert (seen[0].joints, seen[0].task) == (joints, task)
    end()


def test_recording_has_pictures_and_each_stop_of_the_fleet_once(followed: Followed) -> None:
    seen: list[RobotEvent] = []
    for robot in ("arm-1", "arm-2"):
        followed.there.subscribe(robot, seen.append, Detail.ALL)
    jpeg = b"\xff\xd8picture"
    followed.say("arm-1/camera/front", {"data": base64.b64encode(jpeg).decode()})
    followed.say("arm-1/camera/front", {"data": "no base64"})
    followed.say("arm-2/camera/front", {"data": 7})
    followed.say("arm-1/stream", {"step": 1})
    followed.say("arm-1/turn", {"state": "led", "leader": "hand"})
    followed.say("safety/resume", {"peer_id": "desk-1"})
    followed.say("safety/estop", {})
    followed.say("arm-2/safety/event", {"event": "last"})
    eventually(lambda: any(each.robot == "arm-2" and each.name == "safety_event" for each in seen), what="the last one")
    told = [(each.robot, each.name, each.part, each.picture) for each in seen if each.name != "state"]
    assert sorted(told, key=repr) == sorted(
        [
            ("arm-1", "camera_front", "front", jpeg),
            ("arm-1", "camera_front", "front", None),
            ("arm-2", "camera_front", "front", None),
            ("arm-1", "streamStep", "", None),
            ("arm-1", "turnChanged", "", None),
            ("desk-1", "resume", "", None),
            ("mesh", "emergencyStop", "", None),
            ("arm-2", "safety_event", "", None),
        ],
        key=repr,
    )
    eventually(lambda: ("arm-1", "state") in {(each.robot, each.name) for each in seen}, what="a state")


def test_recorded_step_of_a_robot_of_a_world_has_its_own_joints(followed: Followed) -> None:
    seen: list[RobotEvent] = []
    end = followed.there.subscribe("cell-1", seen.append, Detail.ALL)
    plain = {"step": 1, "observation": {"a/pan": 1.0}, "action": None}
    for message in ({**plain, "robot_name": "left", "observation": {"left/pan": 1.0}}, plain, {"robot_name": "left"}):
        followed.say("cell-1/stream", message)
    eventually(lambda: len(seen) == 3, what="the steps")
    assert [(each.payload.get("robot_name"), each.payload.get("observation")) for each in seen] == [
        ("left", {"pan": 1.0}),
        (None, {"a/pan": 1.0}),
        ("left", None),
    ]
    end()


def test_message_about_another_robot_than_its_topic_names_is_left_out(followed: Followed) -> None:
    followed.say("arm-1/state", {"peer_id": "arm-9", "joints": {"forged": 1.0}})
    followed.say("arm-1/presence", {"robot_id": "arm-9", "task_status": "forged"})
    followed.say("arm-9/presence", {"robot_id": "arm-9", "task_status": "forged"})
    followed.say("arm-1/safety/event", {"event": "last"})
    followed.arrived("last")
    assert all("forged" not in str((each.joints, each.task)) for each in followed.events)


def test_load_within_its_domain_is_read_and_proves_no_life(followed: Followed) -> None:
    for load in (-1.0, LOAD_MAX, "full", True, None):
        followed.say("arm-1/health", {"cpu_load": load})
    followed.say("arm-1/health", {"cpu_load": 0.5})
    heard = followed.arrived("health")
    assert (heard.robot, heard.load, heard.alive, heard.frequent) == ("arm-1", 0.5, False, True)


def test_safety_event_is_plain_and_for_the_timeline(followed: Followed) -> None:
    followed.say("arm-1/safety/event", {"event": "\x1b[2J" + "x" * 1000})
    followed.say("arm-1/safety/event", {"type": "locked"})
    followed.say("arm-1/safety/event", {"event": ["nonsense"]})
    followed.say("arm-1/turn", {"state": "led", "leader": "hand"})
    followed.arrived("safety event")
    followed.arrived("locked")
    followed.arrived("turnChanged")
    names = [each.name for each in followed.events if not each.frequent]
    assert max(map(len, names)) <= 100
    assert "\x1b" not in "".join(names)


def test_no_event_arrives_after_the_end(followed: Followed) -> None:
    followed.arrived("presence")
    followed.end()
    seen: list[RobotEvent] = []
    end = followed.there.subscribe("arm-1", seen.append)
    count = len(followed.events)
    followed.say("arm-1/safety/event", {"event": "later"})
    eventually(lambda: seen, what="the event at another subscription")
    assert len(followed.events) == count
    end()


def test_heartbeat_of_one_robot_is_told_when_its_task_is_another_one(followed: Followed) -> None:
    followed.arrived("presence")
    seen: list[RobotEvent] = []
    end = followed.there.subscribe("arm-1", seen.append)

    def heartbeats() -> int:
        return sum(each.name == "presence" for each in list(followed.events))

    def told(state: str) -> bool:
        return bool(seen) and seen[-1].task is not None and seen[-1].task["state"] == state

    followed.arm.moving = True
    eventually(lambda: told("running"), what="the task")
    before = heartbeats()
    eventually(lambda: heartbeats() >= before + 3, what="further heartbeats")
    followed.arm.moving = False
    eventually(lambda: told("idle"), what="its end")
    assert [each.name for each in seen] == ["presence", "presence"]
    end()


def test_robots_of_a_world_are_found_as_its_parts(followed: Followed) -> None:
    followed.peers.join(World("left"), "cell", "sim")
    followed.peers.join(Arm("left"), "cell__left")
    followed.peers.meet()
    eventually(lambda: {"arm-1", "cell", "cell__left"} <= {*followed.there.announced()}, what="all are in reach")
    found = {each.id: (each.world, each.must_answer) for each in followed.there.find(0.0)}
    assert found == {"arm-1": ("", True), "cell": ("", True), "cell__left": ("cell", False)}
