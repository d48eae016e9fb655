"""``moveJoints`` of a real robot without a model: between the limits that it states, as any other motion."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.pan_tilt import RANGES, BarePanTilt, PanTilt
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.hardware.device_facts import stated_joints, still_action
from strands_robots.kinematics.motion import Motion
from strands_robots.policies.rollout import Rollout
from strands_robots.safety.gate import Permit
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS

HZ = 100.0


@contextmanager
def served(device: Any, **options: Any) -> Iterator[HardwareRobot]:
    robot = HardwareRobot(device, "head", HZ, **options)
    robot.connect()
    try:
        yield robot
    finally:
        robot.cleanup()


@pytest.fixture
def device() -> PanTilt:
    return PanTilt()


@pytest.fixture
def robot(device: PanTilt) -> Iterator[HardwareRobot]:
    with served(device) as made:
        yield made


def test_robot_of_five_verbs_goes_to_ten_degrees(robot: HardwareRobot, device: PanTilt) -> None:
    answer = robot.move_joints({"pan": 10.0})
    assert answer["status"] == "success", answer
    assert (answer["task_status"], answer["task_id"], answer["why"]) == ("completed", "moveJoints-1", "it is done")
    assert (answer["asked"], answer["checked"]) == ({"joints": {"pan": 10.0}}, "limits")
    assert answer["reached"] == {"joints": {"pan": 10.0}}
    assert (answer["error_deg"], answer["error_mm"], answer["holding"]) == (0.0, None, None)
    assert device.positions == {"pan.pos": pytest.approx(10.0), "tilt.pos": 0.0}


def test_joints_move_together_on_a_line_and_within_the_speed_limit() -> None:
    device = PanTilt()
    motions: list[Motion] = []
    # In the proportion of the two ways, so that what follows a pause is cut alike.
    with served(device, speed_limit={"pan.pos": 60.0, "tilt.pos": 30.0}) as robot:
        start = robot.start_motion

        def noted(name: str, verb: str, plan: Callable[[float, Permit], Motion]) -> Rollout:
            def planned(hz: float, permit: Permit) -> Motion:
                motions.append(plan(hz, permit))
                return motions[-1]

            return start(name, verb, planned)

        robot.start_motion = noted  # type: ignore[method-assign]
        assert robot.move_joints({"pan": 30.0, "tilt": -15.0}, speed=0.5)["status"] == "success"
    pan, tilt = device.steps("pan.pos"), device.steps("tilt.pos")
    assert [value for _, value in tilt] == pytest.approx([-value / 2 for _, value in pan], abs=1e-6)
    steps = [after - before for (_, before), (_, after) in itertools.pairwise(pan)]
    assert min(steps) >= 0.0
    # A busy machine leaves setpoints out; the plan has them all. 30 degrees at half of 60 degrees a second:
    assert motions[0].duration >= 1.0


def test_joint_is_named_by_its_key_as_well(robot: HardwareRobot) -> None:
    assert robot.move_joints({"pan.pos": -5.0})["reached"] == {"joints": {"pan": pytest.approx(-5.0)}}


def test_joint_that_is_there_already_moves_nothing_and_is_done(robot: HardwareRobot, device: PanTilt) -> None:
    assert robot.move_joints({"pan": 0.0})["task_status"] == "completed"
    assert device.writes == []


@pytest.mark.parametrize(
    ("joints", "reason"),
    [
        ({"pan": 90.5}, "pan must be from -90 to 90 degrees, not 90.5."),
        ({"tilt": -31.0, "pan": 0.0}, "tilt must be from -30 to 60 degrees, not -31."),
        ({"roll": 1.0}, "joints must be of pan, tilt; there is no roll."),
        ({"pan": 1.0, "pan.pos": 2.0}, "joints must name pan once."),
    ],
)
def test_joint_outside_its_domain_is_refused_by_name(
    robot: HardwareRobot, device: PanTilt, joints: dict[str, float], reason: str
) -> None:
    assert robot.move_joints(joints)["reason"] == reason
    assert device.writes == []


@pytest.mark.parametrize("value", [90.0, -90.0])
def test_limit_itself_is_reached(robot: HardwareRobot, value: float) -> None:
    assert robot.move_joints({"pan": value}, speed=1.0)["reached"] == {"joints": {"pan": pytest.approx(value)}}


@pytest.mark.parametrize(
    ("unit", "ranges", "part"),
    [
        ("", {"arm.pos": (0.0, 1.0)}, "arm cannot be moved to a position: it is told in an unknown unit"),
        ("percent", {"arm.pos": (0.0, 100.0)}, "it is told in percent, of which no degrees can be made"),
        ("degrees", {}, "arm cannot be moved to a position: its limits are not stated; give joint_ranges"),
        ("normalized", {"arm.pos": (-100.0, 100.0)}, "it is told in normalized, of which no degrees can be made"),
    ],
)
def test_joint_without_unit_or_limits_is_refused_and_the_others_move(
    unit: str, ranges: dict[str, tuple[float, float]], part: str
) -> None:
    units = {**dict.fromkeys(RANGES, "degrees"), **({"arm.pos": unit} if unit else {})}
    with served(PanTilt({"arm.pos": 0.5}, units=units, ranges={**RANGES, **ranges})) as robot:
        assert part in robot.move_joints({"arm": 0.0})["reason"]
        assert robot.move_joints({"pan": 3.0})["status"] == "success"
        assert robot.device.positions["arm.pos"] == 0.5


def test_slide_is_told_in_metres_and_measured_in_millimetres() -> None:
    units, ranges = {**dict.fromkeys(RANGES, "degrees"), "rail.pos": "metres"}, {**RANGES, "rail.pos": (0.0, 0.4)}
    with served(PanTilt({"rail.pos": 0.1}, units=units, ranges=ranges)) as robot:
        answer = robot.move_joints({"rail": 0.2}, speed=1.0)
        assert (answer["reached"], answer["error_mm"], answer["error_deg"]) == ({"joints": {"rail": 0.2}}, 0.0, None)
        assert robot.move_joints({"rail": 0.5})["reason"] == "rail must be from 0 to 0.4 m, not 0.5."


def test_radians_of_a_device_are_degrees_of_its_caller() -> None:
    units = {"pan.pos": "radians", "tilt.pos": "degrees"}
    with served(PanTilt(units=units, ranges={"pan.pos": (-1.5, 1.5), "tilt.pos": (-30.0, 60.0)})) as robot:
        assert robot.move_joints({"pan": 45.0})["status"] == "success"
        assert robot.device.positions["pan.pos"] == pytest.approx(0.785398, abs=1e-5)


class Normalized:
    """One motor of LeRobot's, normalized from -100 to 100 over half a turn."""

    def __init__(self, counts: int) -> None:
        motor = SimpleNamespace(model="servo", norm_mode=SimpleNamespace(name="RANGE_M100_100"))
        entry = SimpleNamespace(range_min=1024, range_max=1024 + 2047.5, drive_mode=0)
        self.bus = SimpleNamespace(
            motors={"pan": motor}, calibration={"pan": entry}, model_resolution_table={"servo": counts}
        )
        self.action_features = {"pan.pos": float}

    def get_observation(self) -> dict[str, float]:
        return {"pan.pos": 0.0}


