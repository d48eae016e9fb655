"""The driver on every daemon: stand-in, mock-up, MuJoCo, and one with Zenoh."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import pytest
from fixtures.reachy_daemon.process import Daemon
from fixtures.waiting import eventually
from tests.integration.reachy.conftest import Connect, finished

from strands_robots.drivers.reachy import ReachyDriver, connection
from strands_robots.drivers.reachy.target import HeadPose, Target
from strands_robots.safety.gate import MotionRefused


def test_link_follows_the_version_and_not_the_badge(daemon: Daemon, reachy: ReachyDriver) -> None:
    facts = reachy.facts()
    assert facts["link"] == ("zenoh" if daemon.kind.zenoh else "websocket")
    assert facts["version"] == daemon.kind.version
    assert facts["connected"] and facts["daemon_state"] == "running" and facts["motor_mode"] == "enabled"
    assert reachy.get_joints()["age_s"] < 1.5


def test_distant_target_is_reached_by_a_ramp_in_the_background(reachy: ReachyDriver) -> None:
    reachy.go(Target(HeadPose(), 0.0, (-0.17, 0.17)))
    finished(reachy)
    answer = reachy.go(Target(HeadPose(pitch=0.3, yaw=0.4), 0.2, (0.8, -0.8)), "look")
    assert answer["ramp"] is True
    assert reachy.facts()["moving"] == "look"
    assert finished(reachy)["state"] == "completed"

    def arrived() -> bool:
        seen = reachy.get_observation()
        return abs(seen["antenna_right"] - 0.8) < 0.1 and abs(seen["body_yaw"] - 0.2) < 0.1

    eventually(arrived, what="antennas and body there")

    def head_error() -> float:
        error = reachy.facts()["head_error_rad"]
        return math.inf if error is None else error

    eventually(lambda: head_error() < 0.1, what="head there")


def test_action_is_cut_to_one_frames_step_and_returned_as_sent(reachy: ReachyDriver) -> None:
    reachy.go(Target(antennas=(0.0, 0.0)))
    finished(reachy)
    assert reachy.send_action({"antenna_left": 1.0})["antenna_left"] == pytest.approx(0.3)
    assert reachy.send_action({"antenna_left": 1.0})["antenna_left"] == pytest.approx(0.6)
    eventually(lambda: abs(reachy.get_observation()["antenna_left"] - 0.6) < 0.1, what="there")


def test_wake_up_enables_the_motors_and_arrives_upright(daemon: Daemon, reachy: ReachyDriver) -> None:
    daemon.request("POST", "/api/motors/set_mode/disabled")
    assert reachy.wake_up()["motor_mode"] == "enabled"
    assert finished(reachy) == {"name": "wakeUp", "state": "completed", "detail": ""}


def test_sleep_ends_with_the_motors_off(daemon: Daemon, reachy: ReachyDriver) -> None:
    reachy.sleep()
    end = finished(reachy)
    if daemon.kind.simulation == "mujoco":
        # MuJoCo's backend has no torque, which the driver must report.
        assert end["detail"] == "the motors are enabled"
        return
    assert end == {"name": "sleep", "state": "completed", "detail": ""}
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"}
    with pytest.raises(MotionRefused, match="motors are disabled"):
        reachy.gesture("nod")


@pytest.mark.parametrize("gesture", ["nod", "shake", "happy"])
def test_gesture_returns_at_once_and_runs_to_its_end(reachy: ReachyDriver, gesture: str) -> None:
    reachy.gesture(gesture)
    assert reachy.facts()["moving"] == gesture
    assert finished(reachy) == {"name": gesture, "state": "completed", "detail": ""}


def test_halt_ends_a_gesture_and_no_frame_follows(reachy: ReachyDriver) -> None:
    reachy.gesture("shake")
    eventually(lambda: reachy.motions.frames_sent > 5, what="frames")
    verdict = reachy.halt("test")
    sent = reachy.motions.frames_sent
    assert verdict.stopped is True
    assert verdict.halted == ("shake",)
    assert finished(reachy)["state"] == "stopped"
    time.sleep(0.1)
    assert reachy.motions.frames_sent == sent


def test_halt_stops_a_move_of_the_daemon(daemon: Daemon, reachy: ReachyDriver) -> None:
    reachy.wake_up()
    assert len(daemon.running_moves()) == 1
    verdict = reachy.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("moves of the daemon",))
    assert daemon.running_moves() == []
    assert finished(reachy)["state"] == "stopped"


def test_halt_stops_the_moves_of_other_clients(daemon: Daemon, reachy: ReachyDriver) -> None:
    for antenna in (1.0, -1.0):
        daemon.request("POST", "/api/move/goto", json={"antennas": [antenna, antenna], "duration": 60.0})
    eventually(lambda: reachy.facts()["foreign_moves"] == 2, what="both moves are reported")
    assert reachy.halt("test").halted == ("moves of the daemon",)
    assert daemon.running_moves() == []


def test_new_move_stops_the_one_before_it(daemon: Daemon, reachy: ReachyDriver) -> None:
    reachy.wake_up()
    first = reachy.motions.current
    assert first is not None
    reachy.gesture("nod")
    assert first.facts() == {"name": "wakeUp", "state": "stopped", "detail": "replaced by nod"}
    assert daemon.running_moves() == []
    reachy.wake_up()
    assert len(daemon.running_moves()) == 1
    reachy.catalogue.names("emotions")
    reachy.halt("test")


def test_concurrent_callers_leave_at_most_one_move(daemon: Daemon, reachy: ReachyDriver) -> None:
    refused: list[str] = []

    def once(verb: Callable[[], object]) -> None:
        try:
            verb()
        except MotionRefused as exc:
            refused.append(str(exc))

    verbs = (reachy.wake_up, reachy.sleep, reachy.wake_up) * 2
    callers = [threading.Thread(target=once, args=(verb,)) for verb in verbs]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(40)
        assert not caller.is_alive()
    # On a busy machine a sleep may end, with the motors off, before the next caller starts.
    assert all("motors are disabled" in reason for reason in refused)
    assert len(daemon.running_moves()) <= 1
    assert reachy.halt("test").stopped
    assert daemon.running_moves() == []


def test_recorded_move_plays_and_an_unknown_one_is_refused(reachy: ReachyDriver) -> None:
    assert sorted(reachy.catalogue.names("emotions")["moves"]) == ["no1", "yes1"]
    assert reachy.catalogue.play("yes1", "emotions")["move"] == "yes1"
    assert "no move 'nope'" in reachy.catalogue.play("nope", "emotions")["reason"]
    assert finished(reachy)["name"] == "yes1"


def test_uncached_library_is_unknown_and_not_empty(reachy: ReachyDriver) -> None:
    answer = reachy.catalogue.names("dances")
    assert answer["status"] == "error"
    assert answer["reason"].startswith("The catalogue of dances is unknown")
    assert "moves" not in answer


def test_uncached_library_is_not_requested_while_the_robot_moves(reachy: ReachyDriver) -> None:
    reachy.gesture("nod")
    assert "could freeze its daemon" in reachy.catalogue.play("x1", "dances")["reason"]
    assert finished(reachy)["state"] == "completed"


def test_emergency_stop_keeps_or_releases_torque_and_reports_which(daemon: Daemon, reachy: ReachyDriver) -> None:
    reachy.gesture("nod")
    kept = reachy.emergency_stop("test")
    assert (kept["stopped"], kept["torque"], kept["halted"]) == (True, "held", ["nod"])
    released = reachy.emergency_stop("test", release=True)
    if daemon.kind.simulation == "mujoco":
        assert "Torque was not released" in released["reason"]
        return
    assert released["torque"] == "released"
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"}


def test_torque_of_single_motors_is_reported_as_unverified(reachy: ReachyDriver) -> None:
    answer = reachy.motors.torque(True, "17, stewart_1", "enableMotors")
    assert answer["motors"] == ["right_antenna", "stewart_1"]
    assert answer["verified"] is False


def test_imu_is_read_on_a_wireless_and_reported_missing_elsewhere(daemon: Daemon, reachy: ReachyDriver) -> None:
    if not daemon.kind.wireless:
        assert reachy.get_imu()["reason"] == "This Reachy Mini has no IMU."
        return
    eventually(lambda: reachy.get_imu()["status"] == "success", what="a sample")
    imu = reachy.get_imu()
    assert imu["accelerometer"] == [0.0, 0.0, 9.81]
    assert imu["age_s"] < 1.5


def test_locked_robot_refuses_every_motion(reachy: ReachyDriver) -> None:
    class Locked:
        def refusal(self, verb: str) -> dict[str, object]:
            return {"status": "error", "reason": f"{verb} refused: locked"}

    reachy.gate.attach(Locked())
    for verb in (
        lambda: reachy.gesture("nod"),
        reachy.wake_up,
        reachy.sleep,
        lambda: reachy.go(Target(HeadPose(yaw=0.1))),
        lambda: reachy.send_action({"head_yaw": 0.1}),
        lambda: reachy.catalogue.play("yes1", "emotions"),
        lambda: reachy.motors.torque(True, "", "enableMotors"),
    ):
        with pytest.raises(MotionRefused, match="locked"):
            verb()


def test_two_drivers_on_one_robot_see_and_stop_one_another(
    daemon: Daemon, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Waking up takes less than two seconds; a driver that polls once a second may miss most of it.
    monkeypatch.setattr(connection, "POLL_EVERY_S", 0.1)
    one, two = connect(), connect()

    def seen() -> bool:
        if one.motions.current is None or not one.motions.current.running:
            one.wake_up()
        return bool(two.facts()["foreign_moves"] == 1)

    eventually(seen, what="the other's move is seen")
    two.gesture("nod")
    assert daemon.running_moves() == []
    first = one.motions.current
    assert first is not None
    eventually(first.done.is_set, what="the first driver notices")
    assert (first.state, first.detail) == ("stopped", "another client stopped it")


def test_no_frame_is_sent_after_disconnect(reachy: ReachyDriver) -> None:
    reachy.gesture("shake")
    reachy.disconnect()
    sent = reachy.motions.frames_sent
    with pytest.raises(MotionRefused, match="disconnected"):
        reachy.go(Target(HeadPose(yaw=0.1)))
    time.sleep(0.1)
    assert reachy.motions.frames_sent == sent


def test_target_out_of_reach_is_not_sent(reachy: ReachyDriver) -> None:
    before = reachy.motions.frames_sent
    with pytest.raises(ValueError, match="together be at most 60 degrees"):
        reachy.go(Target(HeadPose(pitch=math.radians(40), roll=math.radians(30))))
    assert reachy.motions.frames_sent == before


def test_driver_reconnects_to_a_restarted_daemon(daemon: Daemon, reachy: ReachyDriver) -> None:
    before = reachy.connection.connects
    daemon.request("POST", "/api/daemon/restart")
    if daemon.kind.zenoh:
        # The Zenoh session outlives this by itself: there may be nothing to reconnect.
        state = lambda: daemon.request("GET", "/api/daemon/status").json()["state"]  # noqa: E731
        eventually(lambda: state() != "running", what="it goes down")
        eventually(lambda: state() == "running", what="it is back")
    else:
        eventually(lambda: reachy.connection.connects > before, what="a new link")
    eventually(lambda: reachy.is_connected, what="joint data again")
    reachy.gesture("nod")
    assert finished(reachy)["state"] == "completed"


def test_killed_daemon_is_unavailable_until_it_starts_again(daemon: Daemon, reachy: ReachyDriver) -> None:
    reachy.gesture("shake")
    daemon.kill()
    try:
        eventually(lambda: not reachy.is_connected, what="the loss is noticed")
        with pytest.raises(MotionRefused):
            reachy.gesture("nod")
        assert reachy.get_joints()["status"] == "error"
        verdict = reachy.halt("test")
        assert verdict.stopped is not True
    finally:
        daemon.start()
    eventually(lambda: reachy.is_connected, what="it is back")
    reachy.gesture("nod")
    assert finished(reachy)["state"] == "completed"
