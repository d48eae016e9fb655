"""Models of others in a shared world: no file changes the physics of its neighbours."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from strands_robots.simulation import Simulation


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    simulation.add_object("cube", size=0.02, position=(1, 0, 0.3))
    yield simulation
    simulation.cleanup()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.xml"


def mjcf(option: str = "", body: str = "", rest: str = "") -> str:
    hinge = '<joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/>'
    rod = f'<worldbody><body name="rod" pos="0 0 1">{body or hinge}</body></worldbody>'
    return f"<mujoco>{option}{rod}{rest}</mujoco>"


def height_of_the_cube(world: Simulation) -> float:
    return float(world.physics.snapshot.data().body("cube").xpos[2])


@pytest.mark.parametrize("flag", ["contact", "constraint", "limit", "gravity", "equality", "frictionloss", "sensor"])
def test_flag_of_a_model_does_not_reach_a_cube_beside_it(world: Simulation, file: Path, flag: str) -> None:
    file.write_text(mjcf(f'<option><flag {flag}="disable"/></option>'))
    assert world.add_robot("rod", file)["status"] == "success"
    world.step(1000)
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)


def test_model_without_contacts_still_has_none(world: Simulation, file: Path) -> None:
    ball = '<freejoint/><geom size=".05"/>'
    floor = '<flag contact="disable"/></option><worldbody><geom type="plane" size="1 1 1"/></worldbody>'
    file.write_text(mjcf(f"<option>{floor}", ball))
    world.add_robot("ball", file)
    world.step(1000)
    assert world.tip_position("ball")[2] < -1
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)


def test_model_without_gravity_still_has_none(world: Simulation, file: Path) -> None:
    file.write_text(mjcf('<option><flag gravity="disable"/></option>', '<freejoint/><geom size=".05"/>'))
    world.add_robot("ball", file)
    world.step(500)
    assert world.tip_position("ball")[2] == pytest.approx(1, abs=0.001)


@pytest.mark.parametrize("flag", ["spring", "damper", "clampctrl", "filterparent", "actuation", "refsafe"])
def test_flag_that_cannot_be_confined_is_refused_by_name(world: Simulation, file: Path, flag: str) -> None:
    file.write_text(mjcf(f'<option><flag {flag}="disable"/></option>'))
    assert f"its flag {flag} would" in world.add_robot("rod", file)["reason"]
    assert world.list_robots() == []


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ('density="1000"', "density=1000"),
        ('viscosity="0.1"', "viscosity=0.1"),
        ('wind="3 0 0"', "option wind"),
        ('actuatorgroupdisable="1"', "actuatorgroupdisable"),
    ],
)
def test_medium_of_a_model_is_refused_by_name(world: Simulation, file: Path, option: str, named: str) -> None:
    file.write_text(mjcf(f"<option {option}/>"))
    answer = world.add_robot("rod", file)
    assert named in answer["reason"]
    assert "'model' cannot share a world" in answer["reason"]
    assert world.list_robots() == []


def test_world_with_that_medium_takes_the_model(file: Path) -> None:
    file.write_text(mjcf('<option density="1000" viscosity="0.1"/>'))
    world = Simulation(realtime=False, density=1000, viscosity=0.1)
    assert world.add_robot("rod", file)["status"] == "success"
    world.cleanup()


def test_coarse_solver_of_a_model_is_not_the_worlds(world: Simulation, file: Path) -> None:
    file.write_text(mjcf('<option iterations="1" solver="PGS" tolerance="0.1"/>'))
    world.add_robot("rod", file)
    option = world.physics.compiled.model.opt
    assert (option.iterations, option.solver, option.tolerance) == (100, 2, 1e-8)


@pytest.mark.parametrize(
    "own", ['magnetic="0 0 9"', 'timestep="0.01"', 'integrator="RK4"', 'gravity="0 0 3"', 'o_margin="1"']
)
def test_option_of_a_model_is_not_the_worlds(world: Simulation, file: Path, own: str) -> None:
    def options() -> str:
        return str(world.physics.compiled.model.opt)

    before = options()
    file.write_text(mjcf(f"<option {own}/>"))
    assert world.add_robot("rod", file)["status"] == "success"
    assert options() == before


def test_buffers_of_a_model_do_not_limit_the_world(world: Simulation, file: Path) -> None:
    file.write_text(mjcf('<size memory="10K"/>'))
    world.add_robot("rod", file)
    world.step(1000)
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize(
    "own",
    [
        'priority="9" solref="-1 -1" margin="0.1"',
        'friction="1 9 9"',
        'friction="9 9 9" condim="6"',
        'pos="0 0 -1"',
        'pos="0 0 0.5"',
    ],
)
def test_floor_of_a_model_carries_a_cube_like_ours(world: Simulation, file: Path, own: str) -> None:
    file.write_text(mjcf(f'<worldbody><geom type="plane" size="1 1 1" {own}/></worldbody>'))
    world.add_robot("rod", file)
    world.step(1000)
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)
    model = world.physics.compiled.model
    (floor,) = (geom for geom in range(model.ngeom) if model.geom_type[geom] == 0 and model.geom_contype[geom])
    assert model.geom_friction[floor] == pytest.approx([1, 0.005, 0.0001])
    assert model.geom_condim[floor] == 3


def test_floor_of_a_model_that_is_placed_higher_lifts_nothing(world: Simulation, file: Path) -> None:
    file.write_text(mjcf('<worldbody><geom type="plane" size="1 1 1"/></worldbody>'))
    world.add_robot("rod", file, position=(0, 0, 0.2))
    world.step(1000)
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)


def test_wall_of_a_model_is_no_floor(world: Simulation, file: Path) -> None:
    file.write_text(mjcf('<worldbody><geom type="plane" size="1 1 1" pos="-2 0 0" zaxis="1 0 0"/></worldbody>'))
    world.add_robot("rod", file)
    world.step(1000)
    assert height_of_the_cube(world) == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_range_in_degrees_becomes_a_command_range_in_radians(world: Simulation, file: Path, angle: str) -> None:
    bound = 90 if angle == "degree" else math.pi / 2
    joints = (
        f'<joint name="hinge" axis="0 1 0" range="-{bound} {bound}"/>'
        '<joint name="slide" type="slide" range="-0.5 0.5"/><geom size=".05"/>'
    )
    file.write_text(mjcf(f'<compiler angle="{angle}"/>', joints))
    world.add_robot("rod", file)
    sent = world.send_action({"hinge": 5.0, "slide": 5.0})["sent"]
    assert sent == pytest.approx({"hinge": math.pi / 2, "slide": 0.5})


def test_unnamed_parts_are_named_by_joint_or_number(world: Simulation, file: Path) -> None:
    joints = '<joint name="lift" axis="0 1 0"/><joint axis="1 0 0"/><geom size=".05"/><site name="tip"/>'
    actuators = '<actuator><motor joint="lift"/><velocity joint="lift"/><motor site="tip"/></actuator>'
    file.write_text(mjcf(body=joints, rest=actuators))
    answer = world.add_robot("rod", file)
    assert answer["joints"] == ["lift", "joint_1"]
    assert answer["actuators"] == ["lift", "lift_2", "actuator_2"]
    world.send_action({"lift": 1.0})
    world.step(200)
    assert abs(world.get_observation()["lift"]) > 0.01


def test_unnamed_free_joint_is_a_base(world: Simulation, file: Path) -> None:
    file.write_text(mjcf(body='<freejoint/><geom size=".05"/>'))
    world.add_robot("ball", file)
    assert world.get_odom("ball")["status"] == "success"


def test_body_in_the_floor_is_reported(world: Simulation, file: Path, caplog: pytest.LogCaptureFixture) -> None:
    file.write_text(mjcf(body='<freejoint/><geom size=".05"/>'))
    answer = world.add_robot("ball", file, position=(0, 0, -1))
    assert answer["in_floor"] == {"rod": pytest.approx(0.05, abs=0.001)}
    assert "In the floor: rod by 0.05 m" in caplog.text
    assert world.add_object("brick", size=0.02, position=(2, 0, 0))["in_floor"] == {"brick": 0.02}


@pytest.mark.parametrize("model", ["so100", "so101", "rover"])
def test_built_in_model_stands_on_the_floor(world: Simulation, model: str) -> None:
    assert world.add_robot(model)["in_floor"] == {}
