"""Importing LeRobot's drivers without torch: what stands in, for how long, and never where torch is."""

from __future__ import annotations

import importlib.machinery
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from strands_robots.hardware import _compat, lerobot_device
from strands_robots.hardware.lerobot_device import make_device

STANDINS = ("torch", "accelerate", "datasets", "datasets.utils.logging")
DRIVER = """
import torch
from accelerate import Accelerator
from datasets.utils.logging import disable_progress_bar, enable_progress_bar


def where() -> torch.device:
    import torch

    return torch.device()
"""


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory on the import path; what is imported of it is forgotten."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "arm_driver.py").write_text(DRIVER, encoding="utf-8")
    (tmp_path / "broken_driver.py").write_text(DRIVER + "\nimport no_such_module_at_all\n", encoding="utf-8")
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_without_torch_a_driver_is_imported_and_no_stand_in_is_left(packages: Path) -> None:
    if not _compat.light():
        pytest.skip("torch is installed here")
    driver = _compat.lerobot_module("arm_driver")
    assert driver.torch.__spec__.loader is None
    assert not set(STANDINS) & set(sys.modules)
    with pytest.raises(ModuleNotFoundError):
        driver.where()


def test_no_stand_in_is_left_by_an_import_that_fails(packages: Path) -> None:
    if not _compat.light():
        pytest.skip("torch is installed here")
    with pytest.raises(ModuleNotFoundError, match="no_such_module_at_all"):
        _compat.lerobot_module("broken_driver")
    assert not set(STANDINS) & set(sys.modules)


def test_where_torch_is_installed_nothing_stands_in(packages: Path) -> None:
    for name in ("torch", "accelerate"):
        (packages / f"{name}.py").write_text("real = True\n\nclass device: ...\n\nclass Accelerator: ...\n")
    assert not _compat.light()
    with pytest.raises(ModuleNotFoundError, match="datasets"):
        _compat.lerobot_module("arm_driver")
    assert isinstance(sys.modules["torch"].__spec__, importlib.machinery.ModuleSpec)
    assert sys.modules["torch"].real


def test_a_device_without_a_serial_port_is_never_unplugged() -> None:
    assert not _compat.unplugged(object())
    _compat.drop(object())


def test_lerobot_repeats_no_read_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass
    class Config:
        """A configuration as LeRobot has them from 0.6 on."""

        id: str | None = None
        num_read_retries: int = 2

    registry = SimpleNamespace(get_known_choices=lambda: {"arm_follower": Config})
    devices = SimpleNamespace(__path__=[], __name__="robots", RobotConfig=registry)
    devices.make_robot_from_config = lambda config: SimpleNamespace(config=config)
    monkeypatch.setattr(lerobot_device, "lerobot_module", lambda name: devices)
    assert make_device("arm", {}, calibrated=False).config.num_read_retries == 0
    assert make_device("arm", {"num_read_retries": 1}, calibrated=False).config.num_read_retries == 1


def test_robot_is_found_by_the_name_of_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass
    class Config:
        id: str | None = None

    registry = SimpleNamespace(get_known_choices=lambda: {"lerobot_robot_viola": Config})
    devices = SimpleNamespace(__path__=[], __name__="robots", RobotConfig=registry)
    devices.make_robot_from_config = lambda config: SimpleNamespace(config=config)
    monkeypatch.setattr(lerobot_device, "lerobot_module", lambda name: devices)
    assert make_device("viola", {}, calibrated=False).config.id == "viola"


def test_driver_may_keep_something_else_where_lerobot_keeps_its_port() -> None:
    handler = SimpleNamespace(ser=SimpleNamespace(ConnectPort=None), is_open=False)
    device = SimpleNamespace(bus=SimpleNamespace(port_handler=handler))
    _compat.forget_input(device)
    assert not _compat.unplugged(device)
