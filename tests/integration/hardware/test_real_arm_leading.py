"""A real leader arm and a real follower, and a calibration by hand, through LeRobot's driver."""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import Machine, on_a_terminal
from fixtures.feetech_bus import MOTORS, FeetechBus, arm_calibration, arm_servos
from fixtures.waiting import eventually
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.hardware.lerobot_device import Calibrator, JointReach, make_device
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.system


def test_follower_reaches_the_position_of_a_leader_moved_by_hand(
    bus: FeetechBus, calibration: Path, tmp_path: Path
) -> None:
    with FeetechBus(arm_servos(), link=tmp_path / "leader") as leader:
        pan = leader.servos[1]
        start = pan.shaft

        def wave() -> None:
            for step in range(100):
                pan.shaft = start + 400 * math.sin(step / 100 * math.tau)
                time.sleep(0.02)
            pan.shaft = start + 300

        by_hand = threading.Thread(target=wave)
        by_hand.start()
        files = ["--calibration", str(calibration), "--leader-calibration", str(calibration)]
        line = ["teleop", f"so101@{leader.port}", f"so101@{bus.port}", *files, "--for", "6", "--json"]
        result = CliRunner().invoke(build(), line)
        by_hand.join()
        assert result.exit_code == 0, result.output
        report = json.loads(result.stdout)
        assert report["state"] == "completed"
        assert report["stopped"] is True
        assert report["errors"] == 0
        assert report["frames"] > 20
        assert abs(bus.shafts()[1] - pan.shaft) < 20
        assert not any(servo.torque for servo in leader.servos.values()), "a leader is moved by hand"
        goals = [int.from_bytes(each.data, "little") for each in bus.writes if each.servo == 1 and each.address == 42]
        steps = [abs(after - before) for before, after in itertools.pairwise(goals)]
        assert max(steps) <= 2 * 2500 * 2.0 * 0.02, "the speed bound, of at most two periods"


def test_follower_with_a_missing_port_is_refused_in_one_sentence(calibration: Path) -> None:
    line = ["teleop", "keyboard", "so101@/dev/no-such-port", "--calibration", str(calibration), "--json"]
    result = CliRunner().invoke(build(), line)
    assert result.exit_code == 1
    assert "so101 could not be connected" in json.loads(result.stdout)["reason"]


@pytest.fixture
def fresh(tmp_path: Path) -> Any:
    with FeetechBus(arm_servos(calibrated=False), link=tmp_path / "fresh") as fresh:
        yield fresh


def follower(fresh: FeetechBus, tmp_path: Path) -> Any:
    options = {"port": fresh.port, "id": "new", "calibration_dir": tmp_path / "kept"}
    return make_device("so101", options, calibrated=False)


def test_an_arm_is_calibrated_by_moving_it(fresh: FeetechBus, tmp_path: Path) -> None:
    steps = Calibrator(follower(fresh, tmp_path))
    steps.begin()
    assert not any(servo.torque for servo in fresh.servos.values())
    for number, servo in fresh.servos.items():
        servo.shaft = 2000.0 + 10 * number
    steps.centre()
    seen: dict[str, JointReach] = {}
    for move in (-900, 800):
        for servo in fresh.servos.values():
            servo.shaft += move
        seen = steps.look()
        for servo in fresh.servos.values():
            servo.shaft -= move
    assert "wrist_roll" not in seen
    path = steps.finish()
    steps.close()
    kept = json.loads(path.read_text(encoding="utf-8"))
    assert path == tmp_path / "kept" / "new.json"
    assert list(kept) == list(MOTORS)
    assert kept["shoulder_pan"] == {
        "id": 1,
        "drive_mode": 0,
        "homing_offset": 2010 - 2047,
        "range_min": 2047 - 900,
        "range_max": 2047 + 800,
    }
    assert (kept["wrist_roll"]["range_min"], kept["wrist_roll"]["range_max"]) == (0, 4095)
    again = follower(fresh, tmp_path)
    again.connect(calibrate=False)
    assert again.is_calibrated, "LeRobot reads the file and finds the same in the servos"
    again.disconnect()


def test_joints_that_were_not_moved_are_named_and_nothing_is_kept(fresh: FeetechBus, tmp_path: Path) -> None:
    steps = Calibrator(follower(fresh, tmp_path))
    steps.begin()
    steps.centre()
    fresh.servos[1].shaft += 5
    steps.look()
    fresh.servos[1].shaft += 500
    steps.look()
    with pytest.raises(ValidationError, match="not moved: shoulder_lift, elbow_flex, wrist_flex, gripper"):
        steps.finish()
    steps.close()
    assert not (tmp_path / "kept" / "new.json").exists()


def test_the_command_asks_step_by_step(fresh: FeetechBus) -> None:
    ended = CliRunner().invoke(build(), ["calibrate", "so101", "--port", fresh.port, "--id", "new"], input="")
    assert ended.exit_code == 2
    assert "standard input has ended" in ended.output
    eventually(lambda: not any(servo.torque for servo in fresh.servos.values()))


def looked(bus: FeetechBus) -> None:
    """Wait until the command has read every joint since now."""
    before = bus.answers
    eventually(lambda: bus.answers > before + 3 * len(MOTORS), what="two looks at the joints")


