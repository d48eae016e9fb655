"""The rail moves, and its halt says stopped only where the carriage stands."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest
from tarn_rail import TarnRail
from tarn_rail.conformance import EmulatedRail
from tarn_rail.emulator import RailEmulator
from tarn_rail.frames import BadFrameError, packed, unpacked
from tarn_rail.link import RailError

from strands_robots.utils import ValidationError


@pytest.fixture
def rail() -> Iterator[EmulatedRail]:
    robot = EmulatedRail()
    yield robot
    robot.emulator.cut(out=False)
    robot.emulator.hangs = robot.emulator.lies = False
    robot.cleanup()


@pytest.fixture
def moving(rail: EmulatedRail) -> Iterator[EmulatedRail]:
    """The rail under way, as a verb that was called has it."""

    def shuttle() -> None:
        with suppress(RailError):  # as for a caller: the motion failed
            rail.shuttle(trips=9)

    motion = threading.Thread(target=shuttle)
    motion.start()
    eventually(lambda: rail.emulator.moving)
    yield rail
    rail.emulator.cut(out=False)
    rail.emulator.hangs = rail.emulator.lies = False
    eventually(lambda: rail.halt()["stopped"] and not motion.is_alive())


def eventually(condition: Callable[[], object], within: float = 10.0) -> None:
    ends = time.monotonic() + within
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.01)


def test_it_slides_to_a_place(rail: EmulatedRail) -> None:
    assert rail.slide_to(position_mm=30.0, speed_mm_s=400) == {"position_mm": 30.0}
    assert rail.read_state() == {"rail": "IDLE", "position_mm": 30.0}
    assert rail.get_state()["joints"] == {"carriage_mm": 30.0}


def test_halt_has_stopped_the_carriage_when_it_says_so(moving: EmulatedRail) -> None:
    assert moving.halt()["stopped"] is True
    assert (moving.emulator.moving, moving.emulator.state) == (False, "HELD")


def test_halt_without_a_cable_does_not_say_stopped(moving: EmulatedRail) -> None:
    moving.emulator.cut()
    answer = moving.halt()
    assert (answer["status"], answer["stopped"]) == ("error", False)
    assert moving.emulator.moving


def test_rail_is_stopped_when_the_cable_is_back(moving: EmulatedRail) -> None:
    moving.emulator.cut()
    moving.halt()
    moving.emulator.cut(out=False)
    eventually(lambda: not moving.emulator.moving)


def test_halt_of_a_rail_that_hangs_is_answered_in_time_and_does_not_say_stopped(moving: EmulatedRail) -> None:
    moving.emulator.hangs = True
    began = time.monotonic()
    answer = moving.halt()
    assert time.monotonic() - began < 1.0
    assert answer["stopped"] is False
    assert "not answered" in answer["reason"]


def test_halt_of_a_rail_that_says_held_and_moves_does_not_say_stopped(moving: EmulatedRail) -> None:
    moving.emulator.lies = True
    answer = moving.halt()
    assert answer["stopped"] is False
    assert "says that it is HELD, and went on" in answer["reason"]


def test_fault_has_to_be_cleared_before_it_moves_again(rail: EmulatedRail) -> None:
    rail.emulator.overload()
    with pytest.raises(ValidationError, match="clearFault"):
        rail.slide_to(position_mm=30.0)
    rail.clear_fault()
    assert rail.slide_to(position_mm=30.0, speed_mm_s=400) == {"position_mm": 30.0}


def test_rail_that_is_not_there_is_named() -> None:
    with RailEmulator() as gone:
        port = gone.port
    with pytest.raises(ConnectionError, match=str(port)):
        TarnRail(port=port)


@pytest.mark.parametrize("line", [b"1F OK HELD 3.0*00", b"1F OK", "1F \xd6K*00".encode(), b"1F*77", b""])
def test_line_that_is_no_frame_is_refused(line: bytes) -> None:
    with pytest.raises(BadFrameError):
        unpacked(line)


def test_frame_is_read_as_it_was_written() -> None:
    assert packed("1F", "GO", "350.0", "100.0") == b"1F GO 350.0 100.0*58\r\n"
    assert unpacked(packed("1F", "GO", "350.0", "100.0")) == ("1F", ["GO", "350.0", "100.0"])
