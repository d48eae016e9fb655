"""The scheduler of a peer's periodic jobs."""

from __future__ import annotations

import threading

import pytest
from fixtures.mesh_robots import World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh.core import Mesh
from strands_robots.mesh.scheduler import Job, Scheduler, Timer


def test_missed_deadlines_are_dropped_not_caught_up() -> None:
    job = Job("job", 0.1, list, due=100.0)
    job.skip_to(100.0)
    assert job.due == pytest.approx(100.1)
    job.skip_to(101.25)
    assert job.due == pytest.approx(101.3)


def test_wedged_robot_delays_no_other_and_its_stop_names_what_still_runs() -> None:
    release, beats, read = threading.Event(), list[int](), list[int]()
    wedged, sound = Scheduler("wedged"), Scheduler("sound")
    for name in ("bus", "imu", "odom"):
        wedged.every(name, 100, lambda: release.wait(20) and None, lane=name)
    wedged.every("presence", 100, lambda: beats.append(1), quick=True)
    sound.every("bus", 100, lambda: read.append(1))
    wedged.start()
    sound.start()
    try:
        eventually(lambda: len(beats) > 5)
        eventually(lambda: len(read) > 5)
        assert set(wedged.stop(0.05)) == {"wedged bus", "wedged imu", "wedged odom"}
        read.clear()
        eventually(lambda: len(read) > 5)
    finally:
        release.set()
        assert sound.stop(20) == []


def test_jobs_of_one_lane_never_run_at_once() -> None:
    scheduler, alone, runs = Scheduler("lane"), threading.Lock(), list[bool]()

    def run() -> None:
        runs.append(alone.acquire(blocking=False))
        threading.Event().wait(0.005)
        alone.release()

    for name in ("a", "b", "c"):
        scheduler.every(name, 200, run)
    scheduler.start()
    eventually(lambda: len(runs) > 20)
    assert scheduler.stop(20) == []
    assert all(runs)


def test_threads_end_with_the_last_job_and_do_not_grow_with_the_peers() -> None:
    def ours() -> int:
        return sum(thread.name.startswith("test-timer") for thread in threading.enumerate())

    timer, runs = Timer("test-timer"), list[int]()
    schedulers = [Scheduler(f"peer-{n}", timer) for n in range(50)]
    for each in schedulers:
        each.every("read", 20, lambda: runs.append(1))
        each.every("presence", 20, list, quick=True)
        each.start()
    eventually(lambda: len(runs) > 200)
    eventually(lambda: ours() <= 2)
    for each in schedulers:
        assert each.stop(20) == []
    eventually(lambda: ours() == 0)


def test_failing_job_is_run_again() -> None:
    scheduler, runs = Scheduler("failing"), []

    def fail() -> None:
        runs.append(1)
        raise RuntimeError("no")

    scheduler.every("job", 200, fail)
    scheduler.start()
    eventually(lambda: len(runs) >= 3)
    assert scheduler.stop(20) == []


def test_stopped_mesh_leaves_no_thread(peers: Fleet) -> None:
    before = set(threading.enumerate())
    mesh: Mesh = peers.join(World("left"), "leaver", "sim")
    console = peers.join(None, "console")
    console.send("leaver", {"action": "status"}, timeout=20)

    def ours() -> list[str]:
        new = [each.name for each in set(threading.enumerate()) - before if "halt" not in each.name]
        return [name for name in new if name.startswith("mesh-") or "leaver" in name]

    assert ours()
    mesh.stop()
    console.stop()
    eventually(lambda: not ours())
