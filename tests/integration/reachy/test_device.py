"""Reachy Mini on Device Connect: its functions, refusals, stops and status."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.reachy_daemon.process import Daemon
from fixtures.waiting import eventually, free_port
from tests.integration.reachy.conftest import finished

from strands_robots.device_connect import (
    FleetClient,
    ReachyMiniDriver,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.client import DeviceEvent
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.safety import ed25519
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.resume import sign
from strands_robots.safety.stopping import StopVerdict

Call = Callable[..., dict[str, Any]]
MOTIONS = ("look", "antennas", "body", "nod", "shake", "happy", "wakeUp", "sleep", "enableMotors", "disableMotors")


@pytest.fixture
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "1")


@pytest.fixture
def fleet() -> Iterator[FleetClient]:
    with FleetClient(loopback_config(free_port()), "tester") as client:
        yield client


@pytest.fixture
def device(daemon: Daemon, fleet: FleetClient) -> Iterator[ReachyMiniDriver]:
    # The stand-in's Zenoh twin has a port of its own, so that tests may run beside a real daemon.
    reachy = ReachyDriver("127.0.0.1", api_port=daemon.port, zenoh_port=daemon.zenoh_port)
    driver = ReachyMiniDriver(robot=reachy)
    runtime = init_device_connect_sync(driver, peer_id="head-1", link=fleet.link)
    yield driver
    stop_device_connect(runtime)


@pytest.fixture
def call(device: ReachyMiniDriver, fleet: FleetClient) -> Call:
    eventually(lambda: device.reachy.is_connected, what="the daemon")
    return lambda function, **params: fleet.call("head-1", function, params)


@pytest.mark.usefixtures("allowed")
def test_look_takes_degrees_and_millimetres(call: Call, device: ReachyMiniDriver) -> None:
    assert call("look", pitch=0, yaw=0)["status"] == "success"
    answer = call("look", pitch=10, roll=-5, yaw=15, x=5, z=-4)
    assert answer["status"] == "success"
    assert answer["target"]["head_pitch"] == pytest.approx(0.17453, abs=1e-4)
    assert answer["target"]["head_x"] == pytest.approx(0.005)

    def looks_there() -> bool:
        error = device.reachy.facts()["head_error_rad"]
        return error is not None and error < 0.1

    eventually(looks_there, what="it looks there")
    assert call("antennas", left=20, right=-20)["status"] == "success"
    assert call("body", yaw=10)["status"] == "success"


@pytest.mark.usefixtures("allowed")
@pytest.mark.parametrize(
    ("function", "params", "reason"),
    [
        ("look", {"pitch": 41}, "pitch (degrees) must be a finite number from -40 to 40, not 41"),
        ("look", {"roll": True}, "roll (degrees) must be a finite number from -40 to 40, not True"),
        ("look", {"yaw": "left"}, "not 'left'"),
        ("look", {"x": 26}, "x (mm) must be a finite number from -25 to 25, not 26"),
        ("look", {"z": -31}, "z (mm) must be a finite number from -30 to 15, not -31"),
        ("look", {"pitch": 40, "roll": 30}, "together be at most 60 degrees, not 70"),
        ("antennas", {"left": 181}, "left (degrees) must be a finite number from -180 to 180"),
        ("body", {"yaw": 161}, "yaw (degrees) must be a finite number from -160 to 160"),
        ("enableMotors", {"motor_ids": ","}, "motor_ids must name motors"),
        ("disableMotors", {"motor_ids": "17,tail"}, "motor_ids must name motors"),
        ("playMove", {"move_name": "../yes1"}, "move_name must be"),
        ("playMove", {"move_name": "yes1", "library": "songs"}, "library must be one of emotions, dances"),
        ("listMoves", {"library": ""}, "library must be one of emotions, dances"),
        ("nod", {"times": 3}, "nod takes no parameters"),
    ],
)
def test_value_out_of_its_domain_is_refused_by_name(
    call: Call, device: ReachyMiniDriver, function: str, params: dict[str, Any], reason: str
) -> None:
    sent = device.reachy.motions.frames_sent
    answer = call(function, **params)
    assert answer["status"] == "error"
    assert reason in answer["reason"]
    assert device.reachy.motions.frames_sent == sent


@pytest.mark.usefixtures("allowed")
def test_gesture_returns_at_once_and_stop_motion_ends_it(
    call: Call, device: ReachyMiniDriver, fleet: FleetClient
) -> None:
    events: list[DeviceEvent] = []
    with fleet.subscription("head-1", events.append):
        assert call("shake")["status"] == "success"
        eventually(lambda: device.reachy.motions.frames_sent > 3, what="frames")
        answer = call("stopMotion")
        sent = device.reachy.motions.frames_sent
        assert (answer["stopped"], answer["halted"]) == (True, ["shake"])
        eventually(lambda: any(event.name == "motionComplete" for event in events), what="motionComplete")
    assert device.reachy.motions.frames_sent == sent
    ended = next(event for event in events if event.name == "motionComplete")
    assert (ended.payload["name"], ended.payload["state"]) == ("shake", "stopped")


@pytest.mark.usefixtures("allowed")
def test_wake_up_recorded_move_and_sleep_complete(call: Call, device: ReachyMiniDriver, daemon: Daemon) -> None:
    if daemon.kind.simulation == "mujoco":
        pytest.skip("its motors cannot be switched off")

    assert call("disableMotors")["motor_mode"] == "disabled"
    assert "the motors are disabled" in call("nod")["reason"]
    assert call("wakeUp")["motor_mode"] == "enabled"
    assert finished(device.reachy)["state"] == "completed"
    assert sorted(call("listMoves")["moves"]) == ["no1", "yes1"]
    assert call("playMove", move_name="yes1")["move"] == "yes1"
    assert finished(device.reachy)["state"] == "completed"
    assert "unknown" in call("listMoves", library="dances")["reason"]
    assert call("sleep")["status"] == "success"
    assert finished(device.reachy) == {"name": "sleep", "state": "completed", "detail": ""}
    assert call("getStatus")["motor_mode"] == "disabled"


def test_caller_without_permission_can_only_stop_and_read(
    call: Call, device: ReachyMiniDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    for function in MOTIONS:
        assert call(function)["status"] == "error", function
    assert "DEVICE_CONNECT_RPC_ALLOW" in call("playMove", move_name="yes1")["reason"]
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    for function in ("stopMotion", "getStatus", "getDaemonStatus", "getJoints", "listMoves"):
        assert call(function)["status"] == "success", function
    assert device.reachy.motions.frames_sent == 0


def test_status_reports_link_version_state_and_fresh_joints(call: Call, daemon: Daemon) -> None:
    status = call("getStatus")
    assert status["link"] == ("zenoh" if daemon.kind.zenoh else "websocket")
    assert status["version"] == daemon.kind.version
    assert (status["daemon_state"], status["motor_mode"], status["locked"]) == ("running", "enabled", False)
    assert status["data_age_s"] < 1.5
    daemon_status = call("getDaemonStatus")
    assert (daemon_status["status"], daemon_status["version"]) == ("success", daemon.kind.version)
    joints = call("getJoints")
    assert len(joints["joints"]) == 9
    assert joints["age_s"] < 1.5


@pytest.mark.usefixtures("allowed")
def test_own_emergency_stop_locks_halts_and_releases_the_motors(
    call: Call, device: ReachyMiniDriver, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.reachy.release_on_estop = True
    locked: list[bool] = []
    halt = device.reachy.motions.halt

    def halted(reason: str) -> StopVerdict:
        locked.append(device.reachy.gate.lockout("motion") is not None)
        return halt(reason)

    monkeypatch.setattr(device.reachy.motions, "halt", halted)
    call("shake")
    asyncio.run(device.emergencyStop(reason="test"))
    eventually(lambda: locked)
    assert locked[0], "it locks before it halts"
    motion = device.reachy.motions.current
    assert motion is not None
    eventually(lambda: motion.facts()["state"] == "stopped")
    assert call("getStatus")["locked"] is True
    for function in MOTIONS:
        assert call(function)["status"] == "error", function
    if daemon.kind.simulation != "mujoco":
        eventually(lambda: daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"})


@pytest.mark.usefixtures("allowed")
def test_emergency_stop_halts_and_locks_until_a_signed_resume(
    call: Call, device: ReachyMiniDriver, daemon: Daemon, fleet: FleetClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    operator = Ed25519PrivateKey.generate()
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(ed25519.public_half(operator)))
    controller = safety_controller("safety-1", fleet.link)
    try:
        eventually(
            lambda: controller.link_up and all(each.link.up for each in estop_listener().registrations), what="the lane"
        )
        call("wakeUp")
        report = controller.stop(["head-1"], "test")
        assert report.ok, report
        assert daemon.running_moves() == []
        sent = device.reachy.motions.frames_sent
        for function in MOTIONS:
            assert report.estop_id in call(function)["reason"], function
        assert "releaseTorque works while it is locked" in call("disableMotors")["reason"]
        assert call("getStatus")["motor_mode"] == "enabled"
        assert call("getJoints")["status"] == "success"
        assert call("getStatus")["locked"] is True
        (assertion,) = sign(operator, report.estop_id, ["head-1"])
        assert call("resume", assertion=assertion)["locked"] is False
        assert device.reachy.motions.frames_sent == sent
        assert call("nod")["status"] == "success"
    finally:
        controller.close()


@pytest.fixture
def stopped(call: Call, fleet: FleetClient) -> Iterator[Callable[[], Any]]:
    """Stops the fleet, this robot in it; gives the report."""
    controller = safety_controller("safety-1", fleet.link)
    eventually(
        lambda: controller.link_up and all(each.link.up for each in estop_listener().registrations), what="the lane"
    )
    yield lambda: controller.stop(["head-1"], "test")
    controller.close()


@pytest.mark.usefixtures("allowed")
def test_a_fleets_stop_releases_the_motors_of_a_robot_that_was_told_to(
    call: Call, device: ReachyMiniDriver, daemon: Daemon, stopped: Callable[[], Any]
) -> None:
    if daemon.kind.simulation == "mujoco":
        pytest.skip("its motors cannot be switched off")
    device.reachy.release_on_estop = True
    call("shake")
    assert call("stopMotion")["stopped"] is True
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "enabled"}, "a plain stop holds"
    report = stopped()
    assert report.ok, report
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"}


def test_torque_is_released_under_lockout_only_with_the_operators_approval(
    call: Call, daemon: Daemon, stopped: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    if daemon.kind.simulation == "mujoco":
        pytest.skip("its motors cannot be switched off")
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    assert stopped().ok
    assert "strands-robots grant releaseTorque@head-1" in call("releaseTorque")["reason"]
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "enabled"}
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "releaseTorque@head-1")
    answer = call("releaseTorque")
    assert (answer["status"], answer["verified"], len(answer["released"])) == ("success", True, 9)
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"}
    assert call("releaseTorque", motor_ids="17")["released"] == ["right_antenna"]
    assert "motor_ids must name motors" in call("releaseTorque", motor_ids="tail")["reason"]
    assert call("getStatus")["locked"] is True


def test_device_without_its_daemon_is_unavailable_and_still_answers(fleet: FleetClient) -> None:
    driver = ReachyMiniDriver("127.0.0.1", api_port=free_port())
    runtime = init_device_connect_sync(driver, peer_id="head-2", link=fleet.link)
    try:
        eventually(lambda: "Connection refused" in str(driver.status.error_state), what="the reason")
        assert driver.status.availability == "unavailable"
        status = fleet.call("head-2", "getStatus", {})
        assert status["connected"] is False
        assert "Connection refused" in status["unavailable"]
        assert fleet.call("head-2", "getJoints", {})["status"] == "error"
        assert "did not answer" in fleet.call("head-2", "getDaemonStatus", {})["reason"]
        assert fleet.call("head-2", "stopMotion", {})["stopped"] is None, "nobody could ask the daemon"
        peer = next(peer for peer in fleet.peers(20) if peer.id == "head-2")
        assert peer.status["availability"] == "unavailable"
    finally:
        stop_device_connect(runtime)
