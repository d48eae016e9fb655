"""A robot advertises only what it can do: which verbs of a table are offered, and what is refused all the same."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import TorqueDevice
from fixtures.pan_tilt import ArmDevice, BarePanTilt, PanTilt
from fixtures.ros_memory import MemoryLink
from fixtures.toy_robots import ToyRobot, ToyWorld

from strands_robots.adapted import adapt
from strands_robots.device_connect.robot_driver import MobileBaseDeviceDriver
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.hardware import HardwareRobot
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.lead_verbs import LEAD_VERBS
from strands_robots.serving.offered_verbs import offered
from strands_robots.serving.peer_verbs import KINDS, PEER_VERBS, kind_of
from strands_robots.serving.reachy_verbs import REACHY_VERBS
from strands_robots.serving.robot_verbs import TASK_VERBS, WORLD_VERBS
from strands_robots.serving.stops import OneRobot
from strands_robots.simulation import Simulation

ALWAYS = {"stop", "resume", "getStatus", "getFeatures", *CONTROL_VERBS}
OF_TASKS = {*ALWAYS, "execute", "getState"}
OF_WORLDS = {*ALWAYS, "step", "reset", *PICTURE_VERBS}


class Foreign:
    """A robot of four verbs, and what else a test gives it."""

    tool_name_str = "foreign"

    def start_task(self, instruction: str, **policy: Any) -> dict[str, Any]:
        return {"status": "success"}

    def stop_task(self) -> dict[str, Any]:
        return {"status": "success"}

    def get_task_status(self) -> dict[str, Any]:
        return {"task_status": "idle"}

    def get_features(self) -> dict[str, Any]:
        return {"observation_features": {}, "action_features": {}}


@pytest.fixture
def world() -> Iterator[Simulation]:
    made = Simulation()
    yield made
    made.cleanup()


def real(device: Any, **options: Any) -> HardwareRobot:
    return HardwareRobot(device, "arm", **options)


def test_simulated_arm_offers_all_that_it_can_do(world: Simulation) -> None:
    world.add_robot("so100")
    assert set(offered(world, WORLD_VERBS)) == set(WORLD_VERBS)


def test_simulated_rover_offers_no_verb_of_an_arm(world: Simulation) -> None:
    world.add_robot("rover")
    assert set(offered(world, WORLD_VERBS)) == {*OF_WORLDS, *LEAD_VERBS, "execute"}
    world.add_robot("so100")
    assert set(offered(world, WORLD_VERBS)) == set(WORLD_VERBS), "one of its robots can"
    world.remove_robot("so100")
    assert "pick" not in offered(world, WORLD_VERBS)


def test_empty_world_offers_nothing_that_needs_a_robot(world: Simulation) -> None:
    assert set(offered(world, WORLD_VERBS)) == OF_WORLDS


def test_moving_world_is_not_waited_for(world: Simulation) -> None:
    world.add_robot("so100")
    with ExitStack() as held:
        held.enter_context(world.starting)
        held.enter_context(world.physics._command_lock)
        assert "pick" in offered(world, WORLD_VERBS)


@pytest.mark.parametrize(
    ("robot", "more"),
    [
        (lambda: real(PanTilt()), {"moveJoints", "wait"}),
        (lambda: real(BarePanTilt()), set()),
        (lambda: real(TorqueDevice()), {"releaseTorque"}),
        (lambda: real(ArmDevice()), {*ARM_MOTION_VERBS} - {"getObjects"}),
        (lambda: real(ArmDevice("normalized")), set()),
        (lambda: real(BarePanTilt(), model="nowhere.xml"), set()),
        (lambda: adapt(Foreign()), set()),
        (ToyRobot, set()),
    ],
    ids=[
        "pan-tilt",
        "stating nothing",
        "torque",
        "so101",
        "not calibrated",
        "no such model",
        "foreign",
        "contract alone",
    ],
)
def test_real_robot_offers_what_its_device_has(robot: Callable[[], Any], more: set[str]) -> None:
    assert set(offered(robot(), TASK_VERBS)) - {*LEAD_VERBS} == OF_TASKS | more


def test_camera_and_detector_of_a_real_arm_are_offered() -> None:
    device = ArmDevice()
    robot = real(device)
    assert offered(robot, TASK_VERBS).keys().isdisjoint(PICTURE_VERBS)
    device.cameras = {"front": SimpleNamespace()}  # type: ignore[attr-defined]
    assert offered(robot, TASK_VERBS).keys() >= PICTURE_VERBS.keys()
    robot.detector = lambda frames: []  # type: ignore[assignment]
    assert "getObjects" in offered(robot, TASK_VERBS)


def test_arm_of_another_model_file_offers_its_jaws_when_it_states_them(tmp_path: Path) -> None:
    model = tmp_path / "arm.xml"
    model.write_text("<mujoco/>")
    assert "pick" not in offered(real(PanTilt(), model=str(model)), TASK_VERBS)
    robot = real(ArmDevice(), model=str(model))
    assert offered(robot, TASK_VERBS).keys() >= {"moveTo", "pick", "setGripper"}


def test_model_that_is_loaded_decides() -> None:
    robot = real(ArmDevice())
    assert robot.arm().jaw is not None
    assert set(offered(robot, TASK_VERBS)) == OF_TASKS | {*LEAD_VERBS} | {*ARM_MOTION_VERBS} - {"getObjects"}


@pytest.mark.parametrize("method", ["pick", "release_torque", "camera_frames", "arm_pose"])
def test_foreign_robot_with_a_method_offers_its_verb(method: str) -> None:
    class More(Foreign):
        pass

    setattr(More, method, lambda self, *given, **named: {})
    verbs = {
        "pick": {"pick"},
        "release_torque": {"releaseTorque"},
        "camera_frames": set(PICTURE_VERBS),
        "arm_pose": {"getPose"},
    }
    assert set(offered(adapt(More()), TASK_VERBS)) == OF_TASKS | verbs[method]


def test_foreign_robot_that_states_a_picture_offers_its_cameras() -> None:
    class Seeing(Foreign):
        observation_features: Mapping[str, Any] = {"front": (480, 640, 3), "pan.pos": float}

        def get_observation(self) -> dict[str, Any]:
            raise AssertionError("no picture is taken to describe a robot")

    assert set(offered(adapt(Seeing()), TASK_VERBS)) == {*OF_TASKS, *PICTURE_VERBS}


def test_reachy_offers_what_it_always_did() -> None:
    reachy = ReachyDriver("localhost")
    assert offered(reachy, REACHY_VERBS) == REACHY_VERBS
    assert set(offered(reachy, PEER_VERBS)) == set(KINDS["reachy_mini"])


def test_base_offers_no_task_and_no_arm() -> None:
    base = MobileBaseRobot("base", MemoryLink(), "/cmd_vel")
    verbs = offered(base, MobileBaseDeviceDriver.verbs)
    assert set(verbs) == {*ALWAYS, "getState", "drive"}
    assert set(offered(base, PEER_VERBS)) == set(KINDS["mobile_base"])
    base.disconnect()


def test_peers_verbs_are_offered_by_the_same_rules(world: Simulation) -> None:
    of_peers = {"status", "stop", "features", "state", "resume", "ping", "describe", *CONTROL_VERBS}
    assert set(offered(adapt(Foreign()), PEER_VERBS)) == {*of_peers, "execute", "start"}
    streams = {"teleop_status", "teleop_receive", "teleop_stop"}
    pan_tilt = {*of_peers, "execute", "start", *streams, *LEAD_VERBS, "moveJoints", "wait"}
    assert set(offered(real(PanTilt()), PEER_VERBS)) == pan_tilt
    world.add_robot("so100")
    world.add_robot("rover")
    rover = OneRobot(world, "rover")  # type: ignore[arg-type]
    assert set(offered(rover, PEER_VERBS)) == {*of_peers, "execute", "start", *PICTURE_VERBS}
    arm = OneRobot(world, "so100")  # type: ignore[arg-type]
    assert set(offered(arm, PEER_VERBS)) == {*of_peers, "execute", "start", *PICTURE_VERBS, *ARM_MOTION_VERBS}


def test_a_kind_never_offers_less_than_it_is_known_for(world: Simulation) -> None:
    world.add_robot("so100")
    assert set(offered(world, PEER_VERBS)) >= set(KINDS[kind_of(world)])  # type: ignore[arg-type]


def test_robot_whose_parts_cannot_be_told_is_described_all_the_same() -> None:
    class Broken(Foreign):
        @property
        def has_cameras(self) -> bool:
            raise OSError("no bus")

    assert offered(adapt(Broken()), TASK_VERBS).keys() >= {*OF_TASKS, *PICTURE_VERBS}


def test_verb_that_is_not_offered_is_refused_by_its_reason() -> None:
    robot = real(PanTilt())
    assert "pick" not in offered(robot, TASK_VERBS)
    answer = robot.pick(x=0.2, y=0.0, z=0.02)
    assert "no model of pan_tilt is known" in answer["reason"]


def test_toy_world_offers_what_its_class_has() -> None:
    assert set(offered(ToyWorld(), WORLD_VERBS)) == {*ALWAYS, "execute", "step", "reset"}


WITHOUT_LIBRARIES = """
import sys
from fixtures.pan_tilt import ArmDevice
from strands_robots.hardware import HardwareRobot
from strands_robots.serving.lead_verbs import LEAD_VERBS
from strands_robots.serving.offered_verbs import offered
from strands_robots.serving.robot_verbs import TASK_VERBS
verbs = offered(HardwareRobot(ArmDevice(), "arm"), TASK_VERBS)
print("pick" in verbs, [name for name in ("mujoco", "numpy") if name in sys.modules])
"""


def test_neither_mujoco_nor_numpy_is_loaded_to_describe_a_real_arm() -> None:
    command = [sys.executable, "-c", WITHOUT_LIBRARIES]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "True []\n", done.stderr
