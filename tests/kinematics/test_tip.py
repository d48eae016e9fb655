"""The tip is found by rule, or is what the caller names."""

from __future__ import annotations

import mujoco
import pytest

from strands_robots.kinematics.model_file import mark_tip
from strands_robots.utils import ValidationError


def arm(hand: str = "", *, joints: int = 4, beside: str = "", actuated: bool = True) -> object:
    inner = hand
    for index in reversed(range(joints)):
        inner = f'<body name="link{index}"><joint name="j{index}"/><geom size=".1"/>{inner}</body>'
    driven = "".join(f'<position joint="j{index}"/>' for index in range(joints)) if actuated else ""
    return mujoco.MjSpec.from_string(
        f"<mujoco><worldbody>{inner}{beside}</worldbody><actuator>{driven}</actuator></mujoco>"
    )


FINGERS = "".join(f'<body name="f{side}"><joint type="slide"/><geom size=".1"/></body>' for side in "lr")


def body_of(spec: object, site: str) -> str:
    model = spec.compile()  # type: ignore[attr-defined]
    return str(model.body(int(model.site_bodyid[model.site(site).id])).name)


@pytest.mark.parametrize(
    ("hand", "wanted"),
    [
        ("<site name='camera_mount'/><site name='ee_site'/>", "ee_site"),
        ("<site name='attachment_site'/>", "attachment_site"),
        ("<site name='left/gripper'/>", "left/gripper"),
        ("<site name='tcp'/><site name='gripper_tip'/>", "gripper_tip"),
        ("<site name='imu'/><site name='fingertip_sensor'/>", "tip"),
    ],
)
def test_site_is_chosen_by_the_words_of_its_name(hand: str, wanted: str) -> None:
    assert mark_tip(arm(hand)) == wanted


def test_last_body_of_the_longest_actuated_chain_is_the_tip() -> None:
    spec = arm(beside="<body name='wheel'><joint name='w'/><geom size='.1'/></body>")
    assert body_of(spec, mark_tip(spec)) == "link3"


def test_body_from_which_fingers_branch_off_is_the_tip() -> None:
    spec = arm(FINGERS)
    assert body_of(spec, mark_tip(spec)) == "link3"
    bare = arm(FINGERS, actuated=False)
    assert body_of(bare, mark_tip(bare)) == "link3"


def test_site_before_the_arm_is_no_tip() -> None:
    spec = arm(beside="<site name='grip_goal'/>")
    assert body_of(spec, mark_tip(spec)) == "link3"


def test_named_tip_is_a_site_or_a_body() -> None:
    assert mark_tip(arm("<site name='imu'/>"), "imu") == "imu"
    spec = arm()
    assert body_of(spec, mark_tip(spec, "link1")) == "link1"
    with pytest.raises(ValidationError, match=r"tip must be a site or a body of the model \(link0, link1"):
        mark_tip(arm(), "claw")


def test_model_without_an_actuated_joint_has_no_tip() -> None:
    spec = mujoco.MjSpec.from_string("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
    assert mark_tip(spec) == ""
