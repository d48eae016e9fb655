"""Attempts of a robot whose disk is full: what is saved stays, and what was recorded is kept by name."""

from __future__ import annotations

import errno
import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from fixtures.waiting import eventually
from rich.console import Console

from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.recorder_device import RecorderDevice
from strands_robots.cli.recording_state import RecordingState, Said, Stage
from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file
from strands_robots.datasets.session import RecordingSession
from strands_robots.envelope import is_error
from strands_robots.recording.file import Pictures, Recorder

FPS = 30


class Arm:
    """A robot without cameras, of ten steps an attempt."""

    name, has_cameras, stopped_by, locked = "arm-1", False, "stop by alice.", ""

    def __init__(self) -> None:
        self.stopped, self.held = False, 0
        self.at_hold: Callable[[], object] = lambda: None

    @contextmanager
    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> Iterator[None]:
        for step in range(10):
            row = {"observation": {"pan": step}, "action": {"pan": step}}
            recorder.take(self.name, "streamStep", row, 1000.0 + step / FPS)
        yield

    def halt(self, reason: str) -> Any:
        return SimpleNamespace(stopped=True)

    def hold(self, screen: Screen) -> None:
        self.held += 1
        self.at_hold()


class Meanwhile(RecordingState):
    """A recording to which something happens as it enters a stage, in this order."""

    def __init__(self, *happens: tuple[Stage, Callable[[RecordingState], object]]) -> None:
        super().__init__()
        self._happens = happens

    def enter(self, stage: Stage, progress: Any = None) -> None:
        super().enter(stage, progress)
        for at, happens in self._happens:
            if at is stage:
                happens(self)


def says(*words: Said) -> Callable[[RecordingState], object]:
    """Return what says words."""
    return lambda state: [state.words.take(each) for each in words]


def stops(reason: str) -> Callable[[RecordingState], object]:
    """Return what stops a recording."""
    return lambda state: state.halt(reason)


@pytest.fixture
def arm() -> Arm:
    return Arm()


def session(folder: Path, said: list[str] | None = None) -> RecordingSession:
    return RecordingSession(folder, FPS, "wave", "so100", ([] if said is None else said).append)


def record(arm: Arm, recording: RecordingSession, count: int) -> None:
    task = SimpleNamespace(voided=False, running=False, error="")
    screen = Screen(console=Console(file=io.StringIO()))
    record_attempts(screen, arm, recording, Attempts(count, lambda: task, FPS, 1.0, 0.0, True))


