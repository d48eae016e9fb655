"""The scheduler of a peer's periodic jobs."""

from __future__ import annotations

import threading

from fixtures.mesh_robots import World
from fixtures.waiting import eventually
from tests.mesh.peers import Clock, Fleet

from strands_robots.mesh.core import Mesh
from strands_robots.mesh.scheduler import Scheduler


def test_missed_deadlines_are_dropped_not_caught_up() -> None:
    clock, runs = Clock(), []
    scheduler = Scheduler("test", clock)
    scheduler.every("job", 10, lambda: runs.append(clock()), quick=True)
    scheduler.run_due(clock())
    clock.pass_(1.05)
    scheduler.run_due(clock())
    scheduler.run_due(clock())
    assert len(runs) == 2
    clock.pass_(0.1)
    scheduler.run_due(clock())
    assert len(runs) == 3


def test_wedged_read_delays_no_presence_and_stop_names_its_thread() -> None:
    release, beats = threading.Event(), []
    scheduler = Scheduler("wedged")
    scheduler.every("bus", 100, lambda: release.wait(20) and None)
    scheduler.every("presence", 100, lambda: beats.append(1), quick=True)
    scheduler.start()
    eventually(lambda: len(beats) > 5)
    assert "wedged-sampler" in scheduler.stop(0.05)
    eventually(lambda: "wedged-timer" not in [thread.name for thread in threading.enumerate()])
    release.set()


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
    mesh: Mesh = peers.join(World("left"), "leaver", "sim")
    console = peers.join(None, "console")
    console.ping("leaver")

    def ours() -> list[str]:
        return [each.name for each in threading.enumerate() if "leaver" in each.name and "halt" not in each.name]

    assert ours()
    mesh.stop()
    eventually(lambda: not ours())
