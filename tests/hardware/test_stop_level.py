"""What a halt does to torque: as the setting says, where the robot was told nothing else."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from fixtures.devices import RecordingDevice

from strands_robots.hardware import HardwareRobot
from strands_robots.utils import ValidationError


class LimpDevice(RecordingDevice):
    """Notes the motors whose torque was taken off."""

    def __init__(self) -> None:
        super().__init__()
        self.limp: list[str] = []
        self.bus = SimpleNamespace(motors={"pan": 1, "lift": 2}, disable_torque=self.limp.append)


@pytest.mark.parametrize(("word", "limp"), [("limp", ["pan", "lift"]), ("hold", []), ("", []), ("floppy", [])])
def test_a_halt_takes_torque_off_only_where_the_setting_says_limp(
    monkeypatch: pytest.MonkeyPatch, word: str, limp: list[str]
) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", word)
    device = LimpDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    assert robot.halt("test").stopped is True
    assert device.limp == limp


def test_what_a_robot_was_told_outranks_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    device = LimpDevice()
    robot = HardwareRobot(device, "arm", stop_level="hold")
    robot.connect()
    assert robot.halt("test").stopped is True
    assert device.limp == []


def test_a_robot_that_cannot_go_limp_is_not_made_to_believe_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    with pytest.raises(ValidationError, match="STRANDS_ESTOP_TORQUE"):
        HardwareRobot(RecordingDevice(), "arm")
