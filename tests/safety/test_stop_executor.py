"""The stop executor: every stop is answered in time and carried out, and a blocked halt delays no other target."""

from __future__ import annotations

import gc
import random
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.adapted import AdaptedRobot
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.stop_executor import RESERVE, StopExecutor, stop_executor
from strands_robots.safety.stopping import StopVerdict, halts_in_parts


class Wedged:
    """Blocks in its first ``times`` halts until it is released; answers every later one."""

    def __init__(self, times: int = 1) -> None:
        self.gate = MotionGate()
        self.reasons: list[str] = []
        self.threads: list[str] = []
        self.release = threading.Event()
        self.times = times

    def halt(self, reason: str = "") -> StopVerdict:
        self.threads.append(threading.current_thread().name)
        self.reasons.append(reason)
        if len(self.reasons) <= self.times:
            self.release.wait(60)
        return StopVerdict()


class DirectWedged(Wedged):
    """The same, whose public halt goes through the executor."""

    def halt_ordered(self) -> None:
        return None

    def halt_here(self, reason: str, deadline: float) -> StopVerdict:
        return super().halt(reason)

    def unanswered(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={"bus": why})

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        return stop_executor().halt(self, "direct", reason)


@pytest.fixture
def robot() -> Iterator[Wedged]:
    made = Wedged()
    yield made
    made.release.set()


@pytest.fixture
def executor() -> StopExecutor:
    return StopExecutor()


def threads(name: str = "wedged-1") -> int:
    return sum(thread.name == f"halt-{name}" for thread in threading.enumerate())


def wedge(executor: StopExecutor, robot: Wedged, within: float = 20.0) -> Any:
    executor.attach(robot, "wedged-1")
    first = executor.submit(robot, "wedged-1", "first", within=within)
    eventually(lambda: robot.reasons == ["first"])
    return first


def test_stop_behind_a_stuck_halt_is_done_by_the_fresh_thread(executor: StopExecutor, robot: Wedged) -> None:
    first = wedge(executor, robot, within=0.3)
    second = executor.submit(robot, "wedged-1", "second", within=20)
    assert first.result(20).not_stopped == {"wedged-1": "no answer in 0.3 s"}
    assert second.result(20).stopped is True
    robot.release.set()
    executor.detach(robot, wait=20)
    eventually(lambda: not threads())
    assert robot.reasons == ["first", "second"]


def test_robot_that_was_detached_while_stuck_leaves_no_thread_and_loses_no_stop(
    executor: StopExecutor, robot: Wedged
) -> None:
    wedge(executor, robot, within=0.3)
    second = executor.submit(robot, "wedged-1", "second", within=20)
    executor.detach(robot)
    assert second.result(20).stopped is True, "what was ordered before it left is done"
    robot.release.set()
    eventually(lambda: not threads())


def test_late_answer_is_reported_after_the_verdict_in_time(executor: StopExecutor, robot: Wedged) -> None:
    answers: list[bool | None] = []
    stop = executor.submit(robot, "wedged-1", "stop", within=0.2, answered=lambda each: answers.append(each.stopped))
    assert stop.result(20).stopped is False
    robot.release.set()
    eventually(lambda: answers == [False, True])


def test_stops_that_wait_share_the_next_halt(executor: StopExecutor, robot: Wedged) -> None:
    first = wedge(executor, robot)
    waiting = [executor.submit(robot, "wedged-1", f"stop {n}", within=20) for n in range(50)]
    assert not any(each.done() for each in waiting)
    robot.release.set()
    assert all(each.result(20).stopped for each in [first, *waiting])
    assert robot.reasons == ["first", "stop 0"], "one halt for all, which began after them"
    executor.detach(robot)


