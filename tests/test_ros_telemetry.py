from __future__ import annotations

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from strands_robots.envelope import Envelope, success
from strands_robots.ros_telemetry import RosTelemetryBase

NAMES = st.lists(st.sampled_from(["a.pos", "b.pos", "c.pos"]), max_size=4)
NUMBERS = st.one_of(
    st.floats(-3, 3), st.sampled_from([math.nan, math.inf, True, None, "1", 10**400]), st.integers(-3, 3)
)


class Arm:
    """Keeps what it was sent."""

    tool_name_str = "arm"

    def __init__(self) -> None:
        self.taken: list[dict[str, float]] = []

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.taken.append(action)
        return success("taken")


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
def test_a_joint_command_is_taken_whole_or_not_at_all(names: list[str], positions: list[Any]) -> None:
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


def test_what_a_robot_or_a_camera_is_called_becomes_one_word_of_a_topic() -> None:
    assert RosTelemetryBase.joint_states_topic("my arm/2") == "/my_arm_2/joint_states"
    assert RosTelemetryBase.image_topic("1st", "front left") == "/_1st/front_left/image_raw"
    assert RosTelemetryBase.joint_states_topic("---") == "/robot/joint_states"
    assert bridge(Arm()).command_topic == "/arm/joint_command"
