"""A real robot's tasks, reads and stops, over devices that record, wedge and fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fixtures.bodies import LoadingPolicy, ScriptedPolicy
from fixtures.devices import BlindDevice, FailingDevice, RecordingDevice, WedgingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots import policies
from strands_robots.contract import RolloutEvent, TaskRobot
from strands_robots.envelope import error
from strands_robots.hardware import HardwareRobot
from strands_robots.hardware import body as bodies
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.utils import ValidationError

WAVES = {"pan.pos": (0.0, 50.0, 1.0), "lift.pos": (0.0, 50.0, 1.0), "grip.pos": (50.0, 40.0, 1.0)}


def make(device: RecordingDevice | None = None, name: str = "arm", hz: float = 200) -> HardwareRobot:
    robot = HardwareRobot(device or RecordingDevice(), name, control_hz=hz)
    robot.connect()
    return robot


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = make()
    yield made
    made.cleanup()


def test_it_fits_the_contract_as_it_is(robot: HardwareRobot) -> None:
    assert isinstance(robot, TaskRobot)


def test_a_task_starts_returns_at_once_and_completes(robot: HardwareRobot) -> None:
    events: list[RolloutEvent] = []
    looked = threading.Event()

    def hear(event: RolloutEvent) -> None:
        events.append(event)
        assert looked.wait(20)

    robot.subscribe(hear)
    assert robot.get_task_status()["task_status"] == "idle"
    started = robot.start_task("wave", duration=0.2)
    assert started["status"] == "success"
    assert robot.get_task_status()["task_status"] == "running"
    looked.set()
    # Its last event comes after its state.
    eventually(lambda: events[-1].kind == "finished")
    status = robot.get_task_status()
    assert (status["task_status"], status["instruction"], status["policy"]) == ("completed", "wave", "mock")
    assert status["step_count"] == sum(event.kind == "step" for event in events) >= 1
    assert 0.2 <= status["duration"] < 20
    assert [events[0].kind, events[-1].kind, events[-1].state] == ["started", "finished", "completed"]


def test_run_task_waits_for_the_end(robot: HardwareRobot) -> None:
    assert robot.run_task("wave", duration=0.1)["task_status"] == "completed"


def test_a_second_task_is_refused_and_the_first_is_named(robot: HardwareRobot) -> None:
    robot.start_task("fold the towel", duration=30)
    refused = robot.start_task("wave")
    assert refused["status"] == "error"
    assert "fold the towel" in refused["reason"]


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("instruction", ""),
        ("instruction", "x" * 2001),
        ("instruction", "a\x00b"),
        ("instruction", 5),
        ("duration", float("nan")),
        ("duration", 0),
        ("duration", -1),
        ("duration", True),
        ("duration", "5"),
        ("duration", 1e9),
        ("policy_port", 65536),
        ("policy_port", True),
        ("policy_provider", "mok"),
        ("policy_provider", None),
    ],
)
def test_an_argument_out_of_its_domain_is_refused_by_name_and_nothing_moves(
    robot: HardwareRobot, argument: str, value: Any
) -> None:
    refused = robot.start_task(**{"instruction": "wave", argument: value})
    assert refused["status"] == "error"
    assert argument in refused["reason"]
    assert robot.device.writes == []


def test_a_device_that_is_not_connected_is_not_moved() -> None:
    robot = HardwareRobot(RecordingDevice(), "arm")
    assert "not connected" in robot.start_task("wave")["reason"]


def test_stop_task_freezes_the_robot_and_says_so(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 5)
    answer = robot.stop_task()
    verdict = time.monotonic()
    assert answer["stopped"] is True
    assert robot.get_task_status()["task_status"] == "stopped"
    still = dict(robot.device.positions)
    assert robot.device.writes[-1].action == still
    assert not robot.device.written_after(verdict)
    assert robot.stop_task()["was_running"] is False


def test_a_stop_of_a_loop_that_outlives_it_says_stopped_false(
    robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    thinks, go_on = threading.Event(), threading.Event()

    def think() -> dict[str, float]:
        thinks.set()
        go_on.wait(60)
        return {"pan.pos": 99.0}

    # The policy has not returned by then; the bus has frozen the robot long before.
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "2")
    thinking = ScriptedPolicy([{"pan.pos": 5.0}], always=think)
    monkeypatch.setattr(policies, "policy_factory", lambda name: lambda: thinking)
    robot.start_task("think")
    assert thinks.wait(20)
    answer = robot.stop_task()
    assert (answer["status"], answer["stopped"]) == ("error", False)
    verdict = robot.halt()
    assert verdict.stopped is False
    assert "has not returned" in verdict.not_stopped["task"]
    go_on.set()
    eventually(lambda: robot.get_task_status()["task_status"] == "stopped")
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    assert all(write.action.get("pan.pos") != 99.0 for write in robot.device.writes)
    assert robot.halt().stopped is True


@pytest.mark.parametrize("stop", ["halt", "stop_task"])
def test_a_stop_while_a_policy_loads_says_stopped_at_once_and_it_never_moves_the_robot(
    robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch, stop: str
) -> None:
    loading = LoadingPolicy()
    monkeypatch.setattr(policies, "policy_factory", lambda name: lambda: loading)
    robot.start_task("wave")
    assert loading.loads.wait(20)
    answer = getattr(robot, stop)()
    assert (answer.stopped if stop == "halt" else answer["stopped"]) is True
    assert not loading.loaded.is_set()
    loading.loaded.set()
    eventually(lambda: robot.get_task_status()["task_status"] == "stopped")
    assert all(write.action.get("pan.pos") != 99.0 for write in robot.device.writes)


def test_an_emergency_stop_of_a_policy_that_does_not_return_is_stopped_once_the_robot_is_frozen_and_locked(
    robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    thinks, go_on = threading.Event(), threading.Event()

    def think() -> dict[str, float]:
        thinks.set()
        go_on.wait(60)
        return {"pan.pos": 99.0}

    thinking = ScriptedPolicy([{"pan.pos": 5.0}], always=think)
    monkeypatch.setattr(policies, "policy_factory", lambda name: lambda: thinking)
    with own_plane(20.0) as plane:
        plane.register("arm", robot)
        robot.start_task("think")
        assert thinks.wait(20)
        report = plane.emergency_stop(StopOrder(new_epoch(), "safety-1"))["arm"]
        assert (report.stopped, report.verdict.halted) == (True, ("task",))
        assert robot.device.writes[-1].action == robot.device.positions, "frozen"
        go_on.set()
        eventually(lambda: robot.get_task_status()["task_status"] == "stopped")
    assert all(write.action.get("pan.pos") != 99.0 for write in robot.device.writes)


def test_after_the_verdict_of_a_halt_nothing_is_written() -> None:
    robot = make(hz=1000)
    for _ in range(20):
        robot.start_task("wave")
        count = len(robot.device.writes)
        eventually(lambda count=count: len(robot.device.writes) > count + 3)
        verdict = robot.halt("test")
        moment = time.monotonic()
        assert verdict.stopped is True
        assert verdict.halted == ("task",)
        assert robot.device.writes[-1].action == robot.device.positions, "the last write is the hold"
        eventually(lambda: robot.get_task_status()["task_status"] != "running")
        assert not robot.device.written_after(moment)
    assert robot.device.overlaps == 0


def test_a_halt_of_a_robot_that_stands_still_is_stopped(robot: HardwareRobot) -> None:
    verdict = robot.halt()
    assert (verdict.stopped, verdict.halted) == (True, ())


def test_a_wedged_bus_is_reported_within_the_deadline_and_frozen_when_it_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    device = WedgingDevice()
    robot = make(device, "wedging")
    robot.start_task("wave")
    eventually(lambda: device.writes)
    device.wedge(60)
    assert device.wedged.wait(20)
    verdicts = [robot.halt("test"), robot.halt("again")]
    for verdict in verdicts:
        assert verdict.stopped is False
        assert "no answer in 0.3 s" in verdict.not_stopped["task"]
    assert verdicts[0].elapsed_ms < 20_000, "and the bus hangs for longer"
    freezing = [thread for thread in threading.enumerate() if thread.name == "halt-wedging"]
    assert len(freezing) == 1, "a second halt waits for the first attempt"
    written = len(device.writes)
    device.release()
    eventually(lambda: robot.get_task_status()["task_status"] == "stopped")
    eventually(lambda: len(device.writes) == written + 2)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    assert device.writes[-1].action == device.positions, "the write in flight, then the hold"
    assert robot.halt().stopped is True
    robot.cleanup()


def test_a_wedged_bus_of_an_idle_robot_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot = make()
    held, free = threading.Event(), threading.Event()

    def hog() -> None:
        with robot.body().lock:
            held.set()
            free.wait(60)

    thread = threading.Thread(target=hog)
    thread.start()
    assert held.wait(20)
    assert robot.halt().stopped is None
    free.set()
    thread.join()


def test_a_failing_device_ends_the_task_in_error_and_on_hold() -> None:
    device = FailingDevice(good=3)
    robot = make(device)
    answer = robot.run_task("wave", duration=60)
    assert answer["status"] == "error"
    assert "Failed to sync write" in answer["reason"]
    assert robot.get_task_status()["task_status"] == "error"
    assert len(device.writes) == 4
    assert device.writes[-1].action == device.writes[-2].action


def test_a_write_that_failed_twice_does_not_end_the_task() -> None:
    device = FailingDevice(good=3, failures=2)
    answer = make(device).run_task("wave", duration=60, n_steps=10)
    assert answer["status"] == "success", answer
    assert answer["step_count"] == 10


def test_joints_are_read_while_the_camera_fails() -> None:
    robot = make(BlindDevice())
    state = robot.get_state()
    assert state["joints"] == {"pan.pos": 10.0, "lift.pos": 10.0, "grip.pos": 10.0}
    assert state["task"]["task_status"] == "idle"
    assert "joints_error" not in state
    assert robot.run_task("wave", duration=0.1)["task_status"] == "completed"
    with pytest.raises(TimeoutError):
        robot.get_observation()


@contextmanager
def hogged(robot: HardwareRobot) -> Iterator[threading.Event]:
    """Somebody has the bus until the event is set, or the block is left."""
    held, free = threading.Event(), threading.Event()

    def hog() -> None:
        with robot.body().lock:
            held.set()
            free.wait(60)

    thread = threading.Thread(target=hog)
    thread.start()
    assert held.wait(20)
    try:
        yield free
    finally:
        free.set()
        thread.join()


def test_a_state_read_waits_at_most_a_control_period_for_the_bus_of_a_robot_that_is_led(robot: HardwareRobot) -> None:
    assert robot.get_state()["joints_age_s"] < 20
    robot.start_task("wave")
    with hogged(robot):
        eventually(lambda: "joints_error" in robot.get_state())
        state = robot.get_state()
    assert state["status"] == "success"
    assert "busy for 0.005 s" in state["joints_error"]
    assert "pan.pos" in state["joints"]


def test_a_state_read_of_a_robot_that_nothing_drives_waits_for_its_turn(
    robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hogged(robot) as free, monkeypatch.context() as patient:
        patient.setattr(bodies, "IDLE_WAIT_S", 20.0)
        threading.Timer(0.2, free.set).start()
        state = robot.get_state()
    assert "joints_error" not in state
    assert state["joints"]["pan.pos"] == 10.0
    with hogged(robot):
        assert "busy for 1 s" in robot.get_state()["joints_error"]


def test_a_state_read_that_gets_the_bus_gives_it_to_a_stop_that_waits(robot: HardwareRobot) -> None:
    robot.get_state()
    halter = threading.Thread(target=robot.halt)
    # Re-entrant: the read below gets its turn while the stop waits for this one to end.
    with robot.body().lock:
        halter.start()
        eventually(lambda: robot.body().stop_waits)
        reads = robot.device.reads
        state = robot.get_state()
        assert robot.device.reads == reads
    halter.join()
    assert "A stop waits" in state["joints_error"]
    assert state["joints"]["pan.pos"] == 10.0
    eventually(lambda: not robot.body().stop_waits)


def test_send_action_says_what_was_really_sent_and_clamps(robot: HardwareRobot) -> None:
    assert robot.send_action({"pan.pos": 500.0})["sent"] == {"pan.pos": 100.0}
    for bad in ({"pan.pos": float("nan")}, {"elbow": 1.0}, {"pan.pos": True}, None, [1]):
        assert robot.send_action(bad)["status"] == "error"  # type: ignore[arg-type]
    assert len(robot.device.writes) == 1


def test_send_action_is_refused_while_a_task_runs(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    assert "driven by the task 'wave'" in robot.send_action({"pan.pos": 0.0})["reason"]


class Locked:
    def refusal(self, verb: str) -> dict[str, Any]:
        return error(f"{verb} is refused: locked.")


def test_a_locked_robot_refuses_every_motion(robot: HardwareRobot) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    robot.gate.attach(Locked())
    for answer in (robot.start_task("wave"), robot.send_action({"pan.pos": 0.0}), robot.teleoperate()):
        assert "locked" in answer["reason"]
    assert robot.device.writes == []
    assert robot.halt().stopped is True
    assert robot.get_state()["joints"]


def test_features_are_data(robot: HardwareRobot) -> None:
    features = robot.get_features()
    assert features["action_features"]["pan.pos"] == "float"
    assert features["ranges"]["grip.pos"] == [0.0, 100.0]
    assert make(BlindDevice()).get_features()["observation_features"]["front"] == [480, 640, 3]


def test_cleanup_halts_and_disconnects(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    assert robot.cleanup()["status"] == "success"
    assert not robot.device.is_connected


@pytest.mark.parametrize("device", [None, object(), "arm"])
def test_what_is_no_device_is_refused_by_what_it_lacks(device: object) -> None:
    with pytest.raises(ValidationError, match="send_action"):
        HardwareRobot(device)


@pytest.mark.parametrize(
    "options",
    [
        {"control_hz": 0},
        {"control_hz": float("nan")},
        {"tool_name": ""},
        {"stop_level": "drop"},
        {"stop_level": "release"},
        {"joint_ranges": {"elbow": (0, 1)}},
        {"joint_ranges": {"pan.pos": (1, 0)}},
        {"joint_ranges": {"pan.pos": 5}},
        {"joint_ranges": {"pan.pos": (0, float("nan"))}},
    ],
    ids=str,
)
def test_an_option_out_of_its_domain_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        HardwareRobot(RecordingDevice(), **options)


def test_a_velocity_is_held_at_zero() -> None:
    device = RecordingDevice()
    device.positions = {"x.vel": 0.3, "lift.pos": 5.0}
    robot = make(device)
    assert robot.halt().stopped is True
    assert device.writes[-1].action == {"x.vel": 0.0, "lift.pos": 5.0}
