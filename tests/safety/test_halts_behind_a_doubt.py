"""A halt waits for no reading of an earlier verdict: readings are shared, bounded and on threads of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future

import pytest
from fixtures.doubted_robots import DOUBTS, DoubtedRobot
from fixtures.waiting import eventually

from strands_robots.adapted import adapt
from strands_robots.safety.stop_executor import STUCK_MAX, StopExecutor
from strands_robots.safety.stopping import StopVerdict

LONG_S = 600.0
"""No deadline helps a stop along within a test."""

HANGING = tuple(doubt for doubt in DOUBTS if doubt != "running")

Submit = Callable[[int], list[Future[StopVerdict]]]


class Hang:
    """Blocks until it is released."""

    def __init__(self) -> None:
        self.released = threading.Event()

    def __call__(self) -> None:
        self.released.wait(120)


@pytest.fixture
def hang() -> Iterator[Hang]:
    made = Hang()
    yield made
    made.released.set()


@pytest.fixture(params=[True, False], ids=["attached", "of the reserve"])
def stops_of(request: pytest.FixtureRequest) -> Iterator[Callable[[DoubtedRobot, float], Submit]]:
    """Submit stops of a robot one after another, each once the one before has begun."""
    executor, attached = StopExecutor(), []

    def of(robot: DoubtedRobot, within: float) -> Submit:
        target = adapt(robot)
        if request.param:
            executor.attach(target, "doubted")
            attached.append(target)

        def submit(count: int) -> list[Future[StopVerdict]]:
            futures = []
            for _ in range(count):
                before = len(robot.stops)
                futures.append(executor.submit(target, "doubted", "test", within=within))
                eventually(lambda before=before: len(robot.stops) > before, what="the halt")  # type: ignore[misc]
            return futures

        return submit

    yield of
    for target in attached:
        executor.detach(target)


@pytest.mark.parametrize("doubt", HANGING)
def test_every_halt_begins_while_the_reading_of_the_first_one_hangs(
    doubt: str, hang: Hang, stops_of: Callable[[DoubtedRobot, float], Submit]
) -> None:
    robot = DoubtedRobot(doubt, hang)
    stops = stops_of(robot, LONG_S)(20)
    assert (len(robot.stops), robot.most_reading) == (20, 1)
    assert not any(each.done() for each in stops), "a doubt is not a verdict"
    hang.released.set()
    verdicts = [each.result(20).stopped for each in stops]
    expected = {"status": True, "repr": None, "get": True, "exception": False}[doubt]
    assert verdicts == [expected] * 20


def test_halts_begin_while_the_status_goes_on_saying_that_the_robot_runs(
    hang: Hang, stops_of: Callable[[DoubtedRobot, float], Submit]
) -> None:
    robot = DoubtedRobot("running", hang)
    stops = stops_of(robot, LONG_S)(10)
    assert all("says running after the stop" in each.result(20).not_stopped["task"] for each in stops)


def test_one_reading_serves_every_halt_that_was_over_when_it_began(
    hang: Hang, stops_of: Callable[[DoubtedRobot, float], Submit]
) -> None:
    robot = DoubtedRobot("status", hang)
    stops = stops_of(robot, LONG_S)(20)
    hang.released.set()
    assert all(each.result(20).stopped for each in stops)
    assert robot.reads == 2, "the one that hung, and one for all halts since"


def test_hung_readings_keep_few_threads_and_no_halt_back(
    hang: Hang, stops_of: Callable[[DoubtedRobot, float], Submit]
) -> None:
    robot = DoubtedRobot("status", hang)
    submit = stops_of(robot, 0.05)
    for _ in range(3 * STUCK_MAX):
        # A busy machine may begin a halt after its verdict was due, which then names the robot and not its task.
        (why,) = submit(1)[0].result(20).not_stopped.values()
        assert "no answer in 0.05 s" in why
    eventually(lambda: len(robot.stops) == 3 * STUCK_MAX, what="every halt")
    assert robot.most_reading <= STUCK_MAX + 1
    hang.released.set()
    eventually(lambda: robot.reading == 0)
    eventually(lambda: submit(1)[0].result(20).stopped is True, what="a status that is back counts again")


def test_the_next_return_of_a_blocked_halt_serves_all_that_wait(hang: Hang) -> None:
    class Blocked:
        def __init__(self) -> None:
            self.reasons: list[str] = []
            self.turns = threading.Semaphore(0)

        def halt(self, reason: str = "") -> StopVerdict:
            self.reasons.append(reason)
            self.turns.acquire(timeout=120)
            return StopVerdict((reason,))

    executor, robot = StopExecutor(), Blocked()
    try:
        # The first is not renewed while nothing waits; each later one takes a thread, until none is left.
        for number in range(STUCK_MAX + 1):
            assert executor.halt(robot, "blocked", f"stop {number}", within=0.05).stopped is False
        eventually(lambda: len(robot.reasons) == STUCK_MAX + 1)
        waiting = [executor.submit(robot, "blocked", f"late {number}", within=LONG_S) for number in range(50)]
        assert len(robot.reasons) == STUCK_MAX + 1, "eight threads, and no more"
        robot.turns.release()
        eventually(lambda: len(robot.reasons) == STUCK_MAX + 2, what="the halt for all that wait")
        robot.turns.release(100)
        assert {each.result(20).halted for each in waiting} == {("late 0",)}
        assert len(robot.reasons) == STUCK_MAX + 2
    finally:
        robot.turns.release(100)


def test_robot_whose_attributes_hang_is_submitted_at_once(hang: Hang) -> None:
    class Remote:
        """Looks every unknown name up elsewhere, as a proxy does."""

        def __init__(self) -> None:
            self.halts: list[str] = []

        def __getattr__(self, name: str) -> object:
            hang()
            raise AttributeError(name)

        def halt(self, reason: str = "") -> StopVerdict:
            self.halts.append(reason)
            return StopVerdict()

    executor, robot = StopExecutor(), Remote()
    for reason in ("first", "second"):
        submitting = threading.Thread(target=executor.submit, args=(robot, "remote", reason), daemon=True)
        submitting.start()
        eventually(lambda reason=reason: robot.halts[-1:] == [reason])  # type: ignore[misc]
        submitting.join(20)
        assert not submitting.is_alive()
    assert robot.halts == ["first", "second"]


def test_robot_whose_gate_cannot_be_read_is_halted_all_the_same(hang: Hang) -> None:
    class Gateless:
        def __init__(self) -> None:
            self.halts: list[str] = []

        @property
        def gate(self) -> object:
            raise RuntimeError("no gate today")

        def halt(self, reason: str = "") -> StopVerdict:
            self.halts.append(reason)
            hang()
            return StopVerdict()

    executor, robot = StopExecutor(), Gateless()
    executor.submit(robot, "gateless", "first", within=0.1)
    eventually(lambda: robot.halts == ["first"])
    executor.submit(robot, "gateless", "second", within=LONG_S)
    eventually(lambda: robot.halts == ["first", "second"])
