"""Arms of emulated servos under LeRobot's real driver, where that is installed (`make real-arm`)."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus, arm_servos, write_calibration
from fixtures.feetech_bus.patience import be_patient

Arm = Callable[..., Any]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Name the reason where LeRobot is missing; its environment is another one than that of the other tests."""
    if importlib.util.find_spec("lerobot") is None:
        for item in items:
            if "real_arm" in Path(item.path).name:
                item.add_marker(pytest.mark.skip(reason="needs LeRobot's driver: make real-arm"))


@pytest.fixture(autouse=True, scope="session")
def lerobot_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """LeRobot keeps calibrations in a directory that it reads from the environment when it is imported."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_LEROBOT_HOME", str(tmp_path_factory.mktemp("lerobot-home")))
        yield


@pytest.fixture(autouse=True, scope="session")
def patience() -> None:
    """A busy machine may hold the emulated servos up for longer than LeRobot waits."""
    if importlib.util.find_spec("lerobot") is not None:
        be_patient()


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[FeetechBus]:
    """Six calibrated servos on a port that keeps its name."""
    with FeetechBus(arm_servos(), link=tmp_path / "arm") as bus:
        yield bus


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """The file that goes with ``bus``."""
    return write_calibration(tmp_path / "calibration" / "bench.json")


@pytest.fixture
def arm(bus: FeetechBus, calibration: Path, tmp_path: Path, patient_halts: None) -> Iterator[Arm]:
    """Makes real robots on ``bus`` and lets go of them at the end."""
    from strands_robots.robot import Robot  # noqa: PLC0415 - the one place that needs it

    made: list[Any] = []

    def make(**options: Any) -> Any:
        given = {"port": bus.port, "calibration": calibration, "calibration_dir": tmp_path / "lerobot"}
        robot = Robot("so101", mode="real", **{**given, **options})
        made.append(robot)
        return robot

    yield make
    for robot in made:
        robot.cleanup()
