"""The conformance suite on robots of this process, on real networks: it passes the good one and names each fault."""

from __future__ import annotations

import importlib.util
import re
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures import faulty_robots
from fixtures.faulty_robots import LIMIT, Rig, subject

from strands_robots import Permit, verb
from strands_robots.hardware import HardwareRobot
from strands_robots.testing import BusRecorder, CheckMark, Subject, Tier, conform

EXAMPLES = Path(__file__).parents[3] / "examples"
pytestmark = pytest.mark.system


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"conformed_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_robot_that_keeps_its_promises_is_platinum() -> None:
    report = conform(subject(Rig), Tier.PLATINUM)
    # The one thing that another program of this machine can keep from being proven; a failure it cannot.
    busy = [each.check for each in report.results if "this machine" in each.said] == ["platinum.estop"]
    assert report.tier is (Tier.GOLD if busy else Tier.PLATINUM), report.words()
    assert report.name == "Rig"
    assert not report.failed


def test_nothing_of_a_run_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "agent")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    conform(subject(Rig), only=["bronze.verbs"])
    import os  # noqa: PLC0415 - the environment as it is now

    assert (os.environ["STRANDS_STATE_DIR"], os.environ["DEVICE_CONNECT_RPC_ALLOW"]) == (str(tmp_path), "agent")
    assert [*tmp_path.iterdir(), *temporary.iterdir()] == [temporary]


def test_without_a_recorder_silver_is_not_proven() -> None:
    report = conform(Subject(lambda: Rig(BusRecorder())), only=["bronze.status", "silver.halts"])
    assert [each.mark for each in report.results] == [CheckMark.PASSED, CheckMark.NOT_PROVEN]
    assert report.tier is None, "two checks are no tier"
    assert "not every check was made" in report.words()


def test_motor_that_goes_on_without_a_write_is_not_proven_to_stand_by_its_writes() -> None:
    recorder = BusRecorder()
    unseen = Subject(lambda: faulty_robots.KeepsItsSpeed(recorder), recorder)
    (halts,) = conform(unseen, only=["silver.halts"]).results
    assert (halts.mark, "Subject(moving=...)" in halts.said) == (CheckMark.NOT_PROVEN, True)


def test_bus_that_meets_no_fault_proves_no_halt_without_a_cable(monkeypatch: pytest.MonkeyPatch) -> None:
    unmet = subject(Rig)
    monkeypatch.setattr(unmet.recorder, "fail", lambda: None)
    for each in conform(unmet, only=["silver.honest", "gold.recovers"]).results:
        assert (each.mark, "call recorder.fail()" in each.said) == (CheckMark.NOT_PROVEN, True)


def test_motor_that_is_never_seen_to_move_is_not_proven_to_stand() -> None:
    unseen = replace(subject(faulty_robots.KeepsItsSpeed), moving=lambda: False)
    (halts,) = conform(unseen, only=["silver.halts"]).results
    assert (halts.mark, "has to be True while it moves" in halts.said) == (CheckMark.NOT_PROVEN, True)


def test_verb_that_turns_its_motor_on_is_not_proven_to_stand_by_its_writes() -> None:
    class Spins(Rig):
        @verb(motion=True, lasts=60.0)
        def spin(self, permit: Permit) -> None:
            """Tell the motor a speed, which no stop takes back."""
            self.write(self.angle)
            while permit.valid:
                time.sleep(0.01)

    (result,) = conform(subject(Spins), only=["silver.verbs"]).results
    assert (result.mark, "spin had no two writes" in result.said) == (CheckMark.NOT_PROVEN, True), result.said


def test_one_robot_of_a_subject_lives_at_a_time() -> None:
    alive: list[int] = []

    class Lone(Rig):
        def cleanup(self) -> None:
            alive.pop()

    def make() -> Rig:
        alive.append(len(alive))
        assert len(alive) == 1
        return Lone(BusRecorder())

    report = conform(Subject(make), only=["silver.unlinked"])
    assert [each.mark for each in report.results] == [CheckMark.PASSED]
    assert alive == []


def test_exception_of_a_robot_is_named_with_its_place() -> None:
    report = conform(subject(faulty_robots.RaisesInARead), only=["bronze.reads"])
    assert re.search(r"the robot raised \w+: .+ \(faulty_robots\.py:\d+ in \w+\)", report.results[-1].said), (
        report.words()
    )


def test_robot_that_cannot_be_made_is_named_with_its_error() -> None:
    def make() -> Any:
        raise OSError("no such port")

    report = conform(Subject(make, name="portless"))
    assert report.tier is None
    assert [(each.check, each.mark) for each in report.results] == [("bronze.made", CheckMark.FAILED)]
    assert "no such port" in report.words()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_examples_are_gold() -> None:
    """The robots that newcomers copy from: tasks, a device with LeRobot's methods, verbs of its own."""
    recorder = BusRecorder()
    barista = example("barista")

    def step(seconds: float) -> None:
        recorder.wrote("step")
        time.sleep(seconds)

    barista.time = SimpleNamespace(monotonic=time.monotonic, sleep=step)
    own_robot = example("own_robot")

    class Recorded(own_robot.Turntable):  # type: ignore[misc,name-defined]
        def __setattr__(self, name: str, value: Any) -> None:
            if name == "_angle_deg" and value:
                recorder.wrote("angle")
            super().__setattr__(name, value)

    own_driver = example("own_driver")

    def driver() -> HardwareRobot:
        device = own_driver.PanTilt()
        recorder.watch(device, "send_action")
        robot = HardwareRobot(device, tool_name="pan-tilt")
        robot.connect()
        return robot

    for name, make in {"barista": barista.Barista, "own_robot": Recorded, "own_driver": driver}.items():
        report = conform(Subject(make, recorder, name=name))
        assert report.tier is Tier.GOLD, report.words()


