"""Stop levels of simulated robots: hold, limp, and settle to a rest pose."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.contract import RolloutEvent
from strands_robots.policies.settling import RANGES_PER_S, SETTLE_HZ
from strands_robots.robot import Robot
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.serving.robot_verbs import world_stop_answer
from strands_robots.serving.stops import WorldStop
from strands_robots.simulation import Simulation
from strands_robots.simulation.body import RobotBody, StopTorque
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.usefixtures("patient_halts", "patient_settling")

REST = {
    "shoulder_pan": 0.0,
    "shoulder_lift": -1.5,
    "elbow_flex": 1.5,
    "wrist_flex": 0.5,
    "wrist_roll": 0.0,
    "gripper": 0.0,
}
PATIENCE_S = 60.0
NEAR = 0.1
"""Radians from a pose that count as there."""

TENDON_GRIPPER = """<mujoco><worldbody><body name="finger"><joint name="finger" type="slide" axis="1 0 0" damping="1"/>
<geom size="0.01" mass="0.1"/></body></worldbody><actuator><general name="grip" joint="finger" biastype="affine"
gainprm="0.4" biasprm="0 -100 -10" ctrlrange="0 255"/></actuator></mujoco>"""
"""A servo whose command of 0 to 255 means 0 to about a metre."""


@pytest.fixture
def settler() -> Iterator[Simulation]:
    made = Simulation("settler", stop_level="settle", rest_pose=REST)
    assert made.add_robot("arm", "so100")["status"] == "success"
    yield made
    made.halt("the test is over")
    made.cleanup()


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, float]]:
    """What is written to a robot from now on, its settling's way as well."""
    actions: list[dict[str, float]] = []
    send = RobotBody.send_action

    def recorded(body: RobotBody, action: Mapping[str, float], permit: Any = None) -> dict[str, float]:
        sent = send(body, action, permit)
        actions.append(sent)
        return sent

    monkeypatch.setattr(RobotBody, "send_action", recorded)
    return actions


def moved(world: Simulation, robot: str = "arm") -> Simulation:
    """Have one robot move once, so that a stop has something to settle."""
    assert world.send_action({"shoulder_pan": 0.4}, robot)["status"] == "success"
    eventually(lambda: joints(world, robot)["shoulder_pan"] > 0.3, PATIENCE_S)
    return world


def joints(world: Simulation, robot: str = "arm") -> dict[str, float]:
    return world.body(robot).get_joints()


def off(world: Simulation, pose: Mapping[str, float], robot: str = "arm") -> float:
    return max(abs(joints(world, robot)[key] - value) for key, value in pose.items())


def limp(world: Simulation) -> set[str]:
    return set(world.physics.limp)


def test_a_simulation_holds_unless_another_level_is_chosen() -> None:
    world = Simulation(realtime=False)
    world.add_robot("arm", "so100")
    before = joints(world)
    assert world.halt("test").settling is False
    world.step(1000)
    assert off(world, before) < NEAR
    assert not limp(world)


def test_a_limp_arm_falls_and_its_next_motion_begins_where_it_lies() -> None:
    world = Simulation(stop_level="limp", realtime=False)
    world.add_robot("arm", "so100")
    before = joints(world)
    assert world.halt("test").stopped is True
    world.step(1000)
    fallen = joints(world)
    assert off(world, before) > 2 * NEAR
    assert {key: pytest.approx(value, abs=0.001) for key, value in fallen.items()} == world.targets("arm")
    assert world.halt("again").stopped is True
    assert limp(world) == {"arm"}
    assert world.send_action({"gripper": 0.5})["status"] == "success"
    targets = world.targets("arm")
    assert targets == {key: pytest.approx(value, abs=0.001) for key, value in {**fallen, "gripper": 0.5}.items()}
    world.step(1000)
    assert not limp(world)
    kept = {key: value for key, value in fallen.items() if key != "gripper"}
    assert off(world, kept) < NEAR


