"""Which link, which prefix, which frame."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.reachy_daemon.body import recorded

from strands_robots.drivers.reachy import feed as feed_module
from strands_robots.drivers.reachy.envelope import Target
from strands_robots.drivers.reachy.feed import Feed
from strands_robots.drivers.reachy.links import WebSocketLink, ZenohLink, key_prefix
from strands_robots.drivers.reachy.motors import selected
from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.drivers.reachy.rest import DaemonFault, DaemonUnreachable
from strands_robots.drivers.reachy.transport import DaemonInfo, make_link
from strands_robots.utils import ValidationError

LITE = recorded("daemon_1.13.0_lite.json")
WIRELESS = recorded("daemon_1.13.0_wireless.json")
ZENOH = recorded("daemon_1.4.1_zenoh.json")["samples"]


@pytest.mark.parametrize(
    ("status", "link"),
    [
        (LITE["status_running"], "websocket"),
        (WIRELESS["status_running"], "websocket"),
        (ZENOH["reachy_mini/daemon_status"], "zenoh"),
        ({"version": "1.5.0", "wireless_version": True}, "websocket"),
        ({"version": "1.4.9", "wireless_version": False}, "zenoh"),
        ({"version": "2.0.0"}, "websocket"),
        ({"type": "daemon_status", "version": None}, "websocket"),
        ({"wireless_version": True}, "zenoh"),
        ({"wireless_version": False}, "websocket"),
        ({"version": "unknown", "wireless_version": "yes"}, "websocket"),
        ({}, "websocket"),
    ],
)
def test_the_version_decides_the_link_and_the_badge_only_without_one(status: dict[str, Any], link: str) -> None:
    assert DaemonInfo.of(status).link == link


def test_the_caller_may_insist_on_a_link() -> None:
    info = DaemonInfo.of(LITE["status_running"])
    assert make_link(info, "localhost", 8000, prefix="reachy_mini").kind == "websocket"
    assert make_link(info, "localhost", 8000, prefix="reachy_mini", transport="zenoh").kind == "zenoh"


@pytest.mark.parametrize(
    ("version", "name", "asked", "prefix"),
    [
        ("1.4.1", "lab_head", "reachy_mini", "lab_head"),
        ("1.4.1", "lab_head", "mine/head", "mine/head"),
        ("1.1.9", "lab_head", "reachy_mini", "reachy_mini"),
        ("1.4.1", None, "reachy_mini", "reachy_mini"),
    ],
)
def test_the_robots_name_is_the_prefix_unless_the_caller_gave_one(
    version: str, name: str | None, asked: str, prefix: str
) -> None:
    assert DaemonInfo.of({"version": version, "robot_name": name}).prefix(asked) == prefix


def test_a_robot_whose_name_is_a_wildcard_is_not_spoken_to() -> None:
    with pytest.raises(DaemonFault, match="robot_name cannot be a key prefix"):
        DaemonInfo.of({"version": "1.4.1", "robot_name": "lab/**"}).prefix("reachy_mini")


@pytest.mark.parametrize("prefix", ["", "a//b", "reachy_mini/*", "**", "a$b", "a?b", "a#b", "/a", None, 3])
def test_a_prefix_that_reaches_more_than_one_robot_is_refused(prefix: Any) -> None:
    with pytest.raises(ValidationError, match="prefix"):
        key_prefix(prefix)


def test_what_is_no_status_is_said_to_be_none() -> None:
    with pytest.raises(DaemonFault, match="no object"):
        DaemonInfo.of(["running"])


class Recorder(WebSocketLink):
    """A link whose frames are kept instead of sent."""

    def __init__(self, **options: Any) -> None:
        super().__init__("localhost", **options)
        self.sent: list[dict[str, Any]] = []

    def send(self, message: dict[str, Any]) -> None:
        self.sent.append(message)


WHOLE = Target(HeadPose(), 0.1, (0.2, -0.2))


def test_one_frame_carries_a_whole_target_since_1_6_and_three_before() -> None:
    link = Recorder()
    link.send_target(WHOLE)
    assert [frame["type"] for frame in link.sent] == ["set_full_target"]
    assert len(link.sent[0]["head"]) == 16
    assert link.sent[0]["antennas"] == [0.2, -0.2]
    old = Recorder(full_target=False)
    old.send_target(WHOLE)
    assert [frame["type"] for frame in old.sent] == ["set_target", "set_antennas", "set_body_yaw"]


def test_a_single_part_has_a_frame_of_its_own() -> None:
    link = Recorder()
    link.send_target(Target(body_yaw=0.1))
    link.send_target(Target(antennas=(0.0, 0.0)))
    assert link.sent == [{"type": "set_body_yaw", "body_yaw": 0.1}, {"type": "set_antennas", "antennas": [0.0, 0.0]}]


def test_stop_move_is_sent_only_to_daemons_that_know_it() -> None:
    link, old = Recorder(), Recorder(can_stop=False)
    assert link.stop_move()
    assert not old.stop_move()
    assert (link.sent, old.sent) == ([{"type": "stop_move"}], [])


class Session:
    """A pub/sub object in memory."""

    def __init__(self) -> None:
        self.puts: list[tuple[str, dict[str, Any]]] = []
        self.heard: dict[str, Callable[[bytes], None]] = {}
        self.closed = False

    def subscribe(self, key: str, heard: Callable[[bytes], None]) -> Callable[[], None]:
        self.heard[key] = heard
        return lambda: self.heard.pop(key, None) and None

    def publish(self, key: str, payload: bytes) -> None:
        self.puts.append((key, json.loads(payload)))

    def close(self) -> None:
        self.closed = True


def test_a_zenoh_link_stands_on_the_session_that_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "FRESH_S", 60.0)
    session, feed = Session(), Feed()
    link = ZenohLink("robot", "lab/head", session=session)
    link.open(feed.take)
    session.heard["lab/head/joint_positions"](json.dumps(ZENOH["reachy_mini/joint_positions"]).encode())
    session.heard["lab/head/head_pose"](json.dumps(ZENOH["reachy_mini/head_pose"]).encode())
    session.heard["lab/head/imu_data"](json.dumps(ZENOH["reachy_mini/imu_data"]).encode())
    assert feed.alive
    joints, pose, imu = feed.joints, feed.pose(), feed.imu()
    assert joints is not None and joints.antennas == (-3.05, 3.05)
    assert pose is not None and pose.pitch == pytest.approx(0.538, abs=0.001)
    assert imu is not None and imu.temperature == 31.5
    link.send_target(WHOLE)
    link.send_torque(False, None)
    link.send_automatic_body_yaw(True)
    link.close()
    assert [key for key, _ in session.puts] == ["lab/head/command"] * 3
    assert set(session.puts[0][1]) == {"head_pose", "antennas_joint_positions", "body_yaw"}
    assert session.puts[1][1] == {"torque": False, "ids": None}
    assert (session.heard, session.closed) == ({}, False)
    with pytest.raises(DaemonUnreachable, match="closed"):
        link.send_cmd({})


@pytest.mark.parametrize(
    "frame",
    [
        "{bad",
        "[]",
        '{"head_joint_positions":[0,0,0,0,0,0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0],"antennas_joint_positions":[0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,null],"antennas_joint_positions":[0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,0],"antennas_joint_positions":[NaN,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,true],"antennas_joint_positions":[0,0]}',
    ],
)
def test_a_joint_frame_without_nine_numbers_is_dropped_and_counted_and_the_link_lives(
    frame: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "FRESH_S", 60.0)
    feed = Feed()
    feed.take("joint_positions", frame)
    assert (feed.joints, feed.unusable_frames, feed.alive) == (None, 1, True)


def test_before_the_first_frame_the_link_is_not_alive() -> None:
    assert Feed().silent_s == math.inf
    assert not Feed().alive


@pytest.mark.parametrize(
    ("asked", "names"),
    [("", ()), ("17", ("right_antenna",)), ("stewart_1, 11 ,10", ("stewart_1", "body_rotation"))],
)
def test_motors_are_named_by_name_or_bus_id(asked: str, names: tuple[str, ...]) -> None:
    assert selected(asked) == names


@pytest.mark.parametrize("asked", [",", " ", "19", "head", 17, None, "17;18"])
def test_a_list_that_names_no_motor_is_refused(asked: Any) -> None:
    with pytest.raises(ValidationError, match="motor_ids"):
        selected(asked)


def test_the_doors_are_one_thing_and_load_with_the_standard_library_alone() -> None:
    code = (
        "import sys; before = set(sys.modules)\n"
        "from strands_robots.drivers import reachy_transport as one\n"
        "from strands_robots.device_connect import reachy_transport as two\n"
        "from strands_robots.drivers.reachy import ReachyDriver\n"
        "assert one.api is two.api and one.WebSocketLink is two.WebSocketLink and one.ZenohLink is two.ZenohLink\n"
        "ReachyDriver('localhost')\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "foreign = sorted(new - set(sys.stdlib_module_names) - {'strands_robots'})\n"
        "assert not foreign, foreign\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)
