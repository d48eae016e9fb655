"""Real arms on Device Connect: driven by a caller, stopped in motion, and named where they cannot be stopped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus, arm_servos, write_calibration
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.robot import Robot
from strands_robots.safety.estop_listener import estop_listener

pytestmark = pytest.mark.system

DEAF_S = 8.0
"""Seconds that an arm is waited for."""

STOPPED_S = 0.75 * DEAF_S
"""From the controller's call to an arm's last byte: less than a deaf arm is waited for; benchmarks/ measures it."""

MOVE = {"instruction": "wave", "duration": 100.0}


class Bench:
    """Two emulated arms on the network, a caller that may move them, and a controller that stops them."""

    def __init__(self, folder: Path, stop_level: str) -> None:
        self.stop_level = stop_level
        link = loopback_config(free_port())
        calibration = write_calibration(folder / "calibration.json")
        self.buses = [FeetechBus(arm_servos(), link=folder / f"arm{number}") for number in (1, 2)]
        self.robots: list[Any] = []
        self.runtimes: list[Any] = []
        self.fleet = FleetClient(link, "tester").__enter__()
        self.controller = safety_controller("safety-1", link)
        try:
            self._serve(folder, calibration, link)
        except BaseException:
            self.close()
            raise

    def _serve(self, folder: Path, calibration: Path, link: LinkConfig) -> None:
        for number, bus in enumerate(self.buses, start=1):
            bus.plug()
            options: dict[str, Any] = {"port": bus.port, "calibration": calibration, "calibration_dir": folder}
            robot = Robot("so101", mode="real", tool_name=f"arm-{number}", stop_level=self.stop_level, **options)
            self.robots.append(robot)
            self.runtimes.append(init_device_connect_sync(robot, peer_id=f"arm-{number}", link=link))
        assert self.controller.wait_link(40)
        eventually(lambda: all(each.link.up for each in estop_listener().registrations))

    def move(self) -> None:
        for name in ("arm-1", "arm-2"):
            answer = self.fleet.call(name, "execute", MOVE)
            assert answer["status"] == "success", answer
        eventually(lambda: all(robot.get_task_status()["step_count"] > 10 for robot in self.robots))

    def close(self) -> None:
        self.controller.close()
        self.fleet.close()
        for runtime in self.runtimes:
            stop_device_connect(runtime)
        for robot in self.robots:
            robot.cleanup()
        for bus in self.buses:
            bus.unplug()


@pytest.fixture(params=["hold", "release"])
def bench(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute")
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", str(DEAF_S))
    made = Bench(tmp_path, request.param)
    yield made
    made.close()


def test_an_emergency_stop_in_motion_stops_the_bytes_and_locks_the_arms(bench: Bench) -> None:
    bench.move()
    called = time.monotonic()
    report = bench.controller.stop(["arm-1", "arm-2"], "test", deadline_s=20)
    at = time.monotonic()
    assert report.ok, report
    time.sleep(0.2)
    for bus in bench.buses:
        last = bus.writes[-1].at
        assert called < last <= at, "the report comes after the last byte"
        assert last - called <= STOPPED_S
        assert [servo.torque for servo in bus.servos.values()] == [bench.stop_level == "hold"] * 6
    refused = bench.fleet.call("arm-1", "execute", MOVE)
    assert refused["status"] == "error"
    assert report.estop_id in refused["reason"]
    state = bench.fleet.call("arm-1", "getState")
    assert state["status"] == "success"
    assert len(state["joints"]) == 6


def test_a_wedged_bus_is_named_and_the_other_arm_stops(bench: Bench) -> None:
    bench.move()
    bench.buses[0].wedge(60)
    called = time.monotonic()
    report = bench.controller.stop(["arm-1", "arm-2"], "test", deadline_s=20)
    assert set(report.not_stopped) | set(report.silent) == {"arm-1"}
    assert set(report.stopped) == {"arm-2"}
    time.sleep(0.2)
    assert bench.buses[1].writes[-1].at - called <= STOPPED_S, "nobody waits for the arm that is deaf"
    bench.buses[0].release()


def test_a_plain_stop_halts_and_leaves_it_free(bench: Bench) -> None:
    bench.move()
    assert bench.fleet.stop("arm-1")["status"] == "success"
    at = time.monotonic()
    time.sleep(0.1)
    assert bench.buses[0].written_after(at) == []
    assert bench.robots[1].get_task_status()["task_status"] == "running"
    assert bench.fleet.call("arm-1", "execute", {"instruction": "on", "duration": 0.2})["status"] == "success"


def test_the_example_drives_the_whole_way_and_draws_it(tmp_path: Path) -> None:
    picture = tmp_path / "path.png"
    ours = {"STRANDS_DC_PORT": str(free_port()), "STRANDS_STATE_DIR": str(tmp_path), "PICTURE": str(picture)}
    root = Path(__file__).resolve().parents[3]
    line = [sys.executable, "-m", "fixtures.feetech_bus.patient", "examples.real_arm_on_a_pty"]
    done = subprocess.run(
        line, cwd=root, env={**os.environ, **ours}, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "0 after the agent's stop" in done.stdout
    assert picture.stat().st_size > 10_000


def test_serve_puts_a_real_arm_on_the_network(tmp_path: Path) -> None:
    calibration, port = write_calibration(tmp_path / "calibration.json"), free_port()
    with FeetechBus(arm_servos(), link=tmp_path / "arm") as bus:
        arm = {"calibration": calibration, "calibration_dir": tmp_path}
        words = [word for key, value in arm.items() for word in ("--set", f"{key}={value}")]
        words += [
            "--port",
            bus.port,
            "--peer-id",
            "arm-7",
            "--rpc-allow",
            "tester",
            "--command-allow",
            "execute",
            "--port",
            str(port),
        ]
        command = [sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli"]
        line = [*command, "serve", "so101", *words]
        process = subprocess.Popen(
            [*line, "--json", "--until-stdin-closes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "STRANDS_STATE_DIR": str(tmp_path)},
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert json.loads(process.stdout.readline())["event"] == "serving"
            with FleetClient(loopback_config(port), "tester") as fleet:
                assert fleet.call("arm-7", "execute", MOVE)["status"] == "success"
                eventually(lambda: fleet.call("arm-7", "getStatus")["step_count"] > 10)
                assert fleet.stop("arm-7")["status"] == "success"
            process.stdin.close()
            assert process.wait(60) == 0
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
        assert not any(servo.torque for servo in bus.servos.values()), "LeRobot lets go when it disconnects"
