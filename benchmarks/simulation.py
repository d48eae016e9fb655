"""Physics: stepping against a plain loop, and 32 arms in real time in a process."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

import mujoco
import psutil
from fixtures.waiting import free_port

from benchmarks.table import Row
from strands_robots import settings
from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.simulation import Simulation
from strands_robots.simulation.model import compile_scene
from strands_robots.simulation.scene import Scene, SceneRobot, find

STEPS = 10_000
FLEET = 32
PUBLISH_HZ = 10

ANNOUNCED_S = 12.0
"""The framework announces every device twice a second for its first ten seconds; the measurement comes after that."""


def run(*, quick: bool = False) -> list[Row]:
    """Measure every row of this part."""
    return [stepping(2 if quick else 7), fleet(4.0 if quick else 15.0)]


def stepping(repeats: int) -> Row:
    """Compare ``Simulation.step(10_000)`` with a loop of ``mj_step`` by medians."""
    simulation = Simulation(realtime=False)
    simulation.add_robot("arm", "so100")
    plain = compile_scene(Scene(robots=(SceneRobot("arm", find("so100")),)))
    data = mujoco.MjData(plain.model)
    data.qpos[:], data.ctrl[:] = plain.start_qpos, plain.start_ctrl

    def loop() -> None:
        for _ in range(STEPS):
            mujoco.mj_step(plain.model, data)

    ours, theirs = [], []
    for _ in range(repeats):
        ours.append(STEPS / timed(lambda: simulation.step(STEPS)))
        theirs.append(STEPS / timed(loop))
    simulation.cleanup()
    ratio = median(ours) / median(theirs)
    return Row(
        f"Simulation.step({STEPS:,})",
        f"{median(ours):,.0f} steps/s",
        f"plain mj_step loop, {median(theirs):,.0f} steps/s",
        ratio,
        ">= 0.95",
        ratio >= 0.95,
    )


def fleet(seconds: float) -> Row:
    """Serve worlds of one arm with a rollout of 50 Hz each, and count their events."""
    usual = settings.raw("STRANDS_DC_STREAM_HZ")
    settings.put("STRANDS_DC_STREAM_HZ", str(PUBLISH_HZ))
    logging.disable(logging.ERROR)
    process, port = psutil.Process(), free_port()
    memory = process.memory_info().rss
    worlds = [Simulation(f"arm-{i}") for i in range(FLEET)]
    runtimes = []
    try:
        for world in worlds:
            world.add_robot("so100")
            runtimes.append(init_device_connect_sync(world, peer_id=world.tool_name_str, link=loopback_config(port)))
        for i, world in enumerate(worlds):
            world.start_policy("so100", f"wave {i}", duration=seconds + 120)
        command = [sys.executable, "-m", "benchmarks.simulation", str(port), str(seconds)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as listener:
            assert listener.stdin is not None
            assert listener.stdout is not None
            listener.stdout.readline()
            time.sleep(ANNOUNCED_S)
            before = [moment(world) for world in worlds]
            began, cpu = time.monotonic(), process.cpu_times()
            listener.stdin.write("go\n")
            listener.stdin.flush()
            received = json.loads(listener.stdout.readline())
            real, spent = time.monotonic() - began, process.cpu_times()
            after = [moment(world) for world in worlds]
        used = (spent.user + spent.system - cpu.user - cpu.system) / real
        rows = [row for world in worlds for row in world.list_policies_running()]
        rate = min(row["step"] / row["elapsed_s"] for row in rows)
        grown = (process.memory_info().rss - memory) / 1e6
    finally:
        for runtime in runtimes:
            stop_device_connect(runtime)
        for world in worlds:
            world.cleanup()
        logging.disable(logging.NOTSET)
        settings.put("STRANDS_DC_STREAM_HZ", usual)
    pairs = zip(before, after, strict=True)
    factor = min((later.sim_time - sooner.sim_time) / (later.at - sooner.at) for sooner, later in pairs)
    slowest = min(received.values()) if len(received) == FLEET else 0.0
    return Row(
        f"{FLEET} simulated arms in one process on Device Connect, a 50 Hz rollout each, each publishing its joints, "
        f"steps and state at {PUBLISH_HZ} Hz: real-time factor",
        f"{factor:.3f} (slowest arm), {rate:.0f} actions/s each, {100 * used / FLEET:.2f} % of a core and "
        f"{grown / FLEET:.2f} MB per robot; {slowest:.1f} observations/s received of the slowest arm",
        "real time, 1.0",
        factor,
        ">= 1.0, to a thousandth",
        round(factor, 3) >= 1.0 and slowest >= 0.9 * PUBLISH_HZ,
    )


def listen(port: int, seconds: float) -> None:
    """Print the observations a second of every arm; run as another process."""
    counts: Counter[str] = Counter()
    with (
        FleetClient(loopback_config(port)) as client,
        client.subscription("*", lambda event: counts.update([event.device] * (event.name == "observationUpdate"))),
    ):
        deadline = time.monotonic() + 30
        while len(counts) < FLEET and time.monotonic() < deadline:
            time.sleep(0.1)
        print("ready", flush=True)
        sys.stdin.readline()
        counts.clear()
        time.sleep(seconds)
        print(json.dumps({device: count / seconds for device, count in counts.items()}), flush=True)


class Moment(NamedTuple):
    """Simulated and real time, seconds, at the same instant."""

    sim_time: float
    at: float


def moment(world: Simulation) -> Moment:
    """Return both clocks just after a visit of the pacing thread to ``world``.

    So the ticks of that thread are not part of the measurement.
    """
    first = world.get_state()["sim_time"]
    while (now := world.get_state()["sim_time"]) == first:
        time.sleep(0.0002)
    return Moment(now, time.monotonic())


def timed(work: Callable[[], object]) -> float:
    """Return the seconds that ``work`` takes."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


if __name__ == "__main__":
    listen(int(sys.argv[1]), float(sys.argv[2]))
