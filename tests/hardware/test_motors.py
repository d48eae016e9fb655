"""What a real robot tells of its motors: units and temperatures where they are known, nothing where they are not."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot

MODES = {"pan": "RANGE_M100_100", "lift": "DEGREES", "grip": "RANGE_0_100"}


class Bus:
    """A motor bus as LeRobot has it: motors with their mode and model, register tables, one read for all."""

    def __init__(self, *, registers: tuple[str, ...] = ("Present_Position", "Present_Temperature")) -> None:
        self.motors = {
            name: SimpleNamespace(norm_mode=SimpleNamespace(name=mode), model="sts3215") for name, mode in MODES.items()
        }
        self.model_ctrl_table = {"sts3215": dict.fromkeys(registers, (56, 2))}
        self.silent = False

    def sync_read(self, register: str, *, normalize: bool = True) -> dict[str, Any]:
        if self.silent:
            raise ConnectionError("no answer of grip")
        assert normalize or register == "Present_Temperature"
        return dict.fromkeys(self.motors, 31 if register == "Present_Temperature" else 0.0)


class Arm(RecordingDevice):
    """A device with a motor bus."""

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self.bus = bus


def connected(bus: Bus) -> HardwareRobot:
    robot = HardwareRobot(Arm(bus), "arm")
    robot.connect()
    return robot


def test_a_key_has_the_unit_of_its_motor() -> None:
    robot = connected(Bus())
    assert robot.joint_units == {"pan.pos": "normalized", "lift.pos": "degrees", "grip.pos": "percent"}
    assert robot.hardware_name == "recorder"
    robot.cleanup()


def test_a_unit_that_nobody_states_is_left_out_and_the_devices_own_comes_first() -> None:
    device = RecordingDevice()
    robot = HardwareRobot(device, "arm")
    assert robot.joint_units == {}
    device.joint_units = {"pan.pos": "radians"}  # type: ignore[attr-defined]  # a device that states its units
    assert robot.joint_units == {"pan.pos": "radians"}


def test_the_motors_temperatures_are_told_where_they_have_the_register() -> None:
    robot = connected(Bus())
    assert robot.get_health()["temps"] == {"pan": 31.0, "lift": 31.0, "grip": 31.0}
    robot.cleanup()
    cold = connected(Bus(registers=("Present_Position",)))
    assert "temps" not in cold.get_health()
    cold.cleanup()


def test_a_bus_that_does_not_answer_tells_no_temperature() -> None:
    bus = Bus()
    robot = connected(bus)
    bus.silent = True
    assert "no answer of grip" in robot.get_health()["reason"]
    bus.silent = False
    robot.cleanup()
    assert "temps" not in robot.get_health()


def test_a_busy_bus_is_not_waited_for() -> None:
    robot, held, done = connected(Bus()), threading.Event(), threading.Event()

    def hold() -> None:
        with robot.body().lock:
            held.set()
            done.wait(60)

    holder = threading.Thread(target=hold)
    holder.start()
    assert held.wait(20)
    assert "busy" in robot.get_health()["reason"]
    done.set()
    holder.join()
    robot.cleanup()


def test_a_read_of_temperatures_that_gets_the_bus_gives_it_to_a_stop_that_waits() -> None:
    bus = Bus()
    robot = connected(bus)
    halter = threading.Thread(target=robot.halt)
    # Re-entrant: the read below gets its turn while the stop waits for this one to end.
    with robot.body().lock:
        halter.start()
        eventually(lambda: robot.body().stop_waits)
        bus.silent = True
        assert "A stop waits" in robot.get_health()["reason"]
        bus.silent = False
    halter.join()
    # The stop's thread may still be about to let go of the bus.
    eventually(lambda: "temps" in robot.get_health())
    robot.cleanup()
