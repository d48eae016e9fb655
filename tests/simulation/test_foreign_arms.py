"""Models that are not ours: their joints move by position, or the refusal names actuator and kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from strands_robots.simulation import Simulation

ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom name="table" type="box" size=".05 .05 .01" pos="-.6 0 .01"/>
    <body name="base" pos="0 0 .1"><geom size=".03"/>
      <body name="a"><joint name="pan" axis="0 0 1" range="-2 2" damping="2"/><geom size=".03"/>
        <body name="b" pos="0 0 .1"><joint name="lift" axis="0 1 0" range="-1.5 1.5" damping="2"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".1"/>
          <body name="c" pos=".25 0 0"><joint name="bend" axis="0 1 0" range="-2 2" damping="2"/>
            <geom type="capsule" fromto=".05 0 0 .2 0 0" size=".02" mass=".1"/>
            <body name="d" pos=".25 0 0"><joint name="roll" axis="1 0 0" range="-3 3" damping="2"/>
              <geom pos=".05 0 0" size=".02" mass=".05"/><site name="imu" pos="0 0 .02"/></body>
          </body></body></body></body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""

POSITIONS = "".join(f'<position name="m_{each}" joint="{each}" kp="80"/>' for each in ("pan", "lift", "bend", "roll"))
# Commands in degrees, and one with an offset: position servos by their gain and bias alone.
GENERAL = "".join(
    f'<general name="m_{each}" joint="{each}" gainprm="1.3962634" biastype="affine" biasprm="{bias} -80 0"'
    ' ctrlrange="-170 170"/>'
    for each, bias in (("pan", 0), ("lift", 0), ("bend", -13.962634), ("roll", 0))
)
TORQUES = "".join(f'<motor name="t_{each}" joint="{each}"/>' for each in ("pan", "lift", "bend", "roll"))
MIXED = POSITIONS.replace('<position name="m_bend" joint="bend" kp="80"/>', '<velocity name="v" joint="bend" kv="9"/>')

WALKER = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="trunk" pos="0 0 .3"><freejoint/><geom type="box" size=".15 .1 .03"/>
      <body name="left" pos="0 .12 0"><joint name="left_hip" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body>
      <body name="right" pos="0 -.12 0"><joint name="right_hip" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body>
    </body>
  </worldbody>
  <actuator>
    <position name="l" joint="left_hip" kp="300" dampratio="1"/>
    <position name="r" joint="right_hip" kp="300" dampratio="1"/>
  </actuator>
</mujoco>
"""

Make = Callable[..., Simulation]


@pytest.fixture
def world_of(tmp_path: Path) -> Iterator[Make]:
    worlds: list[Simulation] = []

    def make(xml: str, **options: Any) -> Simulation:
        path = tmp_path / "robot.xml"
        path.write_text(xml)
        world = Simulation()
        worlds.append(world)
        answer = world.add_robot("robot", path, **options)
        assert answer["status"] == "success", answer
        return world

    yield make
    for world in worlds:
        world.cleanup()


@pytest.mark.parametrize("actuators", [POSITIONS, GENERAL], ids=["position", "general"])
def test_joints_of_a_model_without_a_tip_site_move_by_position(world_of: Make, actuators: str) -> None:
    world = world_of(ARM.format(actuators=actuators))
    answer = world.move_joints({"pan": 30.0, "bend": -40.0}, speed=1.0)
    assert (answer["status"], answer["why"]) == ("success", "it is done")
    joints = world.arm_pose()["joints"]
    assert joints["pan"] == pytest.approx(30.0, abs=2.0)
    assert joints["bend"] == pytest.approx(-40.0, abs=4.0)


def test_tip_is_the_last_body_of_the_longest_actuated_chain(world_of: Make) -> None:
    world = world_of(ARM.format(actuators=POSITIONS))
    pose = world.arm_pose()
    assert [pose[axis] for axis in "xyz"] == pytest.approx([0.5, 0.0, 0.2], abs=0.02)
    assert world.tip_position() == pytest.approx([pose[axis] for axis in "xyz"], abs=0.005)
    answer = world.move_to(0.3, 0.1, 0.3, speed=1.0)
    assert answer["status"] == "success", answer
    assert world.tip_position() == pytest.approx((0.3, 0.1, 0.3), abs=0.012)


def test_tip_is_a_site_or_a_body_that_the_caller_names(world_of: Make) -> None:
    assert world_of(ARM.format(actuators=POSITIONS), tip="imu").arm_pose()["z"] == pytest.approx(0.22, abs=0.01)
    assert world_of(ARM.format(actuators=POSITIONS), tip="c").arm_pose()["x"] == pytest.approx(0.25, abs=0.01)


def test_unknown_tip_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(ARM.format(actuators=POSITIONS))
    world = Simulation()
    refused = world.add_robot("robot", tmp_path / "robot.xml", tip="claw")
    assert "tip must be a site or a body of the model (imu, base, a, b, c, d), not 'claw'" in refused["reason"]
    world.cleanup()


def test_torque_motors_get_no_radians(world_of: Make) -> None:
    world = world_of(ARM.format(actuators=TORQUES))
    refused = world.move_joints({"pan": 30.0})
    assert "the actuator t_pan of pan is a torque motor, whose command is no position" in refused["reason"]
    assert (
        "cannot be moved to a point: the actuator t_pan of pan is a torque motor"
        in world.move_to(0.3, 0, 0.3)["reason"]
    )
    assert set(world.body().targets.values()) == {0.0}
    assert set(world.arm_pose()["joints"]) == {"pan", "lift", "bend", "roll"}


def test_joint_with_a_motor_is_refused_by_itself_and_the_others_move(world_of: Make) -> None:
    world = world_of(ARM.format(actuators=MIXED))
    assert "the actuator v of bend is a velocity servo" in world.move_joints({"bend": 10.0})["reason"]
    world.move_joints({"pan": 20.0}, speed=1.0)
    assert world.arm_pose()["joints"]["pan"] == pytest.approx(20.0, abs=3.0)
    assert world.body().targets["v"] == 0.0


def test_every_leg_of_a_walking_robot_moves(world_of: Make) -> None:
    world = world_of(WALKER)
    world.move_joints({"left_hip": 20.0, "right_hip": 15.0}, speed=1.0)
    joints = world.arm_pose()["joints"]
    assert (joints["left_hip"], joints["right_hip"]) == pytest.approx((20.0, 15.0), abs=4.0)
    assert "has no arm: 1 joints lead to its tip" in world.move_to(0.1, 0.0, 0.1)["reason"]


def test_joint_that_stops_short_is_an_error_by_its_name(world_of: Make) -> None:
    weak = POSITIONS.replace('joint="roll" kp="80"', 'joint="roll" kp="80" forcerange="-.001 .001"')
    answer = world_of(ARM.format(actuators=weak)).move_joints({"roll": 60.0}, speed=1.0)
    assert answer["status"] == "error"
    assert answer["why"].startswith("roll was blocked at ")