def fill(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk be full from now on, as it looks to what writes the row of an episode."""

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tables, "write_episode", full)


def test_full_disk_ends_it_by_name_and_the_attempt_is_an_episode_later(
    tmp_path: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    with session(tmp_path) as recording:
        record(arm, recording, 2)
        with monkeypatch.context() as patch:
            fill(patch)
            with pytest.raises(CliError) as failed:
                record(arm, recording, 1)
    reason = failed.value.reason
    assert (
        f"{tmp_path} cannot be written: No space left on device. The disk is full. Episodes that are saved: 2."
        in reason
    )
    assert "attempt-000002.mcap; the next start makes an episode of it" in reason
    assert [each for each in check_dataset(tmp_path)[1] if each.wrong] == []
    with session(tmp_path, said) as again:
        assert again.episodes == 3
    assert said[-1].startswith("episode 2 is the attempt that was running")


def test_robot_that_was_stopped_stays_on_its_network_also_where_the_disk_is_full(
    tmp_path: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.stopped = True
    fill(monkeypatch)
    with session(tmp_path) as recording, pytest.raises(CliError, match="The disk is full"):
        record(arm, recording, 1)
    assert arm.held == 1


def test_stop_that_is_known_for_a_lockout_by_the_end_is_told_as_one(tmp_path: Path) -> None:
    class Late(Arm):
        told: ClassVar = ["arm-1 was stopped.", "arm-1 is locked by an emergency stop."]

        @property
        def stopped_by(self) -> str:  # type: ignore[override]
            return self.told.pop(0)

    arm = Late()
    arm.stopped = True
    with session(tmp_path) as recording, pytest.raises(CliError, match="network: arm-1 is locked"):
        record(arm, recording, 1)


def test_leader_that_failed_costs_no_saved_episode(tmp_path: Path, arm: Arm) -> None:
    with session(tmp_path) as recording:
        record(arm, recording, 1)
        task = SimpleNamespace(voided=False, running=False, error="the leader's cable is out")
        attempts = Attempts(3, lambda: task, FPS, 1.0, 0.0, True)
        with pytest.raises(CliError, match="cable is out"):
            record_attempts(Screen(console=Console(file=io.StringIO())), arm, recording, attempts)
        assert recording.episodes == 2
    assert tables.read_frames(tmp_path / "data/chunk-000/file-001.parquet")["next.success"].tolist() == [False] * 10


def worth(folder: Path) -> list[tuple[bool, int]]:
    """Return of each episode whether it is a success, and whether a stop ends it."""
    files = [folder / data_file(number) for number in range(9)]
    frames = [tables.read_frames(file) for file in files if file.exists()]
    return [(bool(each["next.success"].any()), int(each["stop"][-1])) for each in frames]


class Steady:
    """A task that runs until it is told to end."""

    voided, error = False, ""

    def __init__(self) -> None:
        self.running = True


def test_words_of_the_network_are_those_of_the_keys(tmp_path: Path, arm: Arm) -> None:
    device = RecorderDevice(state := RecordingState(), "arm-1", "wave")
    screen = Screen(console=Console(file=io.StringIO()))
    attempts = Attempts(9, Steady, FPS, None, 60.0, success=False, asked=True, state=state)
    with session(tmp_path) as recording:
        thread = threading.Thread(target=record_attempts, args=(screen, arm, recording, attempts))
        thread.start()
        for judged in (lambda: device.keep_episode(True), device.redo_episode, lambda: device.keep_episode(False)):
            for word in (device.begin_episode, judged):
                eventually(lambda word=word: not is_error(word()), what="a moment that it fits")  # type: ignore[misc]
        eventually(lambda: device.get_recording()["said"].endswith("no success."), what="the last episode")
        assert (device.get_recording()["episode"], device.get_recording()["saved"]) == (3, 2)
        eventually(lambda: not is_error(device.end_recording()), what="the end")
        thread.join(10)
        assert not thread.is_alive()
        assert recording.episodes == 2
    worth = [bool(tables.read_frames(tmp_path / data_file(number))["next.success"][-1]) for number in (0, 1)]
    assert worth == [True, False]
    assert device.get_recording()["state"] == "over"


def test_attempts_by_time_wait_for_nobody_and_take_a_word(tmp_path: Path, arm: Arm) -> None:
    device = RecorderDevice(state := RecordingState(), "arm-1", "wave")
    screen = Screen(console=Console(file=io.StringIO()))
    attempts = Attempts(2, Steady, FPS, 600.0, 600.0, success=True, state=state)
    with session(tmp_path) as recording:
        thread = threading.Thread(target=record_attempts, args=(screen, arm, recording, attempts))
        thread.start()
        eventually(lambda: not is_error(device.keep_episode(False)), what="the first, which nobody began")
        eventually(lambda: device.get_recording().get("begins_in_s", 0) > 500, what="the pause")
        assert not is_error(device.begin_episode()), "who has put things back need not wait"
        eventually(lambda: not is_error(device.end_recording()), what="the end")
        thread.join(10)
        assert recording.episodes == 1


def test_begin_that_comes_as_the_pause_is_over_judges_no_attempt(tmp_path: Path, arm: Arm) -> None:
    pressed = Meanwhile((Stage.STARTING, says(Said.SUCCESS)))
    task = SimpleNamespace(voided=False, running=False, error="")
    attempts = Attempts(1, lambda: task, FPS, 600.0, 0.0, success=False, state=pressed)
    with session(tmp_path) as recording:
        record_attempts(Screen(console=Console(file=io.StringIO())), arm, recording, attempts)
    assert not tables.read_frames(tmp_path / data_file(0))["next.success"].any()


def test_stop_of_the_recording_is_an_episode_without_success_and_its_end(tmp_path: Path, arm: Arm) -> None:
    device = RecorderDevice(state := RecordingState(), "arm-1", "wave")
    attempts = Attempts(9, Steady, FPS, None, 0.0, success=True, state=state)
    records = partial(eventually, lambda: device.get_recording()["state"] == "recording")
    stopper = threading.Thread(target=lambda: (records(), device.halt("stop by desk")))
    stopper.start()
    with session(tmp_path) as recording:
        with pytest.raises(CliError, match="the recording was stopped: stop by desk"):
            record_attempts(Screen(console=Console(file=io.StringIO())), arm, recording, attempts)
        assert recording.episodes == 1
    stopper.join(10)
    assert worth(tmp_path) == [(False, 1)]


def test_recording_that_is_stopped_as_it_starts_begins_nothing(tmp_path: Path, arm: Arm) -> None:
    stopped = Meanwhile((Stage.STARTING, stops("the recording was stopped: stop by desk")))
    began: list[Steady] = []
    attempts = Attempts(9, lambda: began.append(Steady()), FPS, 600.0, 0.0, success=True, state=stopped)
    with (
        session(tmp_path) as recording,
        pytest.raises(CliError, match="Nothing began: the recording was stopped: stop by desk"),
    ):
        record_attempts(Screen(console=Console(file=io.StringIO())), arm, recording, attempts)
    assert began == []
    assert not recording.recording.exists(), "what nothing led is no attempt"


STOPPED = "the recording was stopped: stop by desk"


def attempts_of(state: RecordingState, began: list[Steady], **how: Any) -> Attempts:
    def begin() -> Steady:
        began.append(Steady())
        return began[-1]

    return Attempts(
        9, begin, FPS, how.pop("seconds", None), how.pop("pause_s", 0.0), how.pop("success", True), **how, state=state
    )


def recorded(arm: Arm, folder: Path, attempts: Attempts) -> str:
    """Record on this thread; return why it failed."""
    with session(folder) as recording:
        try:
            record_attempts(Screen(console=Console(file=io.StringIO())), arm, recording, attempts)
        except CliError as failed:
            return failed.reason
    return ""


@pytest.mark.parametrize("asked", [False, True], ids=["by_time", "by_a_person"])
def test_stop_while_it_waits_lets_no_attempt_begin(tmp_path: Path, arm: Arm, asked: bool) -> None:
    class Late(RecordingState):
        def wait_for_begin(self, begins_at: float | None) -> None:
            super().wait_for_begin(begins_at)
            device.halt("stop by desk")
            self.words.take(Said.SUCCESS)

    device = RecorderDevice(state := Late(), "arm-1", "wave")
    began: list[Steady] = []
    assert recorded(arm, tmp_path, attempts_of(state, began, asked=asked)) == f"Nothing more is recorded: {STOPPED}."
    assert (began, arm.held) == ([], 0)


def test_locked_robot_stays_on_its_network_after_a_stop_while_it_waits(tmp_path: Path, arm: Arm) -> None:
    state, arm.locked = RecordingState(), "locked by desk"
    state.halt(STOPPED)
    assert recorded(arm, tmp_path, attempts_of(state, [])) == f"Nothing more is recorded: {STOPPED}."
    assert arm.held == 1


def test_robot_that_is_locked_as_its_policy_loads_stays_on_its_network(tmp_path: Path, arm: Arm) -> None:
    state = RecordingState()

    def load() -> None:
        arm.locked = "locked by desk"
        state.halt(STOPPED, 0.1)
        state.check()

    told: list[tuple[bool, str]] = []
    arm.at_hold = lambda: told.append((state.runs, state.facts()["said"]))
    attempts = Attempts(9, load, FPS, None, 0.0, success=True, state=state)
    assert recorded(arm, tmp_path, attempts) == f"Nothing began: {STOPPED}."
    assert told == [(False, f"Nothing began: {STOPPED}.")], "its recorder confirms the stop meanwhile"


@pytest.mark.parametrize("stage", [Stage.ENDING, Stage.SAVING])
def test_stop_after_the_word_ends_the_recording_and_leaves_the_word(tmp_path: Path, arm: Arm, stage: Stage) -> None:
    late = Meanwhile((Stage.RECORDING, says(Said.SUCCESS)), (stage, stops(STOPPED)))
    began: list[Steady] = []
    assert recorded(arm, tmp_path, attempts_of(late, began)) == f"Nothing more is recorded: {STOPPED}."
    assert (len(began), worth(tmp_path)) == (1, [(True, 0)])


def test_stop_counts_before_a_word_of_the_same_moment(tmp_path: Path, arm: Arm) -> None:
    both = Meanwhile((Stage.RECORDING, says(Said.SUCCESS)), (Stage.RECORDING, stops(STOPPED)))
    assert recorded(arm, tmp_path, attempts_of(both, [])) == f"The attempt failed: {STOPPED}"
    assert worth(tmp_path) == [(False, 1)]


@pytest.mark.parametrize("asked", [False, True], ids=["by_time", "by_a_person"])
def test_recorder_that_is_locked_begins_nothing_until_it_is_resumed(tmp_path: Path, arm: Arm, asked: bool) -> None:
    state, began, locked = RecordingState(), list[Steady](), ["recorder-arm-1 is locked by desk"]
    state.locked = lambda: "".join(locked)
    attempts = attempts_of(state, began, asked=asked)
    thread = threading.Thread(target=recorded, args=(arm, tmp_path, attempts))
    thread.start()
    eventually(lambda: state.facts()["state"] == "waiting", what="the pause")
    state.words.take(Said.SUCCESS)
    eventually(lambda: state.facts()["said"] == f"No attempt begins: {locked[0]}", what="the reason")
    assert began == []
    eventually(lambda: state.words.said() is None, what="the word, which is spent")
    locked.clear()
    if asked:
        state.words.take(Said.SUCCESS)
    eventually(lambda: state.facts()["state"] == "recording", what="the attempt")
    state.words.take(Said.END)
    thread.join(10)
    assert (len(began), thread.is_alive()) == (1, False)


def test_end_that_comes_with_another_word_is_not_lost(tmp_path: Path, arm: Arm) -> None:
    class Twice(Meanwhile):
        def wait_for_begin(self, begins_at: float | None) -> None:
            super().wait_for_begin(begins_at)
            for word in self.said_at_begin:
                self.words.take(word)

        said_at_begin: tuple[Said, ...] = (Said.SUCCESS, Said.END)

    both = Stage.RECORDING, says(Said.SUCCESS, Said.END)
    began: list[Steady] = []
    assert recorded(arm, tmp_path, attempts_of(Twice(both), began, asked=True)) == ""
    assert began == []
    Twice.said_at_begin = (Said.SUCCESS,)
    assert recorded(arm, tmp_path, attempts_of(Twice(both), began, asked=True)) == ""
    assert (len(began), worth(tmp_path)) == (1, [(True, 0)]), "the first word judges, and the end ends"