def test_direct_target_says_itself_what_it_does_and_gets_no_second_thread(executor: StopExecutor) -> None:
    direct = DirectWedged()
    wedge(executor, direct, within=0.3)
    for _ in range(4):
        verdict = executor.halt(direct, "wedged-1", "again", within=0.2)
        assert verdict.not_stopped == {"bus": "no answer in 0.2 s"}
    assert (threads(), direct.reasons) == (1, ["first"])
    direct.release.set()
    eventually(lambda: direct.reasons == ["first", "again"], what="one halt for all four")
    executor.detach(direct)
    eventually(lambda: not threads())


def test_halt_of_a_direct_target_runs_on_its_own_thread_and_answers_its_caller() -> None:
    direct = DirectWedged(times=0)
    stop_executor().attach(direct, "direct-1")
    assert direct.halt("test").stopped is True
    assert direct.threads == ["halt-direct-1"]
    stop_executor().detach(direct)


def test_halt_inside_a_halt_of_the_same_target_runs_inline(executor: StopExecutor) -> None:
    class Nesting:
        depth = 0

        def halt(self, reason: str = "") -> StopVerdict:
            self.depth += 1
            if self.depth < 3:
                return executor.halt(self, "nesting", reason, within=20)
            return StopVerdict((threading.current_thread().name,))

    nesting = Nesting()
    executor.attach(nesting, "nesting")
    assert executor.halt(nesting, "nesting", "test", within=20).halted == ("halt-nesting",)
    assert nesting.depth == 3
    executor.detach(nesting)


@pytest.mark.parametrize(
    ("answer", "stopped"),
    [(RuntimeError("bus is gone"), False), (SystemExit(), False), ({"odd": 1}, None), ({"status": "success"}, True)],
)
def test_whatever_a_halt_answers_or_raises_is_graded(executor: StopExecutor, answer: Any, stopped: bool | None) -> None:
    class Odd:
        def halt(self, reason: str = "") -> Any:
            if isinstance(answer, BaseException):
                raise answer
            return answer

    odd = Odd()
    for _ in range(2):
        assert executor.halt(odd, "odd", "test", within=20).stopped is stopped


def test_permits_are_void_when_the_stop_was_submitted_though_its_halt_waits(
    executor: StopExecutor, robot: Wedged
) -> None:
    wedge(executor, robot)
    permit = robot.gate.permit("start")
    executor.submit(robot, "wedged-1", "second", within=20)
    assert not permit.valid
    robot.release.set()
    executor.detach(robot)


def test_a_hundred_idle_robots_own_no_threads_and_all_halt() -> None:
    started: list[threading.Thread] = []

    def start(thread: threading.Thread) -> None:
        started.append(thread)
        thread.start()

    def alive() -> int:
        return sum(thread.is_alive() for thread in started)

    executor = StopExecutor(start)
    executor.prepare()
    robots = [Wedged(times=0) for _ in range(100)]
    assert alive() == RESERVE + 1, "and the thread that watches the deadlines"
    stops = [executor.submit(each, f"idle-{n}", "stop", within=20) for n, each in enumerate(robots)]
    assert all(stop.result(20).stopped for stop in stops)
    eventually(lambda: alive() <= RESERVE + 1)


def test_lack_of_threads_is_said_once_until_there_are_threads_again(caplog: pytest.LogCaptureFixture) -> None:
    full, refused = threading.Event(), list[str]()

    def start(thread: threading.Thread) -> None:
        if full.is_set():
            refused.append(thread.name)
            raise RuntimeError("can't start new thread")
        thread.start()

    def said(words: str) -> int:
        return sum(words in each.getMessage() for each in caplog.records)

    executor, robots = StopExecutor(start), [Wedged(), Wedged()]
    executor.prepare()
    try:
        for times, wedged in enumerate(robots, 1):
            full.set()
            executor.submit(wedged, "wedged-1", "stop", within=20)
            before = len(refused)
            eventually(lambda before=before: len(refused) > before + 3, what="four looks of the watcher")  # type: ignore[misc]
            assert said("No thread can be started for stops") == times
            full.clear()
            eventually(lambda times=times: said("complete again") == times)  # type: ignore[misc]
    finally:
        full.clear()
        for wedged in robots:
            wedged.release.set()