def test_a_reset_and_a_new_robot_give_the_torque_back_or_leave_it() -> None:
    world = Simulation(stop_level="limp", realtime=False)
    world.add_robot("arm", "so100")
    world.halt("test")
    world.step(100)
    world.add_robot("other", "so100")
    world.step(100)
    assert limp(world) == {"arm"}, "it is as limp beside another"
    assert world.reset()["status"] == "success"
    home = joints(world)
    world.step(1000)
    assert not limp(world)
    assert off(world, home) < NEAR


def test_a_stop_of_one_robot_leaves_the_torque_of_the_other() -> None:
    world = Simulation(stop_level="limp", realtime=False)
    world.add_robot("left", "so100")
    world.add_robot("right", "so100")
    assert world.stop_policy("left")["stopped"] is True
    assert limp(world) == {"left"}


def test_a_stop_freezes_then_goes_to_the_rest_pose_at_bounded_speed_and_goes_limp(
    settler: Simulation, written: list[dict[str, float]]
) -> None:
    moved(settler)
    frozen = joints(settler)
    written.clear()
    verdict = settler.halt("test")
    assert (verdict.stopped, verdict.settling) == (True, True)
    assert "is at its rest pose, and limp" in settler.wait_settled()
    assert limp(settler) == {"arm"}
    assert written[-1] == pytest.approx(REST)
    steps = {key: (high - low) * RANGES_PER_S / SETTLE_HZ for key, (low, high) in settler.body("arm").bounds.items()}
    assert all(abs(written[0][key] - frozen[key]) < steps[key] + NEAR for key in REST), "from where it was frozen"
    for before, after in itertools.pairwise(written):
        assert all(abs(after[key] - before[key]) <= steps[key] + 1e-9 for key in REST)
    assert settler.send_action({"gripper": 1.0})["status"] == "success", "a resumed robot takes its place back"
    assert not limp(settler)


@pytest.mark.usefixtures("unending_settling")
def test_every_motion_and_every_change_of_the_world_is_refused_while_it_settles(settler: Simulation) -> None:
    moved(settler).halt("test")
    answers = [settler.start_policy("arm", "wave"), settler.send_action({"gripper": 1.0}), settler.reset()]
    added = settler.add_robot("other", "so100")
    settler.halt("again")
    settler.wait_settled()
    assert all("arm settles to its rest pose" in answer["reason"] for answer in answers)
    assert "arm, which settles" in added["reason"]


@pytest.mark.usefixtures("unending_settling")
def test_a_second_stop_freezes_it_for_good(settler: Simulation, written: list[dict[str, float]]) -> None:
    moved(settler)
    written.clear()
    settler.halt("test")
    eventually(lambda: len(written) > 10, PATIENCE_S, "it is on its way")
    again = settler.halt("again")
    assert (again.stopped, again.settling, again.halted) == (True, False, ("settling arm",))
    assert "stopped again" in settler.wait_settled()
    assert settler.halt("a third time").settling is False
    assert not limp(settler)
    assert off(settler, REST) > NEAR


@pytest.mark.usefixtures("unending_settling")
def test_a_stop_of_the_one_robot_freezes_it_as_well(settler: Simulation) -> None:
    moved(settler).halt("test")
    assert settler.stop_policy("arm")["stopped"] is True
    assert "stopped again" in settler.wait_settled()
    assert not limp(settler)


def test_an_arm_that_was_stopped_by_its_name_does_not_settle_at_the_next_stop_of_all(settler: Simulation) -> None:
    assert moved(settler).stop_policy("arm")["stopped"] is True
    assert settler.halt("test").settling is False
    moved(settler)
    assert settler.halt("test").settling is True, "it has moved since"


