"""Contact with a fixed thing ends a planned motion by the joint's name; grasps and payloads do not."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from strands_robots.kinematics.moves import Start, move_joints
from strands_robots.policies.base import PolicyError
from strands_robots.simulation import Simulation

HZ = 50


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    assert simulation.add_robot("arm", "so101")["status"] == "success"
    yield simulation
    simulation.cleanup()


def wall(world: Simulation) -> None:
    world.add_object("wall", "box", (0.3, 0.01, 0.3), (0.3, 0.13, 0.3), fixed=True)


@pytest.mark.parametrize("speed", [0.05, 0.25, 1.0])
def test_motion_into_a_wall_ends_within_300_ms_of_the_contact(world: Simulation, speed: float) -> None:
    wall(world)
    body = world.body("arm")
    motion = move_joints(Start(body.arm, body.arm.state(body.get_joints()), HZ, speed), {"shoulder_pan": -60.0})
    motion.clock = body.clock
    motion.reset("", {})
    met = None
    with pytest.raises(PolicyError, match=r"shoulder_pan was blocked at -[0-9]+ degrees: it met something"):
        for _ in range(2000):
            actions = motion.act(body.get_joints())
            assert actions is not None, "the motion went on to its end"
            if actions:
                body.send_action(actions)  # type: ignore[arg-type]
            before = body.get_joints()["shoulder_pan"]
            world.step(10)
            lag = abs(body.targets["shoulder_pan"] - body.get_joints()["shoulder_pan"])
            if met is None and lag > 0.01 and abs(body.get_joints()["shoulder_pan"] - before) < 2e-4:
                met = body.clock()
    assert met is not None
    assert body.clock() - met <= 0.3


def test_answer_names_the_joint_and_the_arm_presses_no_further(world: Simulation) -> None:
    wall(world)
    answer = world.move_joints({"shoulder_pan": -60.0}, around=False)
    assert (answer["status"], answer["task_status"]) == ("error", "error")
    assert answer["why"].startswith("shoulder_pan was blocked at -")
    joints, targets = world.body("arm").get_joints(), world.body("arm").targets
    assert targets["shoulder_pan"] == pytest.approx(joints["shoulder_pan"], abs=0.03)


def test_weak_grip_and_lifted_payload_are_no_contact(world: Simulation) -> None:
    world.add_object("cube", "box", (0.0125,) * 3, (0.22, -0.05, 0.0125), mass=0.2)
    assert world.pick("cube")["why"] == "it is done"
    for pan in (-40.0, 40.0):
        assert "blocked" not in world.move_joints({"shoulder_pan": pan}, speed=1.0)["why"]


def test_policy_that_presses_against_a_wall_goes_on(world: Simulation) -> None:
    wall(world)
    answer = world.run_policy("arm", "press", "mock", 1.0)
    assert answer["status"] == "success"
    assert np.isfinite(list(world.body("arm").get_joints().values())).all()
