"""Physics: our stepping against a plain loop, and thirty-two arms in real time in one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

import mujoco
import psutil

from benchmarks.table import Row
from strands_robots.simulation import Simulation
from strands_robots.simulation.catalog import find
from strands_robots.simulation.stage import Plan, RobotPlan, compile_stage

STEPS = 10_000
FLEET = 32
PUBLISH_HZ = 10


def run(*, quick: bool = False) -> list[Row]:
    """Every row of this part."""
    return [stepping(2 if quick else 7), fleet(4.0 if quick else 15.0)]


def stepping(repeats: int) -> Row:
    """``Simulation.step(10_000)`` and a Python loop of ``mj_step`` on the same model, in turn; medians."""
    simulation = Simulation(realtime=False)
    simulation.add_robot("arm", "so100")
    plain = compile_stage(Plan(robots=(RobotPlan("arm", find("so100")),)))
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
    """Worlds of one arm each, a rollout of 50 Hz in each, every state read 10 times a second."""
    process = psutil.Process()
    memory = process.memory_info().rss
    worlds = [Simulation(f"arm-{i}") for i in range(FLEET)]
    for world in worlds:
        world.add_robot("so100")
    for i, world in enumerate(worlds):
        world.start_policy("so100", f"wave {i}", duration=seconds + 60)
    done = threading.Event()
    reader = threading.Thread(target=publish, args=(worlds, done))
    reader.start()
    time.sleep(1.0)
    before = [moment(world) for world in worlds]
    began, cpu = time.monotonic(), process.cpu_times()
    time.sleep(seconds)
    real, spent = time.monotonic() - began, process.cpu_times()
    after = [moment(world) for world in worlds]
    used = (spent.user + spent.system - cpu.user - cpu.system) / real
    rows = [row for world in worlds for row in world.list_policies_running()]
    rate = min(row["step"] / row["elapsed_s"] for row in rows)
    grown = (process.memory_info().rss - memory) / 1e6
    done.set()
    reader.join()
    for world in worlds:
        world.cleanup()
    pairs = zip(before, after, strict=True)
    factor = min((later.sim_time - sooner.sim_time) / (later.at - sooner.at) for sooner, later in pairs)
    return Row(
        f"{FLEET} simulated arms in one process, a 50 Hz rollout each, published at {PUBLISH_HZ} Hz: real-time factor",
        f"{factor:.3f} (slowest arm), {rate:.0f} actions/s each, {100 * used / FLEET:.2f} % of a core "
        f"and {grown / FLEET:.2f} MB per robot",
        "real time, 1.0",
        factor,
        ">= 1.0, to a thousandth",
        round(factor, 3) >= 1.0,
    )


class Moment(NamedTuple):
    """Simulated and real time, seconds, at the same instant."""

    sim_time: float
    at: float


def moment(world: Simulation) -> Moment:
    """The clocks just after the pacing thread has visited ``world``: its ticks are not part of the measurement."""
    first = world.get_state()["sim_time"]
    while (now := world.get_state()["sim_time"]) == first:
        time.sleep(0.0002)
    return Moment(now, time.monotonic())


def publish(worlds: list[Simulation], done: threading.Event) -> None:
    while not done.wait(1 / PUBLISH_HZ):
        for world in worlds:
            world.get_state()


def timed(work: Callable[[], object]) -> float:
    """Seconds that ``work`` takes."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
