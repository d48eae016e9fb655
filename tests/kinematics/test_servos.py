"""Position servos are told from other actuators by dynamics, gain and bias."""

from __future__ import annotations

import mujoco
import pytest

from strands_robots.kinematics.model_file import actuator_kind, drives, is_servo

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody><body><joint name="a"/><joint name="b" axis="0 1 0"/><geom size=".1"/></body></worldbody>
  <tendon><fixed name="one"><joint joint="a" coef="2"/></fixed>
    <fixed name="two"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
  <actuator>{0}</actuator>
</mujoco>
"""


def model_of(actuator: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL.format(actuator))


@pytest.mark.parametrize(
    ("actuator", "kind"),
    [
        ('<position joint="a"/>', "position servo"),
        ('<position joint="a" timeconst=".1"/>', "position servo"),
        ('<general joint="a" gainprm="9" biastype="affine" biasprm="1 -3 -1"/>', "position servo"),
        ('<motor joint="a"/>', "torque motor"),
        ('<general joint="a" gainprm="150"/>', "torque motor"),
        ('<velocity joint="a" kv="2"/>', "velocity servo"),
        ('<intvelocity joint="a" kp="2" actrange="-1 1"/>', "velocity servo"),
        ('<muscle joint="a" lengthrange="0 1"/>', "muscle"),
        ('<general joint="a" gaintype="affine" gainprm="1 1 1"/>', "general actuator"),
    ],
)
def test_actuator_is_what_its_parameters_make_of_it(actuator: str, kind: str) -> None:
    model = model_of(actuator)
    assert actuator_kind(model, 0) == kind
    assert is_servo(model, 0) is (kind == "position servo")


def test_command_of_a_servo_is_linear_in_its_joint() -> None:
    drive = drives(model_of('<general joint="a" gear="2" gainprm="4" biastype="affine" biasprm="1 -8 0"/>'))[0]
    # The force 4 u + 1 - 8 (2 q) is zero for u = 4 q - 0.25.
    assert (drive.factor, drive.offset) == pytest.approx((4.0, -0.25))


def test_tendon_of_one_joint_is_that_joints_drive_and_one_of_several_is_none() -> None:
    assert drives(model_of('<position tendon="one"/>'))[0].factor == pytest.approx(2.0)
    assert drives(model_of('<position tendon="two"/>')) == {}


def test_servo_of_a_joint_precedes_its_motor() -> None:
    assert drives(model_of('<motor joint="a"/><position joint="a"/>'))[0].actuator == 1


def test_joints_of_a_model_without_actuators_count_as_servos() -> None:
    assert [each.actuator for each in drives(model_of("")).values()] == [None, None]
