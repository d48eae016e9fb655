"""The safety plane: all robots locked at once, halted side by side, and reported by name."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.planes import own_plane
from fixtures.recording_robot import RecordingRobot
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually

from strands_robots.adapted import AdaptedRobot
from strands_robots.audit import read_audit_log
from strands_robots.envelope import is_error
from strands_robots.safety import plane as plane_module
from strands_robots.safety import reporting
from strands_robots.safety.orders import RobotReport, StopOrder, derived_epoch, epoch_of, new_epoch
from strands_robots.safety.persistence import LockoutStore, hardware_key
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.stop_executor import StopExecutor
from strands_robots.safety.stopping import stop_level
from strands_robots.utils import ValidationError

Add = Callable[..., RecordingRobot]


def order(epoch: str = "", source: str = "safety-1", **fields: Any) -> StopOrder:
    return StopOrder(epoch or new_epoch(), source, fields.pop("reason", "smoke"), **fields)


def test_after_the_verdict_no_action_reaches_the_device(plane: SafetyPlane, add: Add) -> None:
    robots = {f"arm-{n}": add(f"arm-{n}", write_s=0.003) for n in range(4)}
    for robot in robots.values():
        robot.start()
    eventually(lambda: all(len(robot.device.times) > 3 for robot in robots.values()))
    given: dict[str, float] = {}
    reports = plane.emergency_stop(order(), lambda report: given.setdefault(report.robot_id, time.monotonic()))
    assert {name: report.stopped for name, report in reports.items()} == dict.fromkeys(robots, True)
    time.sleep(0.05)
    for name, robot in robots.items():
        assert robot.device.times[-1] <= given[name]
        assert reports[name].verdict.halted == ("policy",)
        assert robot.refuses()


def test_every_robot_is_locked_before_any_has_halted(plane: SafetyPlane, add: Add) -> None:
    go = threading.Event()
    robots = [add(f"arm-{n}", before_halt=lambda: go.wait(20)) for n in range(8)]
    run = plane.begin(order())
    assert run is not None
    assert all(robot.refuses() for robot in robots)
    go.set()
    assert run.wait(20)


def test_a_wedged_robot_holds_up_no_other_and_is_named(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "2")
    release = threading.Event()
    wedged = add("wedged", before_halt=lambda: release.wait(60))
    add("well")
    seen: list[RobotReport] = []
    run = plane.begin(order(), seen.append)
    assert run is not None
    eventually(lambda: [each.robot_id for each in seen] == ["well"])
    assert wedged.refuses()
    assert run.wait(20)
    report = run.reports["wedged"]
    assert report.stopped is False
    assert report.verdict.not_stopped == {"wedged": "no answer in 2 s"}
    assert run.reports["well"].stopped is True
    assert run.reports["well"].elapsed_ms < report.elapsed_ms
    release.set()
    late = eventually(lambda: [each for each in seen if each.late])
    assert (late[0].robot_id, late[0].stopped) == ("wedged", True)


def test_a_robot_wedged_in_one_stop_is_asked_again_by_the_next(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = threading.Event()
    robot = add("wedged", before_halt=lambda: release.wait(60))
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    assert plane.emergency_stop(order())["wedged"].stopped is False
    assert plane.emergency_stop(order())["wedged"].stopped is False
    eventually(lambda: len(robot.halts) == 2)
    release.set()
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    assert plane.emergency_stop(order())["wedged"].stopped is True


def test_a_wedged_robot_is_reported_where_no_thread_can_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = threading.Event()

    def start(thread: threading.Thread) -> None:
        if full.is_set():
            raise RuntimeError("can't start new thread")
        thread.start()

    release = threading.Event()
    with own_plane(0.3, executor=StopExecutor(start)) as plane:
        plane.register("wedged", RecordingRobot(before_halt=lambda: release.wait(60)))
        full.set()
        try:
            for _ in range(2):
                assert plane.emergency_stop(order())["wedged"].stopped is False
            eventually(lambda: "wedged is stuck in its halt and no other thread can halt it" in caplog.text)
            assert "can't start new thread" in caplog.text
        finally:
            release.set()
            # The executor's watcher outlives this test, and is to find threads.
            full.clear()


@pytest.mark.parametrize(
    ("answer", "stopped"),
    [
        ({"status": "error", "reason": "bus is gone"}, False),
        (RuntimeError("bus is gone"), False),
        ({"odd": 1}, None),
        (None, None),
        ({"status": "success"}, True),
    ],
)
def test_each_answer_of_a_halt_is_graded(plane: SafetyPlane, add: Add, answer: object, stopped: bool | None) -> None:
    robot = add()

    def halt(reason: str = "") -> Any:
        if isinstance(answer, Exception):
            raise answer
        return answer

    robot.halt = halt  # type: ignore[method-assign]
    assert plane.emergency_stop(order())["arm-1"].stopped is stopped
    assert robot.refuses()


def test_second_arrival_of_a_stop_halts_nothing_and_answers_the_same(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    first, epoch = [], new_epoch()
    plane.emergency_stop(order(epoch, path="lane"), first.append)
    again: list[RobotReport] = []
    assert plane.begin(order(epoch, path="runtime"), again.append) is None
    assert len(robot.halts) == 1
    assert (again[0].repeated, again[0].stopped) == (True, True)
    assert again[0].elapsed_ms == first[0].elapsed_ms


def test_arrivals_at_the_same_moment_halt_once(plane: SafetyPlane, add: Add) -> None:
    robot, epoch = add(), new_epoch()
    threads = [threading.Thread(target=plane.emergency_stop, args=(order(epoch),)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(robot.halts) == 1


def test_a_robot_is_stopped_by_its_own_event_like_its_neighbours(plane: SafetyPlane, add: Add) -> None:
    robots = [add("arm-1"), add("arm-2")]
    plane.emergency_stop(order(source="arm-1", remote=True))
    assert all(robot.refuses() and len(robot.halts) == 1 for robot in robots)


def test_its_own_local_stop_stops_everything(plane: SafetyPlane, add: Add) -> None:
    own, other = add("arm-1"), add("arm-2")
    plane.emergency_stop(order(source="arm-1"))
    assert own.refuses()
    assert other.refuses()


def test_the_reason_reaches_the_robot(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    plane.emergency_stop(order(reason="smoke in cell 3"))
    assert robot.reasons == ["smoke in cell 3"]


def test_each_stop_is_in_the_audit_with_its_verdict_and_its_timing(plane: SafetyPlane, add: Add) -> None:
    add(key=hardware_key("so101", "usb-1"))
    now = time.time()
    for issued in (None, now, now - 3600, now + 3600):
        plane.emergency_stop(order(remote=True, path="lane", issued=issued))
    records = eventually(lambda: len(all_ := read_audit_log()) == 4 and all_)
    assert {each["event"] for each in records} == {"remote_estop_engaged"}
    assert [each["payload"]["timing"] for each in records] == ["untimed", "on time", "late", "ahead"]
    assert all(each["payload"]["stopped"] and each["payload"]["persisted"] for each in records)
    assert records[0]["payload"]["source"] == "safety-1"


def test_a_lockout_survives_the_process_and_so_does_the_memory_of_its_id(plane: SafetyPlane, add: Add) -> None:
    key, epoch = hardware_key("so101", "usb-1"), new_epoch()
    add(key=key)
    report = plane.emergency_stop(order(epoch))["arm-1"]
    assert report.persisted is True
    with own_plane(20.0) as after:
        robot = RecordingRobot()
        permit = robot.gate.permit("start")
        entry = after.register("arm-1", robot, key=key)
        assert robot.refuses()
        assert not permit.valid
        assert entry.epochs == (epoch,)
        assert after.emergency_stop(order(epoch)) == {}
    assert robot.reasons == ["it comes up locked"]


def test_a_robot_that_leaves_while_its_halt_is_under_way_comes_back_locked(plane: SafetyPlane) -> None:
    key, epoch, halted = hardware_key("so101", "usb-1"), new_epoch(), threading.Event()
    entry = plane.register("arm-1", RecordingRobot(before_halt=lambda: halted.wait(20)), key=key)
    plane.begin(order(epoch))
    threading.Timer(0.2, halted.set).start()
    entry.close()
    again = plane.register("arm-1", RecordingRobot(), key=key)
    assert again.epochs == (epoch,)
    again.close()


def test_a_simulation_without_a_name_is_not_kept(plane: SafetyPlane, add: Add) -> None:
    add()
    assert plane.emergency_stop(order())["arm-1"].persisted is None
    assert LockoutStore().load_all() == {}


def test_a_lockout_that_cannot_be_written_is_still_reported(
    plane: SafetyPlane, add: Add, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = add(key="k")
    monkeypatch.setenv("STRANDS_STATE_DIR", "/proc/nowhere")
    report = plane.emergency_stop(order())["arm-1"]
    assert (report.stopped, report.persisted) == (True, False)
    assert robot.refuses()
    assert "not on the disk" in caplog.text


def test_lockout_and_clearing_that_could_not_be_written_are_written_when_they_can(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(plane_module, "KEEP_AGAIN_S", 0.0)
    add(key="k")
    save, full = plane.store.save, threading.Event()

    def limited(kept: Any) -> None:
        if full.is_set():
            raise OSError(28, "No space left on device")
        save(kept)

    monkeypatch.setattr(plane.store, "save", limited)
    for locked in (True, False):
        full.set()
        if locked:
            assert plane.emergency_stop(order())["arm-1"].persisted is False
        else:
            plane.clear_local("ann")
        assert LockoutStore().load("k").state.locked is not locked
        full.clear()
        eventually(lambda locked=locked: LockoutStore().load("k").state.locked is locked)
    kept = eventually(
        lambda: len(all_ := [each for each in read_audit_log() if each["event"] == "lockout_kept"]) == 2 and all_
    )
    assert [bool(each["payload"]["epochs"]) for each in kept] == [True, False]
    assert "is written now" in caplog.text


def test_lockout_that_a_slow_disk_keeps_after_the_report_is_reported_again(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "KEEP_S", 0.05)
    add(key="k")
    save, slow = plane.store.save, threading.Event()

    def waiting(kept: Any) -> None:
        assert slow.wait(60)
        save(kept)

    monkeypatch.setattr(plane.store, "save", waiting)
    epoch, seen = new_epoch(), list[RobotReport]()
    plane.emergency_stop(order(epoch), seen.append)
    slow.set()
    eventually(lambda: len(seen) == 2)
    assert [(each.persisted, each.late) for each in seen] == [(False, False), (True, True)]
    plane.begin(order(epoch), seen.append)
    assert (seen[-1].persisted, seen[-1].repeated) == (True, True)


def test_a_stop_that_was_resumed_and_comes_again_is_not_said_to_have_stopped(plane: SafetyPlane, add: Add) -> None:
    robot, epoch = add(), new_epoch()
    assert plane.emergency_stop(order(epoch))["arm-1"].stopped is True
    plane.clear_local("ann")
    robot.start()
    seen: list[RobotReport] = []
    assert plane.begin(order(epoch), seen.append) is None
    assert [each.stopped for each in seen] == [None]
    assert plane.emergency_stop(order(epoch))["arm-1"].stopped is None
    assert robot.moving


def test_an_id_resumed_before_comes_again_and_is_answered_without_a_halt(plane: SafetyPlane, add: Add) -> None:
    robot, epoch = add(), new_epoch()
    plane.robots["arm-1"].latch.engage(epoch, "s", "")
    plane.robots["arm-1"].latch.resume(epoch)
    seen: list[RobotReport] = []
    plane.begin(order(epoch), seen.append)
    assert robot.halts == []
    assert "resumed" in str(seen[0].verdict.unknown)


@pytest.mark.parametrize(("word", "level"), [("", "hold"), ("hold", "hold"), ("LIMP", "limp"), ("off", "hold")])
def test_the_stop_level_is_hold_unless_limp_was_chosen(monkeypatch: pytest.MonkeyPatch, word: str, level: str) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", word)
    assert stop_level() == level


def test_the_name_of_another_robot_is_refused_and_the_same_robot_is_shared(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    assert plane.register("arm-1", robot) is plane.robots["arm-1"]
    with pytest.raises(ValidationError, match="arm-1"):
        plane.register("arm-1", RecordingRobot())
    entry = plane.robots["arm-1"]
    entry.close()
    assert "arm-1" in plane.robots
    entry.close()
    assert plane.robots == {}


def test_a_second_network_that_brings_a_key_brings_the_lockout_kept_under_it(plane: SafetyPlane, add: Add) -> None:
    epoch = new_epoch()
    add("arm-1", key="k")
    plane.emergency_stop(order(epoch))
    plane.robots["arm-1"].close()
    robot = add("arm-1")
    assert not robot.refuses()
    entry = plane.register("arm-1", robot, key="k")
    assert robot.refuses()
    assert entry.epochs == (epoch,)
    entry.close()


def test_a_robot_wrapped_anew_for_its_second_network_is_locked_by_both_gates(plane: SafetyPlane) -> None:
    class Foreign:
        tool_name_str = "foreign"

        def __getattr__(self, name: str) -> Any:
            if name in ("start_task", "stop_task", "get_task_status", "get_features"):
                return lambda *_: {"status": "success"}
            raise AttributeError(name)

    foreign = Foreign()
    one, two = AdaptedRobot(foreign), AdaptedRobot(foreign)
    plane.register("arm-1", one)
    plane.register("arm-1", two)
    permits = [one.gate.permit("x"), two.gate.permit("x")]
    plane.emergency_stop(order())
    assert not any(permit.valid for permit in permits)
    assert all(is_error(robot.start_task("wave")) for robot in (one, two))
    plane.robots["arm-1"].close()


def test_the_last_robot_out_ends_the_threads() -> None:
    others = set(threading.enumerate())
    here = SafetyPlane()
    entries = [here.register(f"out-{n}", RecordingRobot()) for n in range(3)]
    ours = {thread for thread in threading.enumerate() if thread.name.startswith(("halt-out-", "safety-"))} - others
    assert sorted(thread.name for thread in ours) == [
        "halt-out-0", "halt-out-1", "halt-out-2", "safety-keep", "safety-report",
    ]  # fmt: skip
    for entry in entries:
        entry.close()
    eventually(lambda: not any(thread.is_alive() for thread in ours))


def test_idle_world_shares_the_reserve_and_owns_a_thread_once_it_moves(plane: SafetyPlane) -> None:
    def threads() -> int:
        return sum(thread.name == "halt-world-1" for thread in threading.enumerate())

    world = ToyWorld()
    entry = plane.register("world-1", world)
    assert threads() == 0
    assert plane.emergency_stop(order())["world-1"].stopped is True
    plane.clear_local("ann")
    world.gate.permit("start_policy")
    assert threads() == 1
    assert plane.emergency_stop(order())["world-1"].stopped is True
    entry.close()
    eventually(lambda: not threads())


def test_a_stop_without_robots_is_answered_by_none(plane: SafetyPlane) -> None:
    assert plane.emergency_stop(order()) == {}


def test_a_silent_controller_stops_the_robot_which_says_who(
    add: Add, plane: SafetyPlane, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "20")
    robot = add()
    assert plane.checkin.timeout_s == 20
    # Heard on and on, as it were; only then is the timeout one that passes while the test looks.
    plane.checkin.record("safety-1", time.monotonic() + 3600)
    plane.checkin.timeout_s = 0.3
    time.sleep(0.5)
    assert not robot.refuses()
    plane.checkin.record("safety-1", time.monotonic())
    eventually(lambda: robot.refuses() and bool(robot.reasons))
    assert "safety-1" in robot.reasons[0]
    assert plane.checkin.time_left(time.monotonic()) == 0.0
    assert len(robot.halts) == 1
    plane.clear_local("ann")
    eventually(lambda: len(robot.reasons) == 2)
    assert "no safety controller" in robot.reasons[1]


def test_the_epoch_of_a_stop_is_its_id_or_derived_the_same_on_every_path() -> None:
    epoch = new_epoch()
    assert epoch_of("s", {"estop_id": epoch, "event_id": "e"}, b"") == epoch
    derived = epoch_of("s", {"estop_id": epoch.upper()[:31] + "X", "event_id": "e"}, b"one")
    assert derived == epoch_of("s", {"event_id": "e"}, b"two") == derived_epoch("s", b"e")
    assert derived != epoch_of("t", {"event_id": "e"}, b"one")
    assert epoch_of("s", {}, b"one") != epoch_of("s", {}, b"two")
