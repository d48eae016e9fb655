"""A recording on the page: how far it is, and a button for each word that fits."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.page_driving import card
from fixtures.page_feed import forms_of
from fixtures.page_site import picture
from fixtures.served_page import ServedPage
from fixtures.waiting import eventually

from strands_robots.cli.recorder_device import RecorderDevice
from strands_robots.cli.recording_state import RecordingState, Stage
from strands_robots.envelope import error, success
from strands_robots.serving.offered_verbs import own_verbs
from strands_robots.serving.verbs import described

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WORDS = ("Begin", "Keep as success", "Keep as failure", "Redo", "End")


class Recording:
    """A recording whose device answers the page."""

    def __init__(self, served: ServedPage) -> None:
        self.served, self.state = served, RecordingState()
        self.device = RecorderDevice(self.state, "arm-1", "put the cube on the plate")
        functions = [described(each) for each in own_verbs(self.device).values()]
        served.robot("recorder-arm-1", kind="recorder", model="recorder", forms=forms_of(functions))

    def tell(self) -> None:
        self.served.feed.answers["getRecording"] = [success("", **self.device.get_recording())]
        status = self.device.get_task_status()
        self.served.model.task("dc", "recorder-arm-1", state="idle", instruction=status["instruction"])


def button(page: Any, name: str) -> Any:
    return page.locator(".recorder").get_by_role("button", name=name, exact=True)


def works(page: Any, *names: str) -> None:
    """Wait until these buttons work, and no other word."""

    def working() -> list[str]:
        return [name for name in WORDS if button(page, name).is_enabled()]

    eventually(lambda: working() == list(names), 30.0, what=str(names))


def test_page_shows_a_recording_and_sends_each_word_that_fits(page: Any, served: ServedPage) -> None:
    recording = Recording(served)
    recording.state.count(50, 2)
    recording.state.wait_for_begin(None)
    recording.tell()
    shown = card(page, "recorder-arm-1")
    shown.locator(".task", has_text="episode 3 of 50, waiting for Begin").wait_for(timeout=30_000)
    assert shown.locator(".halt").is_visible(), "no robot hides its stop by what it says"
    shown.locator("a.name").click()
    works(page, "Begin", "End")
    page.get_by_text("Put things back, then press Begin.").wait_for()
    assert page.locator("button.verb[data-verb='redoEpisode'] .does").inner_text() == "own, changes"
    picture(page, "recording-waits")
    button(page, "Begin").click()
    eventually(lambda: served.feed.asked("beginEpisode") == [{}], what="the word")
    figures = {"seconds": 12.34, "frames": 370, "hz": 29.96}
    recording.state.enter(Stage.RECORDING, lambda: figures)
    recording.state.note("episode 1 is saved: 149 frames, a success.")
    recording.tell()
    works(page, "Keep as success", "Keep as failure", "Redo", "End")
    page.get_by_text("12.3\u00a0s \u00b7 370\u00a0frames \u00b7 30.0\u00a0Hz").wait_for()
    picture(page, "recording-runs")
    assert not page.locator(".panel.drive").is_visible()
    for name in ("Keep as success", "Keep as failure"):
        button(page, name).click()
        works(page, "Keep as success", "Keep as failure", "Redo", "End")
    assert served.feed.asked("keepEpisode") == [{"success": True}, {"success": False}]
    recording.state.wait_for_begin(None)
    served.feed.answers["redoEpisode"] = [recording.device.redo_episode()]
    button(page, "Redo").click()
    page.get_by_text("redoEpisode is refused: the recording is waiting for Begin").wait_for()
    served.feed.answers["getRecording"] = [error("No device 'recorder-arm-1' in tenant 'default'.")]
    page.get_by_text("The recording does not answer. It is over, or out of reach.").wait_for()
    works(page)
    assert page.get_by_text("episode 1 is saved: 149 frames, a success.").is_visible()


def test_robot_that_calls_itself_a_recorder_is_driven_and_stopped_as_any(page: Any, served: ServedPage) -> None:
    served.robot("arm-9", kind="recorder", model="so100")
    card(page, "arm-9").locator("a.name").click()
    page.locator(".panel.drive").wait_for(timeout=30_000)
    assert not page.locator(".panel.recorder").is_visible()
