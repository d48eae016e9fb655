"""Attempts of a robot of the command that a leader takes over from its policy."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually
from rich.console import Console

from strands_robots.cli import leading
from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.cli.far_hand import HandLeader
from strands_robots.cli.led_robot import LedRobot
from strands_robots.cli.local_recording import LocalAttempts, turns_drive
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.recording_state import RecordingState, Said
from strands_robots.datasets import tables
from strands_robots.datasets.layout import data_file
from strands_robots.datasets.session import RecordingSession
from strands_robots.hardware import HardwareRobot
from strands_robots.serving.control import NotHolderError
from strands_robots.serving.control_leases import ControlLeases, leases_of

FPS = 30


class Desk:
    """A real arm on a device without metal, led in turns, and the person who records it."""

    def __init__(self, folder: Path) -> None:
        self.arm = HardwareRobot(RecordingDevice(), "arm", control_hz=200)
        self.arm.connect()
        self.leases: ControlLeases = leases_of(self.arm, hardware=True)
        self.state, self.folder, self.failed = RecordingState(), folder, ""
        self._screen = Screen(console=Console(file=io.StringIO()))
        self._thread = threading.Thread(target=self._record, daemon=True)

    def _record(self) -> None:
        led = LedRobot(self.arm, "arm-1")
        hand = HandLeader(self._screen, "leader", {}, None, ScriptedLeader({"pan.pos": (20.0, 5.0, 1.0)}))
        driven = turns_drive(self._screen, "mock", "wave", None, hand, self.state.check, led)
        with RecordingSession(self.folder, FPS, "wave", "so100", lambda said: None) as session, driven as driver:
            attempts = Attempts(2, driver.begin, FPS, None, 0.0, success=False, asked=True, state=self.state)
            try:
                record_attempts(self._screen, LocalAttempts(led, None, driver), session, attempts)
            except CliError as failed:
                self.failed = failed.reason
                self.arm.halt("over")

    def __enter__(self) -> Desk:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.state.halt("test over")
        self._thread.join(10)
        self.arm.cleanup()

    def until(self, state: str) -> None:
        eventually(lambda: self.failed or self.state.facts()["state"] == state, within=10, what=state)

    def attempt(self) -> None:
        """Begin, and wait for some steps."""
        self.until("waiting")
        self.state.words.take(Said.SUCCESS)
        self.until("recording")
        eventually(lambda: self.failed or self.state.facts()["frames"] > 5, within=10)

    def done(self) -> None:
        self._thread.join(10)
        assert not self._thread.is_alive()


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr("strands_robots.cli.far_hand.GIVE_UP_S", 10.0)
    with Desk(tmp_path) as made:
        yield made


def test_each_attempt_in_turns_ends_by_its_word_and_holds_the_robot_meanwhile(desk: Desk) -> None:
    for word in (Said.SUCCESS, Said.FAILURE):
        desk.attempt()
        with pytest.raises(NotHolderError, match="leader"):
            desk.leases.of().acquire("alice", "human", 10.0)
        desk.state.words.take(word)
        eventually(lambda: not desk.state.runs, within=10)
        assert desk.arm.tasks.leading() == {}
    desk.done()
    assert desk.failed == ""
    worth = [bool(tables.read_frames(desk.folder / data_file(each))["next.success"][-1]) for each in range(2)]
    assert worth == [True, False]


def test_robot_that_another_holds_is_not_led_in_turns(desk: Desk) -> None:
    desk.leases.of().acquire("alice", "human", 10.0)
    desk.until("waiting")
    desk.state.words.take(Said.SUCCESS)
    desk.done()
    assert "alice (human) holds control" in desk.failed
    assert desk.arm.tasks.leading() == {}


def test_stop_of_the_recording_halts_a_robot_that_is_led_in_turns(desk: Desk) -> None:
    desk.attempt()
    desk.state.halt("the recording was stopped: stop by desk")
    desk.done()
    assert desk.failed == "The attempt failed: the recording was stopped: stop by desk"
    assert tables.read_frames(desk.folder / data_file(0))["stop"][-1] == 1


def test_policy_that_is_loading_is_waited_for_no_longer_than_the_recording_lasts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state, asked = RecordingState(), list[str]()

    class Loading:
        def warm(self) -> str | None:
            asked.append("loading")
            if len(asked) == 2:
                state.halt("the recording was stopped: stop by desk")
            return "" if len(asked) < 9 else None

    monkeypatch.setattr(leading, "create_policy", lambda name: Loading())
    with pytest.raises(CliError, match="Nothing began: the recording was stopped: stop by desk"):
        leading.load_policy(Screen(console=Console(file=io.StringIO())), "large", state.check)
    assert len(asked) == 2