def test_calibrated_motor_is_told_in_degrees_from_the_middle_of_its_range() -> None:
    bounds = {"pan.pos": (-100.0, 100.0)}
    (joint,) = stated_joints(Normalized(4096), bounds)
    assert (joint.name, joint.refusal, joint.low, joint.high) == ("pan", "", -90.0, 90.0)
    assert joint.position(45.0) * joint.factor == pytest.approx(50.0)
    (unknown,) = stated_joints(Normalized(1024), bounds)
    assert "told in normalized" in unknown.refusal


def test_joint_ranges_of_the_robot_are_its_limits() -> None:
    bare = BarePanTilt()
    bare.joint_units = {"pan.pos": "degrees", "tilt.pos": "degrees"}  # type: ignore[attr-defined]
    with served(bare, joint_ranges={"pan.pos": (-20.0, 20.0), "tilt.pos": (0.0, 10.0)}) as robot:
        assert robot.move_joints({"pan": 15.0})["status"] == "success"
        assert robot.move_joints({"pan": 21.0})["reason"] == "pan must be from -20 to 20 degrees, not 21."
        assert bare.positions == {"pan.pos": pytest.approx(15.0), "tilt.pos": 0.0}


def test_nothing_is_written_after_the_verdict_of_a_halt_in_mid_motion(robot: HardwareRobot, device: PanTilt) -> None:
    started = robot.move_joints({"pan": 80.0}, speed=0.2, wait=False)
    assert started["task_status"] == "running"
    eventually(lambda: device.positions["pan.pos"] > 2.0)
    verdict = robot.halt("test")
    ended = time.monotonic()
    assert verdict.stopped and verdict.halted
    answer = robot.wait_for()
    assert (answer["task_status"], answer["why"]) == ("stopped", "it was stopped")
    assert answer["reached"]["joints"]["pan"] < 80.0
    assert device.written_after(ended) == []
    still = dict(device.positions)
    assert robot.get_task_status()["outcome"]["task_id"] == started["task_id"]
    assert device.positions == still


