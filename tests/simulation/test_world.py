"""The world's verbs: building, stepping, reading, and refusals."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from strands_robots.contract import WorldRobot
from strands_robots.envelope import Envelope, error
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError, identifier

BAD_NUMBERS: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, True, False, None, "", "1", "nan", b"1", [], {}, 10**400]),
    st.text(max_size=5),
    st.lists(st.integers(), max_size=2),
)
RELAXED = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    simulation.add_robot("arm", "so100")
    yield simulation
    simulation.cleanup()


def state_of(world: Simulation) -> dict[str, Any]:
    state = world.get_state()
    return {key: state[key] for key in ("sim_time", "step_count", "robots")}


class Locked:
    def refusal(self, verb: str) -> Envelope | None:
        return error(f"{verb} is refused: locked.")


def test_simulation_is_a_world_robot(world: Simulation) -> None:
    assert isinstance(world, WorldRobot)


def test_importing_the_package_loads_neither_mujoco_nor_numpy() -> None:
    code = "import strands_robots.simulation, sys; print([m for m in ('mujoco', 'numpy', 'PIL') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_missing_mujoco_is_reported_with_the_extra() -> None:
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "try:\n    from strands_robots.simulation import Simulation\n"
        "except ImportError as e:\n    print(e)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output == "Simulation needs the [sim] extra: in the clone, .venv/bin/pip install -e '.[sim]'.\n"


def test_step_advances_exactly_that_many_steps(world: Simulation) -> None:
    answer = world.step(1234)
    assert answer["step_count"] == 1234
    assert answer["sim_time"] == pytest.approx(2.468)


def test_same_steps_give_same_numbers(world: Simulation) -> None:
    other = Simulation()
    other.add_robot("arm", "so100")
    other.step(1)
    world.step(1)
    for simulation in (world, other):
        simulation.send_action({"shoulder_pan": 0.4, "gripper": 1.0})
        simulation.step(500)
    assert state_of(world) == state_of(other)
    other.cleanup()


def test_action_beyond_the_range_is_clamped_and_returned_as_sent(world: Simulation) -> None:
    assert world.send_action({"shoulder_pan": 9.0, "gripper": -5.0})["sent"] == {"shoulder_pan": 2.2, "gripper": -0.2}


@pytest.mark.parametrize(
    ("action", "named"),
    [({"knee": 1.0}, "'knee'"), ({"gripper": math.nan}, "gripper"), ({"gripper": True}, "True"), ([1], "action")],
)
def test_bad_action_is_refused_by_name_and_nothing_moves(world: Simulation, action: Any, named: str) -> None:
    before = state_of(world)
    mixed = {"shoulder_pan": 1.0, **action} if isinstance(action, dict) else action
    answer = world.send_action(mixed)
    assert answer["status"] == "error"
    assert named in answer["reason"]
    world.step(200)
    assert world.get_observation() == pytest.approx(before["robots"]["arm"], abs=0.004)


@RELAXED
@given(value=BAD_NUMBERS)
def test_every_verb_refuses_an_unusable_number(world: Simulation, value: Any) -> None:
    before = state_of(world)
    answers = [
        world.step(value),
        world.send_action({"gripper": value}),
        world.add_robot("next", "so100", yaw=value),
        world.add_robot("next", "so100", position=(0, value, 0)),
        world.add_object("thing", mass=value),
        world.add_object("thing", position=[value] * 3),
        world.create_world(timestep=value),
        world.create_world(gravity=value),
    ]
    assert [a["status"] for a in answers] == ["error"] * len(answers)
    assert all(len(a["reason"]) < 500 for a in answers)
    assert state_of(world) == before


@RELAXED
@given(
    name=st.one_of(st.text(max_size=3).filter(lambda t: not t.isalnum()), st.integers(), st.none(), st.lists(st.text()))
)
def test_every_verb_refuses_an_unusable_name(world: Simulation, name: Any) -> None:
    if world.add_robot(name, "so100")["status"] == "success":
        # A dot may be in a name; such a one is usable.
        assert identifier("name", name) == name
        world.remove_robot(name)
        return
    assert world.remove_robot(name)["status"] == "error"
    assert world.send_action({}, name)["status"] == ("error" if name not in (None, "") else "success")
    if name not in (None, ""):
        with pytest.raises(ValidationError):
            world.get_observation(name)


@RELAXED
@given(timestep=st.floats(1e-4, 2e-2), gravity=st.floats(-20, 0), n=st.integers(1, 50))
def test_every_number_of_the_domain_is_accepted(timestep: float, gravity: float, n: int) -> None:
    simulation = Simulation(timestep=timestep, gravity=gravity)
    assert simulation.step(n)["sim_time"] == pytest.approx(n * timestep)
    simulation.cleanup()


@pytest.mark.parametrize(
    ("argument", "value"), [("timestep", 0.0), ("timestep", 1.0), ("realtime", 1), ("tool_name", "")]
)
def test_constructor_refuses_bad_arguments(argument: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=argument):
        Simulation(**{argument: value})


def test_adding_and_removing_robots_keeps_the_state_of_the_others(world: Simulation) -> None:
    world.send_action({"shoulder_pan": 0.8})
    world.step(300)
    before = world.get_observation("arm")
    world.add_robot("second", "so101")
    world.add_robot("car", "rover", position=(0.5, 0.5, 0))
    assert world.list_robots() == ["arm", "second", "car"]
    assert world.get_observation("arm") == before
    world.send_action({"shoulder_pan": -0.5}, "second")
    world.step(400)
    second = world.get_observation("second")
    world.remove_robot("arm")
    assert world.list_robots() == ["second", "car"]
    assert world.get_observation("second") == second
    world.step(100)
    assert world.get_observation("second")["shoulder_pan"] == pytest.approx(-0.5, abs=0.02)


def test_robots_of_one_model_have_separate_commands(world: Simulation) -> None:
    world.add_robot("twin", "so100")
    world.send_action({"shoulder_pan": 1.0}, "twin")
    world.step(500)
    assert world.get_observation("twin")["shoulder_pan"] == pytest.approx(1.0, abs=0.02)
    assert world.get_observation("arm")["shoulder_pan"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("name", ["arm", "cube", "floor", "world"])
def test_taken_name_is_refused(world: Simulation, name: str) -> None:
    world.add_object("cube")
    assert "taken" in world.add_robot(name, "so100")["reason"]
    assert "taken" in world.add_object(name)["reason"]


def test_object_falls_to_the_floor_and_can_be_removed(world: Simulation) -> None:
    world.add_object("ball", "sphere", 0.03, (0.3, 0.2, 0.5))
    world.step(1000)
    assert world.get_features()["objects"] == ["ball"]
    assert world.remove_object("ball")["status"] == "success"
    assert "must be one of" in world.remove_object("ball")["reason"]


@pytest.mark.parametrize(("shape", "size"), [("cone", 1), ("sphere", (1, 2)), ("box", (0.1, 0.1)), ("cylinder", 0.1)])
def test_wrong_number_of_sizes_is_refused(world: Simulation, shape: str, size: Any) -> None:
    assert world.add_object("thing", shape, size)["status"] == "error"


def test_reset_restores_the_initial_state(world: Simulation) -> None:
    start = world.get_observation()
    world.send_action({"shoulder_pan": 1.0})
    world.step(300)
    assert world.reset()["status"] == "success"
    assert world.get_observation() == start
    world.step(200)
    assert world.get_observation() == pytest.approx(start, abs=0.004)


def test_locked_world_refuses_motion_and_answers_reads(world: Simulation) -> None:
    world.gate.attach(Locked())
    assert world.send_action({"gripper": 1.0})["reason"] == "send_action is refused: locked."
    assert world.reset()["reason"] == "reset is refused: locked."
    assert world.get_state()["status"] == world.step(2)["status"] == "success"


def test_features_name_ranges_and_cameras(world: Simulation) -> None:
    features = world.get_features()["robots"]["arm"]
    assert features["actuators"]["gripper"] == [-0.2, 2.0]
    assert features["joints"]["elbow_flex"] == [0.0, 3.14158]
    assert features["cameras"] == ["arm/wrist"]


def test_cleaned_up_world_refuses_verbs_by_name(world: Simulation) -> None:
    assert world.cleanup()["status"] == world.cleanup()["status"] == "success"
    for answer in (world.step(1), world.send_action({}), world.reset(), world.add_robot("x", "so100")):
        assert "cleaned up" in answer["reason"]
