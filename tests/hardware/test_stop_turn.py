"""A stop's turn on the bus: its thread stands ready, and nobody who reads holds it up for longer than one exchange."""

from __future__ import annotations

import gc
import threading
import time

from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import DeviceBody, HardwareRobot


class SilentDevice(RecordingDevice):
    """Gives no answer: each exchange is waited for and then lost."""

    PATIENCE_S = 0.1

    def __init__(self) -> None:
        super().__init__()
        self.silent = False
        self.asked = threading.Event()
        self.began = 0

    def get_joints(self) -> dict[str, float]:
        self.began += 1
        self.asked.set()
        if self.silent:
            time.sleep(self.PATIENCE_S)
            raise ConnectionError("no status packet")
        return dict(self.positions)


def freezers(name: str) -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == f"freeze-{name}"]


def test_the_thread_of_the_stop_stands_ready_once_connected_and_goes_with_the_robot() -> None:
    robot = HardwareRobot(RecordingDevice(), "steady")
    assert freezers("steady") == []
    robot.connect()
    assert len(freezers("steady")) == 1
    for _ in range(3):
        assert robot.halt("test").stopped is True
    assert len(freezers("steady")) == 1
    robot.cleanup()
    eventually(lambda: not freezers("steady"))
    assert robot.halt("again").stopped is True, "a halt after the cleanup makes its thread anew"


def test_a_robot_that_nobody_cleans_up_takes_the_thread_along() -> None:
    robot = HardwareRobot(RecordingDevice(), "dropped")
    robot.connect()
    robot.halt("test")
    del robot
    gc.collect()
    eventually(lambda: not freezers("dropped"))


def test_a_read_that_lost_an_answer_gives_the_bus_to_a_stop_instead_of_asking_again() -> None:
    device = SilentDevice()
    body = DeviceBody("arm", device)
    device.silent = True
    failed: list[Exception] = []

    def read() -> None:
        try:
            body.get_joints()
        except ConnectionError as exc:
            failed.append(exc)

    reader = threading.Thread(target=read)
    reader.start()
    assert device.asked.wait(5)
    with body.stopping():
        assert device.began == 1, "the exchange that was under way, and no other"
        device.silent = False
    reader.join(5)
    assert len(failed) == 1


def test_the_stop_itself_asks_again() -> None:
    device = SilentDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    device.silent = True
    threading.Timer(1.5 * SilentDevice.PATIENCE_S, lambda: setattr(device, "silent", False)).start()
    assert robot.halt("test").stopped is True
    assert device.writes
    robot.cleanup()
