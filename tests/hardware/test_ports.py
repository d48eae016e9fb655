"""What is said of serial ports that are not there."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from strands_robots.hardware.ports import check_port, require_port, serial_ports
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
