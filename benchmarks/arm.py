"""A real arm's driver on emulated servos: our control loop beside LeRobot's own calls in a plain loop, in the same run.

Runs in the environment of ``make real-arm``, ``.venv-lerobot``, wherever it is asked for.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fixtures.feetech_bus import Write, write_calibration
from fixtures.feetech_bus.process import BusProcess
from fixtures.waiting import eventually, free_port

from benchmarks.arm_leading import leading
from benchmarks.table import Row
from strands_robots.device_connect import LinkConfig, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.robot import Robot
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.plane import plane

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".venv-lerobot" / "bin" / "python"
ROWS = """
import dataclasses, json, benchmarks.arm
print(json.dumps([dataclasses.asdict(row) for row in benchmarks.arm.run(quick={quick})]))
"""

HZ = 50.0
SECONDS, SECONDS_QUICK = 60.0, 10.0
TURN_S = 5.0
STOPS, STOPS_QUICK = 20, 3
STATE_HZ = 10.0
JITTER_MS = 1.0
LAST_WRITE_MS = 20.0
RATE_SHARE = 0.98


def run(*, quick: bool = False) -> list[Row]:
    """Every row of this part; the one that says so where LeRobot's driver is not installed."""
    if importlib.util.find_spec("lerobot") is None:
        return elsewhere(quick=quick)
    # The lockouts of these stops are none of the user's.
    with (
        tempfile.TemporaryDirectory(prefix="bench-state-") as state,
        patch.dict(os.environ, {"STRANDS_STATE_DIR": state}),
    ):
        rows = [jitter(SECONDS_QUICK if quick else SECONDS), last_write(STOPS_QUICK if quick else STOPS)]
        return rows + leading(quick=quick)


def elsewhere(*, quick: bool) -> list[Row]:
    """The rows as the environment with LeRobot's driver measures them."""
    if not PYTHON.exists():
        return [Row("a real arm's driver", "not measured: make real-arm first", "", None, "", ok=True)]
    done = subprocess.run(
        [str(PYTHON), "-c", ROWS.format(quick=quick)], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    )
    return [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]


@contextmanager
def arm() -> Iterator[tuple[BusProcess, Any]]:
    """An arm on an emulated bus, whose servos take no interpreter time from what is measured here."""
    with tempfile.TemporaryDirectory(prefix="bench-arm-") as folder, BusProcess(Path(folder) / "arm") as bus:
        calibration = write_calibration(Path(folder) / "calibration.json")
        robot = Robot("so101", mode="real", port=bus.port, calibration=calibration, calibration_dir=folder)
        try:
            yield bus, robot
        finally:
            robot.cleanup()


@contextmanager
def served(robot: Any) -> Iterator[LinkConfig]:
    """The robot on the network, which reads and publishes its state."""
    link = loopback_config(free_port())
    runtime = init_device_connect_sync(robot, peer_id="arm-1", link=link)
    try:
        yield link
    finally:
        stop_device_connect(runtime)


def jitter(seconds: float) -> Row:
    """Jitter of a rollout's writes while its state is read, beside a plain loop.

    Both take turns of a few seconds, so that what else the machine does meets both.
    """
    turns = max(2, round(seconds / TURN_S))
    plain: list[float] = []
    ours: list[float] = []
    lost = steps = 0
    with arm() as (bus, robot):
        for turn in range(2 * turns):
            # Plain, ours, ours, plain: neither has the better half of a turn.
            if turn % 4 in (0, 3):
                bus.forget()
                lost += plain_loop(robot.device, TURN_S)
                plain += strays(bus.written_after())
            else:
                bus.forget()
                steps += ours_loop(robot, TURN_S)
                ours += strays(bus.written_after())
    mine, bare = percentile(ours), percentile(plain)
    return Row(
        what=f"jitter of the writes at 50 Hz, p99 of {turns * TURN_S:.0f} s, with 10 Hz getState and publishing",
        ours=f"{mine:.2f} ms, {steps} steps",
        against=f"{bare:.2f} ms, LeRobot's calls in a plain loop, {lost} beats lost",
        ratio=mine / bare,
        must=f"at most {JITTER_MS:g} ms more, {RATE_SHARE * HZ:g} steps a second or more",
        ok=mine <= bare + JITTER_MS and steps >= RATE_SHARE * HZ * TURN_S * turns,
    )


def ours_loop(robot: Any, seconds: float) -> int:
    """A rollout of so long on the network, its state read ten times a second; the steps that it took."""
    with served(robot), reading(robot.get_state):
        started = robot.start_task("wave", duration=seconds)
        assert started["status"] == "success", started
        eventually(lambda: robot.get_task_status()["task_status"] != "running", within=seconds + 30)
    status = robot.get_task_status()
    assert status["task_status"] == "completed", status
    return int(status["step_count"])


def last_write(stops: int) -> Row:
    """From the controller's call to the last byte that a servo was told anything by."""
    took = []
    with arm() as (bus, robot), served(robot) as link:
        controller = safety_controller("safety-1", link)
        try:
            assert controller.wait_link(10)
            eventually(lambda: all(each.link.up for each in estop_listener().registrations), within=10)
            for _ in range(stops):
                plane().clear_local("the benchmark")
                robot.start_task("wave", duration=30.0)
                eventually(lambda: robot.get_task_status()["step_count"] > 10)
                called = time.monotonic()
                report = controller.stop(["arm-1"], "benchmark")
                assert report.ok, report
                time.sleep(0.1)
                took.append((bus.last_write() - called) * 1000)
        finally:
            controller.close()
    took.sort()
    return Row(
        what=f"from the controller's call to the last write at a servo, {stops} stops in motion",
        ours=f"p50 {took[len(took) // 2]:.1f} ms, worst {took[-1]:.1f} ms",
        against="nothing to compare: LeRobot has no stop",
        ratio=None,
        must=f"worst at most {LAST_WRITE_MS:g} ms",
        ok=took[-1] <= LAST_WRITE_MS,
    )


def plain_loop(device: Any, seconds: float) -> int:
    """Run LeRobot's own loop (read, act, wait for the next beat) and return the lost beats."""
    lost, began = 0, time.monotonic()
    for beat in range(int(seconds * HZ)):
        try:
            device.send_action({key: float(value) for key, value in device.get_observation().items()})
        except ConnectionError:
            # LeRobot gives a beat up where a servo, or a busy machine, takes longer than 50 ms.
            device.bus.port_handler.ser.reset_input_buffer()
            lost += 1
        time.sleep(max(0.0, began + (beat + 1) / HZ - time.monotonic()))
    return lost


def strays(writes: list[Write]) -> list[float]:
    """Deviations of the gaps between the first servo's goals from the period, ms; the final hold is no beat."""
    times = [write.at for write in writes if write.servo == 1]
    return [abs(after - before - 1 / HZ) * 1000 for before, after in pairwise(times[:-1])]


def percentile(gaps: list[float]) -> float:
    """The 99th."""
    return sorted(gaps)[int(len(gaps) * 0.99)]


@contextmanager
def reading(read: Callable[[], object]) -> Iterator[None]:
    """Call ``read`` ten times a second on a thread of its own."""
    ended = threading.Event()

    def loop() -> None:
        while not ended.wait(1 / STATE_HZ):
            read()

    reader = threading.Thread(target=loop, name="reader", daemon=True)
    reader.start()
    yield
    ended.set()
    reader.join()
