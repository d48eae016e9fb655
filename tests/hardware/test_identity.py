"""A robot's lockout is kept under what stays of its hardware."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RecordingDevice

from strands_robots.hardware import HardwareRobot
from strands_robots.hardware.identity import stable_id


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