def test_wedged_robots_never_use_up_the_reserve(executor: StopExecutor) -> None:
    wedged = [Wedged() for _ in range(4 * RESERVE)]
    for n, each in enumerate(wedged):
        executor.submit(each, f"wedged-{n}", "stop", within=20)
    try:
        assert executor.halt(Wedged(times=0), "idle", "stop", within=20).stopped is True
    finally:
        for each in wedged:
            each.release.set()


def test_attached_twice_is_detached_twice(executor: StopExecutor, robot: Wedged) -> None:
    executor.attach(robot, "wedged-1")
    executor.attach(robot, "wedged-1")
    executor.detach(robot)
    assert threads() == 1
    executor.detach(robot)
    eventually(lambda: not threads())
    executor.detach(robot)


def test_target_that_is_garbage_takes_its_thread_along(executor: StopExecutor) -> None:
    robot = Wedged(times=0)
    executor.attach(robot, "wedged-1")
    assert executor.halt(robot, "wedged-1", "stop", within=600).stopped is True
    del robot
    gc.collect()
    eventually(lambda: not threads())


def test_wrappers_of_one_robot_and_equal_values_are_one_target(executor: StopExecutor) -> None:
    wedged = Wedged()
    wrappers = [AdaptedRobot(wedged), AdaptedRobot(wedged)]

    @dataclass(frozen=True)
    class Arm:
        """One robot of a world."""

        world: Wedged
        name: str
        log: list[str] = field(compare=False)

        def halt(self, reason: str = "") -> StopVerdict:
            self.log.append(reason)
            return self.world.halt(reason)

    world, log = Wedged(), list[str]()
    for target, halts, make in (
        (wedged, wedged.reasons, lambda n: wrappers[n % 2]),
        (world, log, lambda n: Arm(world, "left", log)),
    ):
        targets: Callable[[int], Any] = make
        first = executor.submit(targets(0), "one", "first", within=20)
        eventually(lambda halts=halts: halts == ["first"])
        others = [executor.submit(targets(n), "one", "more", within=20) for n in range(6)]
        time.sleep(0.05)
        assert halts == ["first"], "no second halt beside the one that runs"
        target.release.set()
        assert all(stop.result(20).stopped for stop in [first, *others])
        assert halts == ["first", "more"]


