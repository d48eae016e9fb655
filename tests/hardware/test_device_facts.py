"""Ports, identity, joint units and temperatures of a real robot."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.hardware.device_facts import check_port, require_port, serial_ports, stable_id
from strands_robots.utils import ValidationError


def test_ports_with_names_of_their_own_are_given_by_these(tmp_path: Path) -> None:
    assert serial_ports(tmp_path) == []
    for name in ("ttyACM1", "ttyACM0", "ttyUSB0", "ttyS0"):
        (tmp_path / name).touch()
    assert serial_ports(tmp_path) == [str(tmp_path / "ttyACM0"), str(tmp_path / "ttyACM1")]
    named = tmp_path / "serial" / "by-id" / "usb-1a86_58FD-if00"
    named.parent.mkdir(parents=True)
    named.touch()
    assert serial_ports(tmp_path) == [str(named)]


def test_a_port_is_needed_only_where_the_robot_says_so() -> None:
    check_port("so101", "/dev/ttyACM0", needed=True)
    check_port("so101", None, needed=False)
    for port in (None, "", "  ", 5, True):
        with pytest.raises(ValidationError, match="so101 needs port"):
            check_port("so101", port, needed=True)


def test_a_path_with_nothing_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "arm").touch()
    for fine in (str(tmp_path / "arm"), "COM3", 50065, None):
        require_port(SimpleNamespace(config=SimpleNamespace(port=fine)))
    require_port(object())
    with pytest.raises(ConnectionError, match=r"the port .*/leg is not there"):
        require_port(SimpleNamespace(config=SimpleNamespace(port=str(tmp_path / "leg"))))


def device(**config: Any) -> Any:
    return SimpleNamespace(id=config.get("id"), config=SimpleNamespace(**config))


@pytest.fixture
def by_id(tmp_path: Path) -> Path:
    folder = tmp_path / "by-id"
    folder.mkdir()
    (tmp_path / "ttyACM0").touch()
    (folder / "usb-1a86_5A46083062-if00").symlink_to(tmp_path / "ttyACM0")
    return folder


def test_a_serial_adapter_is_known_wherever_it_is_plugged_in(by_id: Path) -> None:
    adapter = "usb-1a86_5A46083062-if00"
    assert stable_id(device(port=str(by_id.parent / "ttyACM0"), id="left"), by_id) == adapter
    assert stable_id(device(port=str(by_id / adapter)), by_id) == adapter


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"remote_ip": "10.0.0.7", "id": "base"}, "10.0.0.7"),
        ({"port": "/dev/ttyS9", "id": "left"}, "left@/dev/ttyS9"),
        ({"port": "/dev/ttyS9"}, "/dev/ttyS9"),
        ({"id": "left"}, "left"),
        ({}, None),
        ({"id": " ", "port": 3}, None),
    ],
)
def test_else_it_is_the_host_or_the_calibration_id(by_id: Path, config: dict[str, Any], expected: str | None) -> None:
    assert stable_id(device(**config), by_id) == expected


def test_a_machine_without_serial_ports_is_no_error(tmp_path: Path) -> None:
    assert stable_id(device(port="/dev/ttyS9", id="left"), tmp_path / "nowhere") == "left@/dev/ttyS9"


def test_a_robot_has_the_key_of_its_hardware_whatever_it_is_called() -> None:
    keys = set()
    for name in ("arm-1", "arm-2"):
        arm = RecordingDevice()
        arm.config = SimpleNamespace(id="left", port="/dev/ttyS9")  # type: ignore[attr-defined]  # as LeRobot has it
        keys.add(HardwareRobot(arm, name).safety_key)
    assert keys == {"hardware:recorder:left@/dev/ttyS9"}
    assert not HardwareRobot(RecordingDevice(), "arm").safety_key


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