def test_locked_robot_refuses_the_motion(robot: HardwareRobot, device: PanTilt) -> None:
    with own_plane(20.0) as plane:
        plane.register("head", robot)
        assert plane.emergency_stop(StopOrder(new_epoch(), "safety-1"))["head"].stopped
        before = len(device.writes)
        refused = robot.move_joints({"pan": 10.0})
        assert refused["status"] == "error"
        assert "emergency stop" in refused["reason"]
        assert len(device.writes) == before


def test_second_motion_is_refused_while_one_runs(robot: HardwareRobot) -> None:
    robot.move_joints({"pan": 80.0}, speed=0.1, wait=False)
    assert "driven by the task" in robot.move_joints({"tilt": 1.0})["reason"]
    robot.halt("test")


def test_joint_that_does_not_move_ends_the_motion_with_its_name() -> None:
    with served(PanTilt(stuck=("pan.pos",))) as robot:
        answer = robot.move_joints({"pan": 40.0, "tilt": 5.0}, speed=1.0)
    assert answer["status"] == "error"
    assert answer["why"].startswith("pan was blocked at 0 degrees")


def test_motion_that_would_last_for_hours_is_refused(robot: HardwareRobot) -> None:
    assert "speed must let the motion end within 3600 s" in robot.move_joints({"pan": 90.0}, speed=1e-9)["reason"]


def test_what_is_not_asked_for_stays_where_it_was_told_to_be() -> None:
    units = {"pan.pos": "degrees", "push": "newtons"}
    device = SimpleNamespace(action_features=dict.fromkeys(units, float), joint_units=units)
    bounds = {"pan.pos": (-1.0, 1.0), "grip.pos": (0.0, 100.0), "x.vel": (-1.0, 1.0), "push": (0.0, 1.0)}
    told = still_action(device, bounds, {"grip.pos": 20.0}, {"grip.pos": 24.0, "pan.pos": 0.5, "x.vel": 0.1, "push": 1})
    assert told == {"x.vel": 0.0, "pan.pos": 0.5, "grip.pos": 20.0}


def test_robot_with_a_known_model_is_never_moved_without_it() -> None:
    device = PanTilt()
    device.name = "so101_follower"  # type: ignore[misc]
    with served(device) as robot:
        assert robot.stated_joints() == ()
        assert "does not fit" in robot.move_joints({"pan": 1.0})["reason"]


@pytest.mark.parametrize(
    ("device", "verbs"),
    [
        (PanTilt, {"moveJoints", "wait"}),
        (BarePanTilt, set()),
        (lambda: PanTilt(ranges={}), set()),
        (lambda: PanTilt(ranges={"tilt.pos": (0.0, 1.0)}), {"moveJoints", "wait"}),
    ],
)
def test_robot_without_a_model_has_the_verbs_of_its_joints(device: Callable[[], Any], verbs: set[str]) -> None:
    with served(device()) as robot:
        assert robot.arm_verbs() == verbs
        assert verbs <= set(ARM_MOTION_VERBS)


WITHOUT_MUJOCO = """
import sys
sys.modules["mujoco"] = None
from fixtures.pan_tilt import PanTilt
from strands_robots.hardware import HardwareRobot
robot = HardwareRobot(PanTilt(), "head", 100.0)
assert "numpy" not in sys.modules
robot.connect()
assert robot.arm_verbs() == {"moveJoints", "wait"}
assert "numpy" not in sys.modules, "what it can do is told without numpy"
answer = robot.move_joints({"pan": 10.0}, speed=1.0)
print(answer["task_status"], round(robot.device.positions["pan.pos"], 3))
robot.cleanup()
"""


def test_joints_move_without_mujoco() -> None:
    command = [sys.executable, "-c", WITHOUT_MUJOCO]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "completed 10.0\n", done.stderr