@pytest.mark.usefixtures("unending_settling")
def test_of_two_stops_at_once_the_later_one_alone_lets_the_arm_settle(
    settler: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    revoke = settler.gate.revoke

    def overtaken() -> int:
        """Another stop is ordered before this one goes on."""
        mine = revoke()
        revoke()
        return mine

    moved(settler)
    with monkeypatch.context() as patched:
        patched.setattr(settler.gate, "revoke", overtaken)
        first = settler.halt("first")
    assert (first.stopped, first.settling) == (True, False)
    assert settler.wait_settled() == "", "nothing has settled"
    assert settler.halt("second").settling is True
    assert settler.halt("third").settling is False
    assert "stopped again" in settler.wait_settled()


@pytest.mark.usefixtures("unending_settling")
def test_a_stop_that_another_one_overtook_whole_says_that_the_arm_settles(
    settler: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    revoke, later = settler.gate.revoke, list[bool]()

    def overtaken() -> int:
        mine = revoke()
        patched.undo()
        later.append(settler.halt("later").settling)
        return mine

    moved(settler)
    with monkeypatch.context() as patched:
        patched.setattr(settler.gate, "revoke", overtaken)
        first = settler.halt("first")
    assert (later, first.settling) == ([True], True)
    assert settler.halt("third").settling is False


def test_a_robot_that_joins_changes_nothing_that_a_stop_is_reading(
    settler: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Mapping[str, Any]] = []
    pose_of = StopTorque._pose_of

    def observed(torque: StopTorque, parts: Any) -> dict[str, float]:
        read.append(torque._tasks.settlings.by_body)
        return pose_of(torque, parts)

    monkeypatch.setattr(StopTorque, "_pose_of", observed)
    assert settler.add_robot("other", "so100")["status"] == "success"
    assert [list(each) for each in read] == [["arm"]] * len(read)
    assert list(settler.tasks.settlings.by_body) == ["arm", "other"]


def test_a_stop_that_cannot_note_what_moves_halts_all_the_same(
    settler: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(world: Simulation) -> None:
        raise RuntimeError("a loop cannot say what it does")

    permit = settler.gate.permit("test")
    with monkeypatch.context() as patched:
        patched.setattr(Simulation, "halt_ordered", fails)
        assert settler.halt("test").stopped is True
    assert not permit.valid


@pytest.mark.usefixtures("unending_settling")
def test_an_emergency_stop_settles_a_locked_robot_and_a_second_one_freezes_it(settler: Simulation) -> None:
    with own_plane(20.0) as plane:
        plane.register("settler", moved(settler))
        report = plane.emergency_stop(StopOrder(new_epoch(), "tester"))["settler"]
        assert report.fields()["settling"] is True
        assert "locked" in settler.send_action({"gripper": 1.0})["reason"]
        again = plane.emergency_stop(StopOrder(new_epoch(), "tester"))["settler"]
        assert "settling" not in again.fields()
        settler.wait_settled()
        assert not limp(settler)


def test_a_stop_over_the_network_that_ends_a_policy_lets_it_settle(settler: Simulation) -> None:
    settler.start_policy("arm", "wave")
    eventually(lambda: [row["step"] for row in settler.list_policies_running()] > [0], PATIENCE_S)
    verdict = WorldStop(settler).halt("test")
    assert (verdict.stopped, verdict.settling, verdict.halted) == (True, True, ("arm",))
    assert world_stop_answer(verdict)["settling"] is True
    assert "at its rest pose" in settler.wait_settled()


def test_only_the_arm_that_moved_settles() -> None:
    world = Simulation(stop_level="settle", rest_pose={"left": REST, "right": REST})
    world.add_robot("left", "so100")
    world.add_robot("right", "so100")
    assert world.halt("test").settling is False, "none has moved"
    moved(world, "left").halt("test")
    assert world.wait_settled() == "left is at its rest pose, and limp."
    assert limp(world) == {"left"}
    world.cleanup()


def test_something_in_its_way_ends_the_settling_with_torque_and_an_event(
    settler: Simulation, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    events: list[RolloutEvent] = []
    settler.subscribe(events.append)
    moved(settler)
    stuck = settler.body("arm").get_positions()
    monkeypatch.setattr(RobotBody, "get_positions", lambda _: dict(stuck))
    settler.halt("test")
    assert "did not settle" in settler.wait_settled()
    assert not limp(settler)
    assert all(abs(each - joints(settler)[key]) < NEAR for key, each in settler.targets("arm").items())
    eventually(lambda: any(event.kind == "finished" and event.policy == "settle" for event in events), PATIENCE_S)
    assert "in its way" in events[-1].error
    assert flush_audit(60.0)
    assert [record for record in read_audit_log() if "settle_failed" in record.values()]
    assert [record for record in caplog.records if record.levelname == "CRITICAL" and "settle" in record.message]


def test_the_end_of_the_process_waits_until_it_has_settled() -> None:
    world = Robot("so100", stop_level="settle", rest_pose=REST, mesh=False)
    ends: list[str] = []
    world.subscribe(lambda event: ends.append(event.state))
    assert world.send_action({"shoulder_pan": 0.4})["status"] == "success"
    assert world.cleanup()["status"] == "success"
    assert limp(world) == {"so100"}
    assert ends == ["running", "completed"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stop_level": "settle"}, "needs a rest_pose"),
        ({"stop_level": "settle", "rest_pose": 3}, "rest_pose must be"),
        ({"stop_level": "fall"}, "stop_level must be"),
        ({"stop_level": True}, "stop_level must be"),
        ({"stop_level": "settle", "rest_pose": {"gripper": 0.0}}, "lacks shoulder_pan"),
        ({"stop_level": "settle", "rest_pose": {**REST, "tail": 0.0}}, "tail"),
        ({"stop_level": "settle", "rest_pose": {**REST, "gripper": 9.0}}, r"rest_pose\['gripper'\].* -0.2 to 2"),
        ({"stop_level": "settle", "rest_pose": {**REST, "gripper": float("nan")}}, r"rest_pose\['gripper'\]"),
        ({"stop_level": "settle", "rest_pose": {"other": REST}}, "must have a pose of so100"),
        ({"rest_pose": {"gripper": 0.0}}, "lacks shoulder_pan"),
    ],
)
def test_a_simulation_that_could_not_settle_is_refused_when_it_is_made(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Robot("so100", mesh=False, **options)


def test_a_robot_without_a_pose_of_its_own_does_not_join_the_world() -> None:
    world = Simulation(stop_level="settle", rest_pose={"arm": REST})
    assert world.add_robot("arm", "so100")["status"] == "success"
    assert "must have a pose of other" in world.add_robot("other", "so100")["reason"]
    assert world.list_robots() == ["arm"]


def test_the_setting_counts_for_simulations_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "settle")
    with pytest.raises(ValidationError, match=r"STRANDS_ESTOP_TORQUE.* needs a rest_pose"):
        Simulation()
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    world = Simulation()
    world.add_robot("arm", "so100")
    world.halt("test")
    assert limp(world) == {"arm"}
    world.cleanup()


def test_a_base_without_servos_stops_and_has_nothing_to_settle() -> None:
    world = Simulation(stop_level="settle", rest_pose=REST)
    assert world.add_robot("base", "rover")["status"] == "success"
    assert world.send_action({"linear_velocity": 0.3})["status"] == "success"
    assert world.halt("test").settling is False
    assert world.targets("base")["linear_velocity"] == 0.0
    world.cleanup()


def test_a_servo_whose_command_is_no_position_is_held_where_it_is(tmp_path: Path) -> None:
    model = tmp_path / "gripper.xml"
    model.write_text(TENDON_GRIPPER)
    world = Simulation(realtime=False, gravity=0.0)
    assert world.add_robot("hand", model)["status"] == "success"
    world.send_action({"grip": 200.0})
    world.step(5000)
    opened = joints(world, "hand")["finger"]
    assert opened == pytest.approx(0.8, abs=0.01)
    world.halt("test")
    world.step(2000)
    assert joints(world, "hand")["finger"] == pytest.approx(opened, abs=0.01)
