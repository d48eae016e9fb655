"""A recording's state, and the words that come from its network."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.cli.output import CliError
from strands_robots.cli.recorder_device import RecorderDevice
from strands_robots.cli.recording_state import RecordingState, Said, Stage
from strands_robots.envelope import is_error, text_of


@pytest.fixture
def state() -> RecordingState:
    return RecordingState()


@pytest.fixture
def device(state: RecordingState) -> RecorderDevice:
    return RecorderDevice(state, "arm-1", "wave")


def test_word_counts_in_the_stage_that_it_fits_and_is_the_keys(state: RecordingState, device: RecorderDevice) -> None:
    state.wait_for_begin(None)
    assert not is_error(device.begin_episode())
    assert state.words.said() is Said.SUCCESS
    state.enter(Stage.RECORDING, lambda: {"seconds": 1.5})
    assert not is_error(device.keep_episode(success=False))
    assert state.words.said() is Said.FAILURE
    state.wait_for_begin(None)
    assert not is_error(device.end_recording())
    assert state.words.said() is Said.END


@pytest.mark.parametrize(
    ("stage", "refused", "why"),
    [
        (Stage.OPENING, "end_recording", "the recording is opening."),
        (Stage.STARTING, "begin_episode", "beginEpisode is refused: the recording is starting."),
        (Stage.WAITING, "redo_episode", "waiting for Begin. beginEpisode and endRecording work now."),
        (Stage.RECORDING, "begin_episode", "recording. keepEpisode and redoEpisode and endRecording work now."),
        (Stage.ENDING, "redo_episode", "the recording is ending."),
        (Stage.SAVING, "redo_episode", "the recording is saving."),
        (Stage.OVER, "end_recording", "the recording is over."),
    ],
)
def test_word_at_another_moment_is_refused_by_the_stage(
    state: RecordingState, device: RecorderDevice, stage: Stage, refused: str, why: str
) -> None:
    state.enter(stage)
    answer = getattr(device, refused)()
    assert is_error(answer)
    assert why in text_of(answer)
    assert answer["state"] == stage.name.lower()
    assert state.words.said() is None


def test_second_press_waits_for_no_third_episode(state: RecordingState, device: RecorderDevice) -> None:
    state.enter(Stage.RECORDING)
    device.keep_episode(success=True)
    assert "the word before it is being carried out" in text_of(device.keep_episode(success=True))
    assert device.get_recording()["can"] == []
    state.wait_for_begin(None)
    assert state.words.said() is None, "what was said is of the attempt before"
    assert device.get_recording()["can"] == ["beginEpisode", "endRecording"]


def test_who_looks_sees_how_far_it_is(state: RecordingState, device: RecorderDevice) -> None:
    state.count(3, 1)
    state.note("episode 0 is saved")
    state.enter(Stage.RECORDING, lambda: {"seconds": 1.5, "frames": 45})
    told: dict[str, Any] = device.get_recording()
    assert (told["robot"], told["task"], told["state"]) == ("arm-1", "wave", "recording")
    assert told["said"] == "episode 0 is saved"
    assert (told["episode"], told["episodes"], told["seconds"], told["frames"]) == (2, 3, 1.5, 45)
    state.wait_for_begin(0.0)
    assert device.get_recording()["begins_in_s"] == 0
    assert device.get_task_status()["instruction"] == "episode 2 of 3, waiting for Begin"
    assert device.get_task_status()["task_status"] == "idle"


@pytest.mark.parametrize("stage", [each for each in Stage if each is not Stage.OVER])
def test_stop_of_a_recording_is_kept_whatever_its_stage(
    state: RecordingState, device: RecorderDevice, stage: Stage
) -> None:
    state.enter(stage)
    assert state.halted == ""
    device.halt("stop by desk")
    state.enter(Stage.SAVING)
    state.wait_for_begin(0.0)
    assert state.halted == "the recording was stopped: stop by desk"
    assert "the recording was stopped: stop by desk" in text_of(device.begin_episode())
    with pytest.raises(CliError, match="Nothing began: the recording was stopped: stop by desk"):
        state.check()


def test_stop_is_confirmed_once_the_robot_of_an_attempt_is_halted(
    state: RecordingState, device: RecorderDevice
) -> None:
    def asked() -> dict[str, Any]:
        raise AssertionError("a stop waits for no figures of the attempt")

    state.enter(Stage.STARTING)
    state.enter(Stage.RECORDING, asked)
    device.halt("stop by desk")
    for leads in (Stage.RECORDING, Stage.ENDING):
        state.enter(leads, asked)
        assert device.get_task_status()["task_status"] == "running"
    state.enter(Stage.SAVING)
    assert device.get_task_status()["task_status"] == "idle"


def test_stop_without_a_reason_is_told_in_a_whole_sentence(state: RecordingState, device: RecorderDevice) -> None:
    device.halt()
    assert state.halted == "the recording was stopped"
