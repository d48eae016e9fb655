"""Currents of a body's motors: one try that fails no motion and delays a stop by one exchange at most."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import DeviceBody


class CurrentDevice(RecordingDevice):
    """Tells currents by ``answer``, and writes down its exchanges in their order."""

    def __init__(self, answer: Callable[[], dict[str, float]]) -> None:
        super().__init__()
        self.answer = answer
        self.log: list[str] = []

    def get_currents(self) -> dict[str, float]:
        self.log.append("currents")
        return self.answer()

    def hold(self) -> None:
        self.log.append("hold")


def connected(device: RecordingDevice) -> DeviceBody:
    body = DeviceBody("arm", device)
    body.connect()
    return body


def test_body_tells_the_currents_of_its_device() -> None:
    assert connected(CurrentDevice(lambda: {"pan.pos": 0.4})).get_currents() == {"pan.pos": 0.4}
    assert connected(RecordingDevice()).get_currents() == {}


@pytest.mark.parametrize("failure", [ConnectionError("no status packet"), RuntimeError("overload"), KeyError("pan")])
def test_lost_currents_are_asked_for_once_and_logged_once(failure: Exception, caplog: pytest.LogCaptureFixture) -> None:
    def lost() -> dict[str, float]:
        raise failure

    device = CurrentDevice(lost)
    body = connected(device)
    with caplog.at_level(logging.WARNING):
        assert body.get_currents() == body.get_currents() == {}
    assert device.log == ["currents", "currents"]
    assert len([each for each in caplog.records if "did not tell the currents" in each.message]) == 1


def test_stop_waits_for_one_exchange_of_currents_and_no_other_begins() -> None:
    reading, answered = threading.Event(), threading.Event()

    def slow() -> dict[str, float]:
        reading.set()
        assert answered.wait(10)
        return {"pan.pos": 0.4}

    device = CurrentDevice(slow)
    body = connected(device)
    reader = threading.Thread(target=body.get_currents)
    reader.start()
    assert reading.wait(10)
    stop = threading.Thread(target=body.stop)
    stop.start()
    eventually(lambda: body.stop_waits, what="the stop at the bus")
    assert body.get_currents() == {}, "a stop waits for the bus"
    answered.set()
    for thread in (reader, stop):
        thread.join(10)
        assert not thread.is_alive()
    assert device.log == ["currents", "hold"]
