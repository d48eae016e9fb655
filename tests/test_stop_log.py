"""The safety plane's log never blocks: a handler that hangs keeps its records, and nothing else."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator

import pytest
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.stop_executor import StopExecutor
from strands_robots.stop_log import RECORDS_MAX, LogWriter, flush_stop_log, stop_logger


class PausedTerminal(logging.Handler):
    """Blocks in its first record until it is released, as a terminal after Ctrl-S does."""

    def __init__(self) -> None:
        super().__init__()
        self.go_on = threading.Event()
        self.blocked = threading.Event()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.blocked.set()
        self.go_on.wait(120)
        self.lines.append(record.getMessage())


@pytest.fixture
def terminal() -> Iterator[PausedTerminal]:
    paused, root = PausedTerminal(), logging.getLogger()
    root.addHandler(paused)
    yield paused
    paused.go_on.set()
    flush_stop_log(20.0)
    root.removeHandler(paused)


def test_a_blocked_handler_holds_no_caller_and_gets_every_record_later(terminal: PausedTerminal) -> None:
    logger = stop_logger("strands_robots.safety.plane")
    for number in range(10):
        logger.warning("line %d", number)
    assert terminal.blocked.wait(20)
    assert not flush_stop_log(0.01)
    terminal.go_on.set()
    # A thread of an earlier test may have something to say as well.
    expected = [f"line {number}" for number in range(10)]
    eventually(lambda: [each for each in terminal.lines if each.startswith("line ")] == expected)


def test_a_flood_of_records_is_bounded_and_counted(terminal: PausedTerminal) -> None:
    logger = stop_logger("strands_robots.safety.plane")
    for number in range(2 * RECORDS_MAX):
        logger.warning("line %d", number)
    terminal.go_on.set()
    eventually(lambda: any("log records were dropped" in line for line in terminal.lines))
    flush_stop_log(20.0)
    assert sum(line.startswith("line ") for line in terminal.lines) <= RECORDS_MAX + 2


def test_a_handler_that_raises_ends_no_log() -> None:
    class Broken(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())
            raise RuntimeError("broken")

    lines: list[str] = []
    broken, logger = Broken(), stop_logger("strands_robots.safety.plane")
    logging.getLogger().addHandler(broken)
    try:
        logger.warning("one")
        logger.warning("two")
        eventually(lambda: [each for each in lines if each in ("one", "two")] == ["one", "two"])
    finally:
        logging.getLogger().removeHandler(broken)


def test_a_record_is_handled_by_its_caller_where_no_thread_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", none)
    record = logging.LogRecord("any", logging.WARNING, "", 0, "text", (), None)
    assert LogWriter().filter(record) is True


class Raising(RecordingRobot):
    """Raises from each halt, which is told in the log at CRITICAL."""

    def halt(self, reason: str = "") -> object:  # type: ignore[override]
        super().halt(reason)
        raise RuntimeError("the bus is gone")


def test_stops_go_on_while_no_line_can_be_written(terminal: PausedTerminal) -> None:
    plane, robot = SafetyPlane(executor=StopExecutor()), Raising()
    entry = plane.register("arm", robot)  # type: ignore[arg-type]
    try:
        for number in range(1, 6):
            run = plane.begin(StopOrder(new_epoch(), "test", "test"))
            assert run is not None
            assert run.wait(20)
            assert len(robot.halts) == number
            assert run.reports["arm"].stopped is False
        assert terminal.blocked.is_set()
    finally:
        entry.close()
