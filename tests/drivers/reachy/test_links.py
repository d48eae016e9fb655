"""Choice of the link and its prefix, and the messages of both links."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.reachy_daemon.body import recorded

from strands_robots.drivers.reachy import connection
from strands_robots.drivers.reachy.connection import Feed
from strands_robots.drivers.reachy.links import DaemonInfo, WebSocketLink, ZenohLink, key_prefix, make_link
from strands_robots.drivers.reachy.rest import DaemonFaultError, DaemonUnreachableError, warn_once
from strands_robots.drivers.reachy.target import HeadPose, Target
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
def test_version_decides_the_link_and_the_badge_only_without_a_version(status: dict[str, Any], link: str) -> None:
    assert DaemonInfo.of(status).link == link


def test_transport_option_overrides_the_choice() -> None:
    info = DaemonInfo.of(LITE["status_running"])
    assert make_link(info, "localhost", 8000, prefix="reachy_mini").kind == "websocket"
    assert make_link(info, "localhost", 8000, prefix="reachy_mini", transport="zenoh").kind == "zenoh"


@pytest.mark.parametrize(
    ("version", "name", "requested", "prefix"),
    [
        ("1.4.1", "lab_head", "reachy_mini", "lab_head"),
        ("1.4.1", "lab_head", "mine/head", "mine/head"),
        ("1.1.9", "lab_head", "reachy_mini", "reachy_mini"),
        ("1.4.1", None, "reachy_mini", "reachy_mini"),
    ],
)
def test_robot_name_is_the_prefix_unless_the_caller_gave_one(
    version: str, name: str | None, requested: str, prefix: str
) -> None:
    assert DaemonInfo.of({"version": version, "robot_name": name}).prefix(requested) == prefix


def test_wildcard_as_robot_name_is_refused() -> None:
    with pytest.raises(DaemonFaultError, match="robot_name cannot be a key prefix"):
        DaemonInfo.of({"version": "1.4.1", "robot_name": "lab/**"}).prefix("reachy_mini")


@pytest.mark.parametrize("prefix", ["", "a//b", "reachy_mini/*", "**", "a$b", "a?b", "a#b", "/a", None, 3])
def test_prefix_for_more_than_one_robot_is_refused(prefix: Any) -> None:
    with pytest.raises(ValidationError, match="prefix"):
        key_prefix(prefix)


def test_status_that_is_no_object_is_refused() -> None:
    with pytest.raises(DaemonFaultError, match="no object"):
        DaemonInfo.of(["running"])


class RecordingLink(WebSocketLink):
    """A link that records its frames instead of sending them."""

    def __init__(self, **options: Any) -> None:
        super().__init__("localhost", **options)
        self.sent: list[dict[str, Any]] = []

    def send(self, message: dict[str, Any]) -> None:
        self.sent.append(message)


WHOLE = Target(HeadPose(), 0.1, (0.2, -0.2))


def test_whole_target_is_one_frame_since_1_6_and_three_before() -> None:
    link = RecordingLink()
    link.send_target(WHOLE)
    assert [frame["type"] for frame in link.sent] == ["set_full_target"]
    assert len(link.sent[0]["head"]) == 16
    assert link.sent[0]["antennas"] == [0.2, -0.2]
    old = RecordingLink(full_target=False)
    old.send_target(WHOLE)
    assert [frame["type"] for frame in old.sent] == ["set_target", "set_antennas", "set_body_yaw"]


def test_single_part_is_sent_in_its_own_frame() -> None:
    link = RecordingLink()
    link.send_target(Target(body_yaw=0.1))
    link.send_target(Target(antennas=(0.0, 0.0)))
    assert link.sent == [{"type": "set_body_yaw", "body_yaw": 0.1}, {"type": "set_antennas", "antennas": [0.0, 0.0]}]


def test_stop_move_is_sent_only_since_1_10() -> None:
    link, old = RecordingLink(), RecordingLink(can_stop=False)
    assert link.stop_move()
    assert not old.stop_move()
    assert (link.sent, old.sent) == ([{"type": "stop_move"}], [])


class Session:
    """A pub/sub object in memory."""

    def __init__(self) -> None:
        self.puts: list[tuple[str, dict[str, Any]]] = []
        self.subscribers: dict[str, Callable[[bytes], None]] = {}
        self.closed = False

    def subscribe(self, key: str, on_payload: Callable[[bytes], None]) -> Callable[[], None]:
        self.subscribers[key] = on_payload
        return lambda: self.subscribers.pop(key, None) and None

    def publish(self, key: str, payload: bytes) -> None:
        self.puts.append((key, json.loads(payload)))

    def close(self) -> None:
        self.closed = True


def test_zenoh_link_uses_a_given_session_and_leaves_it_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "FRESH_S", 60.0)
    session, feed = Session(), Feed()
    link = ZenohLink("robot", "lab/head", session=session)
    link.open(feed.take)
    session.subscribers["lab/head/joint_positions"](json.dumps(ZENOH["reachy_mini/joint_positions"]).encode())
    session.subscribers["lab/head/head_pose"](json.dumps(ZENOH["reachy_mini/head_pose"]).encode())
    session.subscribers["lab/head/imu_data"](json.dumps(ZENOH["reachy_mini/imu_data"]).encode())
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
    assert (session.subscribers, session.closed) == ({}, False)
    with pytest.raises(DaemonUnreachableError, match="closed"):
        link.send_cmd({})


def test_zenoh_link_says_that_no_setting_encrypts_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    warn_once.cache_clear()
    older = DaemonInfo.of({"version": "1.4.1"})
    make_link(older, "127.0.0.1", 8000, prefix="reachy_mini")
    assert not caplog.records
    monkeypatch.setenv("REACHY_DAEMON_TLS", "1")
    for _ in range(2):
        make_link(older, "127.0.0.1", 8000, prefix="reachy_mini")
    assert [each.getMessage() for each in caplog.records] == [
        "The daemon at 127.0.0.1 speaks Zenoh, which no REACHY_DAEMON_ setting encrypts or authenticates."
    ]
