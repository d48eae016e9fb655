"""A stop's turn on the bus: its thread stands ready, and nobody who reads holds it up for longer than one exchange."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import DeviceBody, HardwareRobot


class SilentDevice(RecordingDevice):
    """Loses the answers to its next exchanges; each of them is waited for as ``wait`` does."""

    def __init__(self) -> None:
        super().__init__()
        self.lost = 0
        self.wait: Callable[[], object] = lambda: None
        self.began = 0

    def get_joints(self) -> dict[str, float]:
        self.began += 1
        if self.lost:
            self.lost -= 1
            self.wait()
            raise ConnectionError("no status packet")
        return dict(self.positions)


def stop_threads(name: str) -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == f"halt-{name}"]


def test_the_thread_of_the_stop_stands_ready_once_connected_and_goes_with_the_robot() -> None:
    robot = HardwareRobot(RecordingDevice(), "steady")
    assert stop_threads("steady") == []
    robot.connect()
    assert len(stop_threads("steady")) == 1
    for _ in range(3):
        assert robot.halt("test").stopped is True
    assert len(stop_threads("steady")) == 1
    robot.cleanup()
    eventually(lambda: not stop_threads("steady"))
    assert robot.halt("again").stopped is True, "a halt after the cleanup makes its thread anew"


def test_a_robot_that_nobody_cleans_up_takes_the_thread_along() -> None:
    robot = HardwareRobot(RecordingDevice(), "dropped")
    robot.connect()
    robot.halt("test")
    del robot
    gc.collect()
    eventually(lambda: not stop_threads("dropped"))


def test_a_read_that_lost_an_answer_gives_the_bus_to_a_stop_instead_of_asking_again() -> None:
    device = SilentDevice()
    body = DeviceBody("arm", device)
    asked, failed = threading.Event(), list[Exception]()

    def wait() -> None:
        asked.set()
        eventually(lambda: body.stop_waits, what="the stop, while the exchange is under way")

    device.lost, device.wait = 9, wait

    def read() -> None:
        try:
            body.get_joints()
        except ConnectionError as exc:
            failed.append(exc)

    reader = threading.Thread(target=read)
    reader.start()
    assert asked.wait(20)
    with body.stopping():
        assert device.began == 1, "the exchange that was under way, and no other"
    reader.join(20)
    assert len(failed) == 1


def test_a_stop_that_a_ctrl_c_cuts_off_leaves_the_bus_free_and_nobody_waiting_for_it() -> None:
    class CutOff:
        """The device's lock; a Ctrl-C comes while it is waited for."""

        def __enter__(self) -> None:
            raise KeyboardInterrupt

        def __exit__(self, *exc: object) -> None:
            raise AssertionError

    body = DeviceBody("arm", RecordingDevice())
    lock = body.lock
    body.lock = CutOff()
    with pytest.raises(KeyboardInterrupt), body.stopping():
        pass
    assert not body.stop_waits
    body.lock = lock
    with pytest.raises(KeyboardInterrupt), body.stopping():
        assert body.stop_waits
        raise KeyboardInterrupt
    assert not body.stop_waits
    taken = list[bool]()
    other = threading.Thread(target=lambda: taken.append(lock.acquire(timeout=20)))
    other.start()
    other.join(20)
    assert taken == [True]


def test_the_stop_itself_asks_again() -> None:
    device = SilentDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    device.lost = 2
    assert robot.halt("test").stopped is True
    assert device.writes
    robot.cleanup()
