"""The scheduler of a peer's periodic jobs."""

from __future__ import annotations

import threading
from collections import Counter
from itertools import pairwise

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.envelope import Envelope
from strands_robots.mesh.core import Mesh, init_mesh
from strands_robots.mesh.scheduler import Job, JobQueue, Scheduler, Timer
from strands_robots.mesh.topics import BY_NAME, presence
from strands_robots.mesh.transport.memory import MemoryTransport


def test_missed_deadlines_are_dropped_not_caught_up() -> None:
    job = Job("job", 0.1, list, due=100.0)
    job.skip_to(100.0)
    assert job.due == pytest.approx(100.1)
    job.skip_to(101.25)
    assert job.due == pytest.approx(101.3)


def test_peers_that_start_at_once_do_not_read_at_once() -> None:
    jobs = [Job("state", 0.1, list, JobQueue(), Scheduler(f"peer-{n}").phase, 100.0) for n in range(20)]
    for _ in range(2):
        for job in jobs:
            job.skip_to(max(job.due, 100.0))
        due = sorted(job.due for job in jobs)
        assert min(later - earlier for earlier, later in pairwise(due)) > 1 / (BY_NAME["state"].ceiling_hz or 1)


def test_job_whose_pace_rises_runs_at_once_and_once() -> None:
    runs, scheduler = list[int](), Scheduler("peer")
    scheduler.every("state", 0.01, lambda: runs.append(1))
    scheduler.start()
    try:
        eventually(lambda: len(runs) == 1)
        scheduler.pace("state", 0.02, soon=True)
        eventually(lambda: len(runs) == 2)
        scheduler.pace("state", 100.0)
        eventually(lambda: len(runs) > 5)
        scheduler.pace("gone", 100.0, soon=True)
    finally:
        assert scheduler.stop(20) == []


def test_wedged_robot_delays_no_other_and_its_stop_names_what_still_runs() -> None:
    release, beats, read = threading.Event(), list[int](), list[int]()
    wedged, sound = Scheduler("wedged"), Scheduler("sound")
    for name in ("bus", "imu", "odom"):
        wedged.every(name, 100, lambda: release.wait(20) and None, queue=name)
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


def test_beats_go_on_where_the_system_has_no_thread_for_the_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    start, scarce = threading.Thread.start, threading.Event()
    scarce.set()

    def begin(thread: threading.Thread) -> None:
        if scarce.is_set() and thread.name == "scarce-worker":
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", begin)
    beats, read, scheduler = list[int](), list[int](), Scheduler("arm", Timer("scarce"))
    scheduler.every("presence", 100, lambda: beats.append(1), quick=True)
    scheduler.every("bus", 100, lambda: read.append(1))
    scheduler.start()
    eventually(lambda: len(beats) > 20)
    assert not read
    scarce.clear()
    eventually(lambda: read)
    assert scheduler.stop(20) == []


def test_jobs_of_one_queue_never_run_at_once() -> None:
    scheduler, alone, runs = Scheduler("queue"), threading.Lock(), list[bool]()

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


def test_end_of_the_process_begins_no_job_and_waits_for_no_wedged_one(caplog: pytest.LogCaptureFixture) -> None:
    timer, begun, release, left = Timer("end"), threading.Event(), threading.Event(), threading.Event()

    def read() -> None:
        begun.set()
        release.wait(20)
        left.set()
        raise OSError("the session is closed.")

    wedged = Scheduler("wedged", timer)
    wedged.every("state", 100, read)
    wedged.every("presence", 100, lambda: None, quick=True)
    wedged.start()
    assert begun.wait(20)
    timer.end()
    assert not left.is_set()
    begun.clear()
    release.set()
    assert wedged.stop(20) == []
    assert left.is_set()
    assert not begun.is_set()
    assert not caplog.records


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


class Reads(Arm):
    """An arm whose reads wait for ``release``."""

    def __init__(self, name: str, release: threading.Event) -> None:
        super().__init__(name)
        self.release = release
        self.asked = threading.Event()

    def get_state(self) -> Envelope:
        self.asked.set()
        self.release.wait(20)
        return super().get_state()

    get_task_status = get_state


def test_further_robots_of_a_process_share_its_threads_and_a_blocked_one_delays_no_beat(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    free, release = threading.Event(), threading.Event()
    free.set()
    beats, watcher = Counter[str](), MemoryTransport()
    watcher.connect()
    watcher.declare_subscriber(presence("*"), lambda sample: beats.update([sample.key.split("/")[1]]))

    def ours() -> int:
        return sum(each.name.startswith("mesh-") for each in threading.enumerate())

    def all_beat(*names: str) -> bool:
        return all(beats[name] >= 3 for name in names)

    robots = [init_mesh(Reads(f"arm-{n}", free), f"arm-{n}") for n in range(10)]
    names = [f"arm-{n}" for n in range(10)]
    blocked = Reads("blocked", release)
    wedged = None
    try:
        eventually(lambda: all_beat(*names))
        eventually(lambda: ours() <= 2)
        assert all(mesh is not None and len(mesh.peers) == 9 for mesh in robots)
        wedged = init_mesh(blocked, "blocked")
        assert blocked.asked.wait(20)
        beats.clear()
        eventually(lambda: all_beat("blocked", *names))
        first = robots.pop(0)
        assert first is not None
        first.close()
        assert not release.is_set()
        beats.clear()
        eventually(lambda: all_beat("blocked", *names[1:]))
        eventually(lambda: all(mesh is not None and len(mesh.peers) >= 9 for mesh in robots))
        assert all(not row["reachable"] for mesh in robots for row in mesh.peers if row["peer_id"] == "arm-0")  # type: ignore[union-attr]
        assert beats["arm-0"] == 0
    finally:
        release.set()
        for mesh in [*robots, wedged]:
            if mesh is not None:
                mesh.close()
        watcher.close()
    eventually(lambda: ours() == 0)