def test_stop_is_halted_by_its_caller_where_no_thread_can_start(caplog: pytest.LogCaptureFixture) -> None:
    def none(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    executor, robot = StopExecutor(none), Wedged(times=0)
    assert executor.halt(robot, "arm-1", "stop").stopped is True
    assert robot.threads == [threading.current_thread().name]
    assert "No thread can be started to halt arm-1" in caplog.text
    with pytest.raises(RuntimeError):
        executor.attach(robot, "arm-1")


def test_target_attached_while_the_reserve_halts_it_leaves_no_thread(executor: StopExecutor, robot: Wedged) -> None:
    first = executor.submit(robot, "wedged-1", "first", within=0.3)
    eventually(lambda: robot.reasons == ["first"])
    executor.attach(robot, "wedged-1")
    assert first.result(20).stopped is False
    assert executor.halt(robot, "wedged-1", "second", within=20).stopped is True
    executor.detach(robot)
    robot.release.set()
    eventually(lambda: not threads())


def test_under_load_every_stop_is_answered_and_followed_by_a_halt() -> None:
    executor, end = StopExecutor(), time.monotonic() + 2

    class Slow:
        def __init__(self) -> None:
            self.began: list[float] = []

        def halt(self, reason: str = "") -> StopVerdict:
            self.began.append(time.monotonic())
            time.sleep(random.choice([0, 0, 0.001, 0.05, 0.2]))
            return StopVerdict()

    robots = [Slow() for _ in range(4)]
    stops: list[tuple[float, Slow, Future[StopVerdict]]] = []

    def submit() -> None:
        while time.monotonic() < end:
            robot = random.choice(robots)
            at = time.monotonic()
            stops.append((at, robot, executor.submit(robot, "load", "x", within=random.choice([0.1, 2.0]))))
            time.sleep(0.002)

    def attach() -> None:
        attached: list[Slow] = []
        while time.monotonic() < end:
            attached.append(random.choice(robots))
            executor.attach(attached[-1], "load")
            if random.random() < 0.6:
                executor.detach(attached.pop())
            time.sleep(0.005)
        for robot in attached:
            executor.detach(robot)

    workers = [threading.Thread(target=each) for each in (submit, submit, attach, attach)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for at, robot, stop in stops:
        assert stop.result(20) is not None
        eventually(lambda robot=robot, at=at: robot.began[-1] >= at, what="a halt that began after the stop")
    eventually(lambda: not threads("load"))


def test_robot_that_is_an_unhashable_dataclass_is_halted(executor: StopExecutor) -> None:
    @dataclass
    class Plain:
        name: str = "plain"
        halts: int = 0

        def halt(self, reason: str = "") -> StopVerdict:
            self.halts += 1
            return StopVerdict((self.name,))

    @dataclass(frozen=True)
    class Part:
        world: Plain
        name: str

        def halt(self, reason: str = "") -> StopVerdict:
            return self.world.halt(reason)

    world = Plain()
    assert executor.halt(world, "plain", "test", within=20).stopped
    assert executor.halt(Part(world, "left"), "left", "test", within=20).stopped
    assert world.halts == 2


def test_overridden_halt_of_a_direct_robot_is_the_one_that_is_called() -> None:
    braked: list[str] = []

    class Braked(HardwareRobot):
        def halt(self, reason: str = "") -> StopVerdict:
            braked.append(reason)
            return super().halt(reason)

    device = RecordingDevice()
    robot = Braked(device, "braked")
    robot.connect()
    assert stop_executor().halt(robot, "braked", "test", within=20).stopped
    assert braked == ["test"]
    robot.cleanup()


def test_second_stop_of_a_slow_robot_has_its_own_time(executor: StopExecutor) -> None:
    begun = threading.Semaphore(0)

    class Slow:
        def halt(self, reason: str = "") -> StopVerdict:
            begun.release()
            time.sleep(0.6)
            return StopVerdict(("slow",))

    slow = Slow()
    first = executor.submit(slow, "slow", "first", within=1.0)
    assert begun.acquire(timeout=20)
    second = executor.submit(slow, "slow", "second", within=1.0)
    assert [first.result(20).stopped, second.result(20).stopped] == [True, True]


def test_robot_that_cannot_note_its_motion_is_halted_all_the_same(executor: StopExecutor) -> None:
    class Confused:
        def halt_ordered(self) -> None:
            raise RuntimeError("no idea")

        def halt(self, reason: str = "") -> StopVerdict:
            return StopVerdict(("confused",))

    assert executor.halt(Confused(), "confused", "test", within=20).stopped


def test_the_first_that_a_stop_asks_of_a_robot_is_its_halt(executor: StopExecutor) -> None:
    asked: list[str] = []

    class Watched(Wedged):
        def __getattribute__(self, name: str) -> Any:
            asked.append(name)
            return super().__getattribute__(name)

    robot = Watched(times=0)
    asked.clear()
    assert executor.halt(robot, "watched", "fire").stopped is True
    assert asked[0] == "halt"


def test_gate_keeps_the_newest_stop_with_its_reason_and_its_verdict() -> None:
    robot = Wedged(times=0)
    halted = stop_executor().submit(robot, "arm-1", "stop by alice")
    newest = robot.gate.newest_stop
    assert newest is not None
    assert newest.reason == "stop by alice"
    assert newest.verdict.result(20) is halted.result(20)
