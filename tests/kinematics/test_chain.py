"""The arm that is found in a model, and forward kinematics against MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from strands_robots.kinematics.chain import MODELS, Chain, built_in
from strands_robots.utils import ValidationError

ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")

SLIDING_JAWS = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="a"><joint name="turn" axis="0 0 1" range="-2 2"/><geom size=".02"/>
      <body name="b" pos=".2 0 .1"><joint name="lift" axis="0 1 0" range="-1 1"/><geom size=".02"/>
        <body name="c" pos=".2 0 0"><joint name="roll" axis="1 0 0" range="-3 3"/><geom size=".02"/>
          <site name="tip" pos=".1 0 0"/>
          <body name="left" pos=".1 .05 0"><joint name="left" type="slide" axis="0 1 0" range="0 .04"/>
            <geom size=".01"/></body>
          <body name="right" pos=".1 -.05 0"><joint name="right" type="slide" axis="0 -1 0" range="0 .04"/>
            <geom size=".01"/></body>
        </body></body></body>
  </worldbody>
  <actuator>
    <position name="m1" joint="turn" ctrlrange="-1.5 1.5"/><position name="m2" joint="lift"/>
    <position name="m3" joint="roll"/><position name="jaws" joint="left" ctrlrange="0 255"/>
  </actuator>
</mujoco>
"""


def chain_of(xml: str) -> Chain:
    return Chain(mujoco.MjSpec.from_string(xml), "the model")


@pytest.mark.parametrize("arm", ["so100", "so101"])
def test_built_in_arms_have_five_joints_a_roll_and_a_gripper(arm: str) -> None:
    chain = built_in(arm)
    assert tuple(joint.name for joint in chain.joints) == ARM
    assert chain.roll == 4
    assert chain.gripper is not None
    assert chain.gripper.joint.name == "gripper"
    assert chain.gripper.pad_m == pytest.approx(0.0079)
    assert chain.gripper.closed < chain.gripper.opened


@pytest.mark.parametrize("arm", ["so100", "so101"])
def test_stretched_home_points_forward_and_down(arm: str) -> None:
    pose = built_in(arm).forward(built_in(arm).rest)
    assert pose.position == pytest.approx([0.299, 0.0, 0.116], abs=1e-3)
    assert pose.approach_deg == pytest.approx(51.6, abs=0.1)


def test_tip_is_where_mujoco_puts_its_site() -> None:
    chain, model = built_in("so100"), mujoco.MjModel.from_xml_path(str(MODELS / "so100.xml"))
    data = mujoco.MjData(model)
    joints = np.array([0.4, -1.2, 1.1, 0.6, -0.8])
    data.qpos[:5] = joints
    mujoco.mj_forward(model, data)
    assert chain.forward(joints).position == pytest.approx(data.site("gripper_tip").xpos)


def test_actions_are_named_by_actuators_and_bounded_by_their_ranges() -> None:
    chain = chain_of(SLIDING_JAWS)
    assert [joint.key for joint in chain.joints] == ["m1", "m2", "m3"]
    assert (chain.joints[0].low, chain.joints[0].high) == (-1.5, 1.5)
    assert chain.gripper is not None
    assert (chain.gripper.joint.key, chain.gripper.closed, chain.gripper.opened) == ("jaws", 0.0, 255.0)
    assert chain.gripper.pad_m == 0.0


def test_narrower_ranges_bound_the_joints() -> None:
    chain = chain_of(SLIDING_JAWS).limited({"lift": (-0.5, 4.0)})
    assert (chain.joints[1].low, chain.joints[1].high) == (-0.5, 1.0)


def test_model_whose_inertia_is_inferred_from_geoms_that_are_only_seen_is_planned_with() -> None:
    seen = '<geom size=".02" contype="0" conaffinity="0"/>'
    inferred = SLIDING_JAWS.replace('autolimits="true"', 'autolimits="true" inertiafromgeom="true"')
    chain = chain_of(inferred.replace('<geom size=".02"/>', '<geom size=".02"/>' + seen))
    assert chain.spares.model(1).nbody > chain.model.nbody


def test_model_without_a_joint_is_refused_and_one_with_few_has_no_arm() -> None:
    with pytest.raises(ValidationError, match="no joint that could be moved to a position, and no actuator"):
        chain_of("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(ValidationError, match="no joint that could be moved to a position"):
        chain_of("<mujoco><worldbody><body><joint type='ball'/><geom size='.1'/></body></worldbody></mujoco>")
    one = chain_of("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(ValidationError, match="no arm: 1 joints lead to its tip"):
        one.require_arm()