def test_limits_without_positions_or_speeds_are_not_proven_and_say_what_to_give() -> None:
    checked = ["platinum.limits"]
    (result,) = conform(replace(subject(Rig), speeds={}), Tier.PLATINUM, only=checked).results
    assert (result.mark, "Subject(speeds={'pan': 45.0})" in result.said) == (CheckMark.NOT_PROVEN, True)

    class WithoutPositions(Rig):
        def write(self, angle: float) -> None:
            self.recorder.wrote("angle")
            self.angle = angle

    (result,) = conform(subject(WithoutPositions), Tier.PLATINUM, only=checked).results
    assert (result.mark, "recorder.wrote(" in result.said) == (CheckMark.NOT_PROVEN, True)


def test_joint_that_is_sent_to_its_end_by_one_write_is_faster_than_it_says() -> None:
    class Jumps(Rig):
        goes = True

        def step(self) -> None:
            """Go to the other end at once, and stay there for the rest of the motion."""
            if self.goes:
                self.goes = False
                self.write(-LIMIT if self.angle > 0 else LIMIT)

        def stop_task(self) -> Any:
            answer = super().stop_task()
            self.goes = True
            return answer

    (result,) = conform(replace(subject(Jumps), speeds={"angle": 1.0}), Tier.PLATINUM, only=["platinum.limits"]).results
    assert (result.mark, "1 is declared" in result.said) == (CheckMark.DRIFT, True), result.said


def test_read_has_the_time_that_it_declares_and_no_more() -> None:
    class Scans(Rig):
        @verb(motion=False, lasts=5.0)
        def scan(self) -> int:
            """Scan the room."""
            time.sleep(0.6)
            return 1

    class ScansWithoutSayingSo(Rig):
        @verb(motion=False)
        def scan(self) -> int:
            """Scan the room."""
            time.sleep(0.6)
            return 1

    for kind, mark in {Scans: CheckMark.PASSED, ScansWithoutSayingSo: CheckMark.FAILED}.items():
        (result,) = conform(replace(subject(kind), answer_s=0.3), only=["bronze.reads"]).results
        assert result.mark is mark, result.said


FAULTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "IgnoresHalt": (("silver.halts",), ()),
    "KeepsItsSpeed": (("silver.halts",), ()),
    "WritesAfterTheVerdict": (("silver.halts",), ()),
    "BlocksInItsStop": (("silver.halts", "silver.unlinked"), ()),
    "RaisesInItsStop": (("silver.halts", "silver.unlinked"), ()),
    "AnswersItsStopWithText": (("silver.halts", "silver.unlinked"), ()),
    "AnswersInAnUnknownShape": (("bronze.status", "silver.halts", "silver.unlinked"), ()),
    "SaysMovingForEver": (("bronze.status", "silver.halts", "silver.unlinked"), ()),
    "DropsTheSecondStop": (("silver.again",), ()),
    "IgnoresItsPermit": (("silver.verbs",), ()),
    "StopsUnderTheLockOfItsReads": (("silver.hung_read",), ()),
    "MovesWhileLocked": (("silver.lockout",), ()),
    "SaysStoppedOnAHungBus": (("silver.honest",), ()),
    "IsDeadAfterABusError": (("silver.honest",), ("gold.recovers",)),
    "HangsInItsStatus": (("gold.reads",), ("gold.events",)),
    "LiesThatItIsIdle": (("gold.reads",), ("gold.events", "silver.lockout")),
    "IsReadUnderTheLockOfItsMotion": (("gold.reads",), ()),
    "LeaksThreads": (("gold.starts",), ()),
    "LeaksFiles": (("gold.starts",), ()),
    "HoldsTheInterpreter": (("gold.threads_run",), ()),
    "TakesNaN": (("bronze.domains",), ()),
    "ChangesItsFeatures": (("bronze.features",), ()),
    "LacksItsFeatures": (("bronze.features",), ()),
    "HasUndeclaredJoints": (("bronze.features",), ()),
    "ReadsNaN": (("bronze.features",), ()),
    "RaisesInARead": (("bronze.reads",), ("gold.reads", "gold.own_verbs")),
    "AnswersWhatJsonCannotCarry": (("bronze.reads",), ("gold.reads", "gold.own_verbs")),
    "StopsSlowly": (("platinum.estop",), ()),
    "MovesBeyondItsLimit": (("platinum.limits",), ()),
    "MovesFasterThanItSays": (("platinum.limits",), ()),
    "WritesNaN": (("platinum.limits",), ()),
    "KeepsItsKeyOpen": (("platinum.signed",), ()),
    "WritesIntoTheAudit": (("platinum.audit",), ()),
}
"""Checks that find each fault, and those that it may also fail."""


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found_by_its_check_and_by_no_wrong_one(fault: str) -> None:
    report = conform(subject(getattr(faulty_robots, fault)), Tier.PLATINUM)
    found, also = FAULTS[fault]
    failed = {each.check for each in report.failed}
    assert set(found) <= failed, report.words()
    assert failed <= {*found, *also}, report.words()
