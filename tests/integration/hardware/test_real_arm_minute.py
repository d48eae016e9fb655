"""A minute at 50 Hz under LeRobot's driver, asked for over Device Connect, its state read and told all the while."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from fixtures.feetech_bus import MOTORS, write_calibration
from fixtures.feetech_bus.process import BusProcess
from fixtures.waiting import free_port

from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.robot import Robot

pytestmark = pytest.mark.system

MINUTE_S = 60.0
HZ = 50.0
RATE_SHARE = 0.05
"""Of all steps, on a machine that does other things; benchmarks/ measures the rate."""
READ_EVERY_S = 0.1


def test_every_step_of_a_minute_reaches_every_servo_while_the_state_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute")
    calibration, link = write_calibration(tmp_path / "calibration.json"), loopback_config(free_port())
    with BusProcess(tmp_path / "arm") as bus:
        arm = Robot("so101", mode="real", port=bus.port, calibration=calibration, calibration_dir=tmp_path)
        runtime = init_device_connect_sync(arm, peer_id="arm-1", link=link)
        try:
            with FleetClient(link, "tester") as fleet:
                bus.forget()
                asked = fleet.call("arm-1", "execute", {"instruction": "wave", "duration": MINUTE_S})
                assert asked["status"] == "success", asked
                ends, reads = time.monotonic() + MINUTE_S + 40, 0
                while fleet.call("arm-1", "getStatus")["task_status"] == "running":
                    assert time.monotonic() < ends, "the task did not end in its time"
                    state = fleet.call("arm-1", "getState")
                    assert state["status"] == "success", state
                    assert set(state["joints"]) == {f"{motor}.pos" for motor in MOTORS}
                    reads += 1
                    time.sleep(READ_EVERY_S)
            status = arm.get_task_status()
        finally:
            stop_device_connect(runtime)
            arm.cleanup()
        assert status["task_status"] == "completed", status
        assert reads > 20
        assert status["step_count"] >= RATE_SHARE * HZ * MINUTE_S
        goals = bus.written_after()
    for servo in range(1, len(MOTORS) + 1):
        written = sum(each.servo == servo for each in goals)
        # Each step once, and the holds at the end of the task and at the cleanup.
        assert written == status["step_count"] + 2