def test_a_joint_that_was_not_moved_is_asked_for_again_by_name(fresh: FeetechBus) -> None:
    def moved(numbers: Sequence[int]) -> None:
        for move in (-900, 800):
            for number in numbers:
                fresh.servos[number].shaft += move
            looked(fresh)
            for number in numbers:
                fresh.servos[number].shaft -= move

    words = ["calibrate", "so101", "--port", fresh.port, "--id", "again"]
    line = [sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli", *words]
    with on_a_terminal(line, os.environ) as terminal:
        eventually(lambda: "the middle of its motion" in terminal.drawn, within=60, what="the first question")
        terminal.press("\r")
        eventually(lambda: "Now move every joint" in terminal.drawn, what="the second question")
        moved([1, 2, 6])
        # A joint at rest trembles.
        fresh.servos[3].shaft += 3
        terminal.press("\r")
        eventually(lambda: "Not moved yet: elbow_flex, wrist_flex." in terminal.drawn, what="the names")
        moved([3, 4])
        terminal.press("\r")
        assert terminal.process.wait(60) == 0, terminal.drawn


@pytest.mark.parametrize("machine", [False, True], ids=["shown", "json"])
def test_an_arm_is_calibrated_at_a_terminal(fresh: FeetechBus, machine: bool) -> None:
    name = f"by-hand-{machine}"
    words = ["calibrate", "so101", "--port", fresh.port, "--id", name, *(["--json"] if machine else [])]
    for servo in fresh.servos.values():
        servo.put("torque_enable", 1)
    line = [sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli", *words]
    with on_a_terminal(line, os.environ) as terminal:
        eventually(lambda: not any(servo.torque for servo in fresh.servos.values()), within=30, what="the torque off")
        eventually(lambda: machine or "the middle of its motion" in terminal.drawn, what="the first question")
        for number, servo in fresh.servos.items():
            servo.shaft = 2000.0 + 10 * number
        terminal.press("\r")
        # LeRobot sets each to 0 first.
        taken = 2 * len(MOTORS)
        eventually(lambda: len(fresh.written_after(0.0, "homing_offset")) == taken, what="the middle, taken")
        for move in (-900, 800):
            looked(fresh)
            for servo in fresh.servos.values():
                servo.shaft += move
            looked(fresh)
            for servo in fresh.servos.values():
                servo.shaft -= move
        terminal.press("\r")
        assert terminal.process.wait(60) == 0, terminal.drawn
        eventually(lambda: f"{name}.json" in terminal.drawn, what="where it is kept")
    (path,) = Path(os.environ["HF_LEROBOT_HOME"]).rglob(f"{name}.json")
    kept = json.loads(path.read_text(encoding="utf-8"))
    assert {motor: (each["range_min"], each["range_max"]) for motor, each in kept.items()} == {
        **dict.fromkeys(MOTORS, (2047 - 900, 2047 + 800)),
        "wrist_roll": (0, 4095),
    }
    assert fresh.servos[1].get("min_position") == 2047 - 900, "the servos know it too"
    if machine:
        line = next(line for line in terminal.drawn.splitlines() if line.startswith("{"))
        assert json.loads(line) == {"status": "success", "file": str(path)}
    else:
        assert "shoulder_pan" in terminal.drawn, "the joints are shown while they are moved"


def test_the_calibration_of_the_fixture_is_lerobots_own_shape() -> None:
    assert set(arm_calibration()) == set(MOTORS)


def test_led_arm_is_stopped_from_the_network(bus: FeetechBus, calibration: Path, tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    with FeetechBus(arm_servos(), link=tmp_path / "leader") as leader:
        files = ["--calibration", str(calibration), "--leader-calibration", str(calibration)]
        words = ["teleop", f"so101@{leader.port}", f"so101@{bus.port}", *files, "--peer-id", "arm-1", "--json"]
        patient = [sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli", *words]
        with on_a_terminal(patient, machine.environment) as terminal:
            pan, ended = leader.servos[1], threading.Event()

            def wave() -> None:
                start = pan.shaft
                while not ended.wait(0.02):
                    pan.shaft = start + 400 * math.sin(time.monotonic())

            by_hand = threading.Thread(target=wave)
            by_hand.start()
            try:
                eventually(lambda: len(bus.written_after(0.0, "goal_position")) > 100, within=60, what="a led arm")
                code, said = machine.json("stop", "arm-1")
                assert code == 0, said
                stopped_at = time.monotonic()
                # The leader goes on waving while this command runs.
                machine.run("peers")
                assert not bus.written_after(stopped_at, "goal_position")
                assert all(servo.torque for servo in bus.servos.values()), "it keeps its position"
                assert '"event": "held"' in terminal.drawn
                terminal.process.send_signal(signal.SIGINT)
                assert terminal.process.wait(60) == 1
            finally:
                ended.set()
                by_hand.join()


def test_led_arm_that_stands_beyond_its_range_is_not_moved_by_a_grip_or_a_hold(bus: FeetechBus, arm: Any) -> None:
    pan = bus.servos[1]
    pan.shaft += 700.0
    pan.put("goal_position", pan.get("goal_position") + 700)
    robot = arm(joint_ranges={"shoulder_pan.pos": (-20.0, 20.0)})
    assert robot.get_state()["joints"]["shoulder_pan.pos"] > 40.0
    stands, opened = pan.shaft, robot.lead("hand")
    lift = opened["joints"]["shoulder_lift.pos"]
    for seq in range(1, 20):
        robot.lead_to(
            opened["lead_id"], seq, targets={"shoulder_lift.pos": lift}, made=time.monotonic(), told=opened["now"]
        )
        time.sleep(0.02)
    eventually(lambda: robot.lead_to(opened["lead_id"], 0)["state"] == "held")
    assert robot.lead_to(opened["lead_id"], 0)["written"]["shoulder_pan.pos"] > 40.0
    assert robot.halt("test ended").stopped
    assert abs(pan.shaft - stands) < 5.0
