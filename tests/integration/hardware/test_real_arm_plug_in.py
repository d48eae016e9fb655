"""LeRobot's own plug-ins, served as they are: on the emulated bus, under real LeRobot."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.robot import Robot
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.system

CONFIG = """
from dataclasses import dataclass

from lerobot.robots import RobotConfig
from lerobot.robots.so_follower import SO101FollowerConfig


@RobotConfig.register_subclass("bench_arm")
@dataclass
class BenchArmConfig(SO101FollowerConfig):
    label: str = "plain"
"""
DRIVER = """
from lerobot.robots.so_follower import SO101Follower

from .config_bench_arm import BenchArmConfig


class BenchArm(SO101Follower):
    config_class = BenchArmConfig
    name = "bench_arm"
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Two of LeRobot's plug-ins on the path: one that works, one that is broken."""
    folder = tmp_path / "site"
    package = folder / "lerobot_robot_bench_arm"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("from .config_bench_arm import BenchArmConfig\n")
    (package / "config_bench_arm.py").write_text(CONFIG)
    (package / "bench_arm.py").write_text(DRIVER)
    broken = folder / "lerobot_robot_broken"
    broken.mkdir()
    (broken / "__init__.py").write_text("import a_vendors_driver\n")
    monkeypatch.syspath_prepend(folder)
    yield folder
    from lerobot.robots import RobotConfig  # noqa: PLC0415 - only where LeRobot is installed

    RobotConfig._choice_registry.pop("bench_arm", None)
    for name in [name for name in sys.modules if name.startswith("lerobot_robot_")]:
        del sys.modules[name]


def test_plug_in_of_lerobot_moves_and_halts(
    site: Path, bus: FeetechBus, calibration: Path, tmp_path: Path, patient_halts: None
) -> None:
    options: dict[str, Any] = {"port": bus.port, "calibration": calibration, "calibration_dir": tmp_path / "lerobot"}
    robot = Robot("lerobot:bench_arm", label="fast", **options)
    try:
        assert isinstance(robot, HardwareRobot)
        assert (robot.device.config.label, robot.tool_name_str) == ("fast", "bench_arm")
        assert "lerobot_robot_broken" not in sys.modules
        assert robot.start_task("wave", "mock", 10.0)["status"] == "success"
        eventually(lambda: [write for write in bus.writes if write.is_for("goal_position")])
        assert robot.halt("test").stopped is True
        after = len(bus.writes)
        assert robot.get_state()["joints"]
        assert not [write for write in bus.writes[after:] if write.is_for("goal_position")]
        assert robot.halt("again").stopped is True
    finally:
        robot.cleanup()


def test_broken_and_unknown_plug_ins_of_lerobot_are_named(site: Path) -> None:
    with pytest.raises(ValidationError, match=r"plug-in for 'broken' cannot be loaded: .*No module named 'a_vendors"):
        Robot("lerobot:broken")


def test_configuration_file_of_lerobot_is_read(
    site: Path, bus: FeetechBus, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from strands_robots.cli import serve  # noqa: PLC0415 - needs the command line's packages

    written = tmp_path / "bench.yaml"
    written.write_text(f"robot:\n  type: bench_arm\n  port: {bus.port}\n  label: slow\n  cameras: {{}}\n")
    options = serve.options_of_file(written, "lerobot:bench_arm")
    assert options == {"port": bus.port, "label": "slow", "cameras": {}}
    for text, reason in (("robot: [1]", "options by name"), ("type: other\n", "is for the type 'other'")):
        written.write_text(text)
        with pytest.raises(ValidationError, match=reason):
            serve.options_of_file(written, "lerobot:bench_arm")
    written.with_suffix(".json").write_text(json.dumps({"port": bus.port, "id": None}))
    assert serve.options_of_file(written.with_suffix(".json"), "lerobot:bench_arm")["id"] is None
