from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.envelope import Envelope, success
from strands_robots.ros.link import graph_name
from strands_robots.ros_telemetry import RosTelemetryBase
from strands_robots.safety.gate import MotionGate
from strands_robots.utils import ValidationError

NAMES = st.lists(st.sampled_from(["a.pos", "b.pos", "c.pos"]), max_size=4)
NUMBERS = st.one_of(
    st.floats(-3, 3), st.sampled_from([math.nan, math.inf, True, None, "1", 10**400]), st.integers(-3, 3)
)


class Arm:
    """Keeps what it was sent."""

    tool_name_str = "arm"

    def __init__(self) -> None:
        self.gate = MotionGate()
        self.taken: list[dict[str, float]] = []
        self.state: dict[str, Any] = {"joints": {"a.pos": 0.5}}
        self.cameras: tuple[str, ...] | None = ("front",)

    def get_state(self) -> Envelope:
        return success("", **self.state)

    def camera_frames(self) -> dict[str, Any]:
        if self.cameras is None:
            raise OSError("no camera answers")
        return {name: np.zeros((2, 2, 3), np.uint8) for name in self.cameras}

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.taken.append(action)
        return success("taken")


class Bridge(RosTelemetryBase):
    """A bridge to a graph in memory."""

    def __init__(self, arm: Arm | None) -> None:
        super().__init__(
            arm,
            domain_id=0,
            enable_commands=False,
            command_robot_name=None,
            period=0.02,
            period_name="period",
        )
        self.link = MemoryLink()
        self._begin(self.link, "commands")

    def reported(self) -> list[str]:
        return [topic for topic, _ in self.link.sent]


def bridge(arm: Arm) -> RosTelemetryBase:
    return RosTelemetryBase(
        arm,
        domain_id=0,
        enable_commands=True,
        command_robot_name=None,
        period=0.02,
        period_name="period",
        joint_limits={"a.pos": (-1.0, 1.0), "b.pos": (0.0, 0.0)},
    )


@given(names=NAMES, positions=st.lists(NUMBERS, max_size=4))
def test_joint_command_is_applied_whole_or_not_at_all(names: list[str], positions: list[Any]) -> None:
    arm = Arm()
    usable = (
        bool(names)
        and len(names) == len(positions) == len(set(names))
        and all(type(p) in (int, float) and math.isfinite(p) for p in positions if p != 10**400)
        and 10**400 not in positions
        and all(n != "a.pos" or -1 <= p <= 1 for n, p in zip(names, positions, strict=True))
        and all(n != "b.pos" or p == 0 for n, p in zip(names, positions, strict=True))
    )
    assert bridge(arm).apply({"name": names, "position": positions}) is usable
    assert arm.taken == ([{n: float(p) for n, p in zip(names, positions, strict=True)}] if usable else [])


def test_names_of_robots_and_cameras_become_one_word_of_a_topic() -> None:
    assert RosTelemetryBase.joint_states_topic("my arm/2") == "/my_arm_2/joint_states"
    assert RosTelemetryBase.image_topic("arm", "front left") == "/arm/front_left/image_raw"
    assert RosTelemetryBase.joint_states_topic("---") == "/robot/joint_states"
    assert RosTelemetryBase.image_topic("arm", "é") == "/arm/camera/image_raw"
    assert bridge(Arm()).command_topic == "/arm/joint_command"


def test_name_that_begins_with_a_digit_has_its_kind_before_it() -> None:
    assert RosTelemetryBase.image_topic("1st", "0") == "/robot_1st/camera_0/image_raw"
    assert RosTelemetryBase.joint_states_topic("2") == "/robot_2/joint_states"


@given(robot=st.text(max_size=8), camera=st.text(max_size=8))
def test_every_name_gives_a_topic_that_ros_2_shows(robot: str, camera: str) -> None:
    topic = graph_name("topic", RosTelemetryBase.image_topic(robot, camera))
    assert not any(word.startswith("_") for word in topic.split("/"))


def test_second_of_two_cameras_of_one_topic_is_refused_by_name() -> None:
    arm = Arm()
    arm.cameras = ("a-b", "a_b")
    with pytest.raises(ValidationError, match=r"camera 'a_b' of 'arm' .* /arm/a_b/image_raw .* 'a-b' of 'arm'"):
        Bridge(arm)


def test_second_of_two_names_of_one_topic_is_refused_where_it_is_published() -> None:
    telling, picture = Bridge(None), np.zeros((2, 2, 3), np.uint8)
    telling.publish_image("arm", "0", picture)
    telling.publish_image("arm", "0", picture)
    with pytest.raises(ValidationError, match="camera 'camera_0' of 'arm'"):
        telling.publish_image("arm", "camera_0", picture)
    telling.publish_joint_states("a b", ["a.pos"], [0.5])
    with pytest.raises(ValidationError, match="robot 'a_b' must have a topic of its own"):
        telling.publish_joint_states("a_b", ["a.pos"], [0.5])
    assert telling.reported() == ["/arm/camera_0/image_raw"] * 2 + ["/a_b/joint_states"]
    telling.shutdown()


def test_camera_that_fails_at_construction_leaves_the_bridge_usable() -> None:
    arm = Arm()
    arm.cameras = None
    Bridge(arm).shutdown()


def test_joints_and_cameras_are_published_once_or_at_a_rate() -> None:
    telling = Bridge(Arm())
    telling.publish(["front"])
    assert telling.reported() == ["/arm/joint_states", "/arm/front/image_raw"]
    assert telling.link.sent[0][1]["position"] == [0.5]
    try:
        telling.start(100.0)
        eventually(lambda: len(telling.reported()) > 5)
        with pytest.raises(ValidationError, match="called before"):
            telling.start()
    finally:
        telling.shutdown()
    reported = len(telling.reported())
    telling.publish_joint_states("arm", ["a.pos"], [0.5])
    assert len(telling.reported()) == reported


def test_joints_that_could_not_be_read_are_not_published() -> None:
    arm = Arm()
    arm.state["joints_error"] = "the bus is silent"
    telling = Bridge(arm)
    telling.publish()
    assert telling.reported() == []
    telling.shutdown()


def test_invalid_publication_is_refused_before_a_thread_starts() -> None:
    for options, named in (({"rate_hz": 0}, "rate_hz"), ({"cameras": ["rear"]}, "cameras must be among front")):
        with pytest.raises(ValidationError, match=named):
            Bridge(Arm()).start(**options)
    with pytest.raises(ValidationError, match="robot must be given"):
        Bridge(None).start()


def streaming(arm: Arm, speed: float) -> RosTelemetryBase:
    return RosTelemetryBase(
        arm,
        domain_id=0,
        enable_commands=True,
        command_robot_name=None,
        period=0.02,
        period_name="period",
        max_joint_speed=speed,
    )


def test_far_command_is_cut_to_what_the_joint_may_go(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    arm = Arm()
    made = streaming(arm, 1.0)
    assert made.apply({"name": ["a.pos"], "position": [9.0]})
    now[0] += 0.05
    assert made.apply({"name": ["a.pos"], "position": [9.0]})
    now[0] += 0.05
    assert made.apply({"name": ["a.pos"], "position": [0.6]})
    # It starts where the arm is, 0.5; the first command has a tenth of a second.
    assert [each["a.pos"] for each in arm.taken] == pytest.approx([0.6, 0.65, 0.6])


def test_stream_that_paused_starts_where_the_arm_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    arm = Arm()
    made = streaming(arm, 1.0)
    made.apply({"name": ["a.pos"], "position": [0.6]})
    arm.state = {"joints": {"a.pos": -0.5}}
    now[0] += 60.0
    made.apply({"name": ["a.pos"], "position": [0.6]})
    assert arm.taken[-1]["a.pos"] == pytest.approx(-0.4)


@pytest.mark.parametrize("speed", [0, -1.0, math.nan, True, "fast"])
def test_unusable_joint_speed_is_refused_by_name(speed: Any) -> None:
    with pytest.raises(ValidationError, match="max_joint_speed"):
        streaming(Arm(), speed)


def test_command_that_comes_while_motions_hold_is_left_out() -> None:
    arm = Arm()
    bridge = Bridge(arm)
    arm.gate.hold(60.0)
    assert bridge.apply({"name": ["a.pos"], "position": [0.5]}) is False
    assert arm.taken == []
