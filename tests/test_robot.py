"""The factory: a running robot by its name, or a refusal that gives the reason."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.installed import install
from fixtures.waiting import eventually

import strands_robots
from strands_robots import HardwareRobot, Robot, Simulation
from strands_robots.contract import TaskRobot, WorldRobot
from strands_robots.moved import METHODS
from strands_robots.utils import MissingExtraError, ValidationError, missing_extra


@dataclass
class _Config:
    port: str = ""
    cameras: dict[str, Any] = field(default_factory=dict)


class _Registry:
    @staticmethod
    def get_known_choices() -> dict[str, Any]:
        return {"so100_follower": _Config, "lekiwi": _Config}


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[_Config]]:
    """A stand-in for ``lerobot.robots`` with the three names that the factory uses."""
    configs: list[_Config] = []

    def make(config: _Config) -> RecordingDevice:
        configs.append(config)
        return RecordingDevice()

    robots = ModuleType("lerobot.robots")
    robots.__path__ = []
    robots.RobotConfig = _Registry  # type: ignore[attr-defined]
    robots.make_robot_from_config = make  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lerobot", ModuleType("lerobot"))
    monkeypatch.setitem(sys.modules, "lerobot.robots", robots)
    return configs


def test_scene_puts_its_objects_before_the_robot() -> None:
    robot = Robot("so100", scene="tabletop")
    try:
        objects = robot.get_objects()["objects"]
        assert list(objects) == ["table", "plate", "red_cube"]
        robot.step(500)
        # They stand where they were put.
        after = robot.get_objects()["objects"]
        for name in objects:
            for axis in "xyz":
                assert after[name][axis] == pytest.approx(objects[name][axis], abs=0.001), name
    finally:
        robot.cleanup()


@pytest.mark.parametrize("scene", ["kitchen", 3, ["tabletop"]])
def test_unknown_scene_is_refused_by_name(scene: object) -> None:
    with pytest.raises(ValidationError, match="scene must be one of tabletop"):
        Robot("so100", scene=scene)


def test_name_makes_a_running_simulation_with_that_robot() -> None:
    robot = Robot("so100", peer_id="bench-1")
    try:
        assert isinstance(robot, Simulation)
        assert isinstance(robot, WorldRobot)
        assert robot.list_robots() == ["so100"]
        assert (robot.tool_name_str, robot.peer_id, robot.mesh) == ("so100", "bench-1", None)
        assert robot.start_policy("so100", "wave", duration=0.2)["status"] == "success"
        eventually(lambda: not robot.list_policies_running())
    finally:
        robot.cleanup()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"name": "so10"}, "near it: so101, so100"),
        ({"name": ""}, "name must be"),
        ({"name": 5}, "name must be"),
        ({"name": "nope/arm.xml"}, "nope/arm.xml"),
        ({"name": "so100", "mode": "dream"}, "mode must be one of sim, real"),
        ({"name": "so100", "mesh": "yes"}, "mesh must be"),
        ({"name": "so100", "peer_id": "a/b"}, "peer_id must be"),
        ({"name": "so100", "bogus": 1}, "bogus"),
        ({"name": "so100", "timestep": float("nan")}, "timestep must be"),
    ],
    ids=str,
)
def test_bad_argument_is_refused_by_name(arguments: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Robot(**arguments)


def test_missing_lerobot_is_reported_with_the_extra() -> None:
    with pytest.raises(MissingExtraError, match=r"\[lerobot\] extra"):
        Robot("so100", mode="real")


@pytest.mark.parametrize(
    ("name", "said"),
    [("so100", "^Simulation needs"), ("my_robot", "^There is no robot 'my_robot' of an installed package")],
)
def test_missing_simulation_is_reported_beside_a_robot_that_no_package_has(
    name: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class WithoutMujoco(ModuleType):
        @property
        def Simulation(self) -> Any:
            raise missing_extra("Simulation", "sim")

    monkeypatch.setitem(sys.modules, "strands_robots.simulation", WithoutMujoco("strands_robots.simulation"))
    with pytest.raises(MissingExtraError, match=said):
        Robot(name)


def test_real_robot_is_configured_and_connected_without_calibration(stand_in: list[_Config]) -> None:
    robot = Robot("so100", mode="real", port="/dev/ttyACM0", control_hz=100)
    assert isinstance(robot, HardwareRobot)
    assert isinstance(robot, TaskRobot)
    assert stand_in == [_Config(port="/dev/ttyACM0")]
    assert robot.device.is_connected
    assert robot.control_hz == 100
    robot.cleanup()


def test_unknown_real_robot_is_refused_with_similar_names(stand_in: list[_Config]) -> None:
    with pytest.raises(ValidationError, match="near it: so100_follower"):
        Robot("so100_folower", mode="real")
    with pytest.raises(ValidationError, match="do not configure"):
        Robot("lekiwi", mode="real", speed=3)


def test_package_import_loads_no_heavy_module() -> None:
    code = (
        "import sys, strands_robots; assert strands_robots.__version__;"
        "heavy = {'numpy', 'mujoco', 'zenoh', 'nats', 'pydantic', 'websockets', 'device_connect_edge'};"
        "heavy &= set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


def test_every_public_name_exists_and_no_other() -> None:
    for name in strands_robots.__all__:
        assert getattr(strands_robots, name) is not None
    assert dir(strands_robots) == sorted(strands_robots.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Robots'"):
        _ = strands_robots.Robots


def test_tip_of_a_model_is_the_site_or_body_that_the_caller_names() -> None:
    robot = Robot("so100", tip="wrist")
    assert robot.body().parts.tip == "so100/tip"
    robot.cleanup()
    with pytest.raises(ValidationError, match=r"tip must be a site or a body of .*gripper_tip, .*, not 'claw'"):
        Robot("so100", tip="claw")


def test_robot_given_to_an_agent_as_a_tool_says_which_tool_to_give() -> None:
    registry = pytest.importorskip("strands.tools.registry").ToolRegistry()
    robot = Robot("so100")
    try:
        with pytest.raises(ValueError, match=r"no agent tool.*from strands_robots\.tools import robot_mesh"):
            registry.process_tools([robot])
        with pytest.raises(TypeError, match="robot_mesh"):
            robot(action="list_robots")
    finally:
        robot.cleanup()


def test_method_of_an_earlier_release_is_absent_and_says_what_to_use() -> None:
    robot = Robot("so100")
    try:
        for name, instead in METHODS.items():
            if name != "run_policy":  # a real robot has none
                assert not hasattr(robot, name)
                with pytest.raises(AttributeError) as refused:
                    getattr(robot, name)
                assert str(refused.value) == f"{name} of a robot is not in this release: {instead}."
        assert not hasattr(robot, "never_was")
        with pytest.raises(AttributeError, match=r"^'Robot' object has no attribute 'never_was'$"):
            _ = robot.never_was
    finally:
        robot.cleanup()


def test_property_of_a_robot_that_fails_tells_its_own_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = """
    class Body:
        @property
        def size(self): raise AttributeError("no ruler")
        def halt(self, reason=""): return {"status": "success"}
    """
    install(tmp_path, "failing-robot", dedent(source), {"strands_robots.robots": {"failing": "failing_robot:Body"}})
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AttributeError, match="no ruler"):
        _ = Robot("failing").size


def test_robot_of_a_package_that_can_be_called_and_iterated_over_keeps_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = """
    class Body:
        def __call__(self): return "called"
        def __iter__(self): return iter(["part"])
        def halt(self, reason=""): return {"status": "success"}
    """
    install(tmp_path, "callable-robot", dedent(source), {"strands_robots.robots": {"caller": "callable_robot:Body"}})
    monkeypatch.syspath_prepend(tmp_path)
    robot = Robot("caller")
    assert robot() == "called"
    assert list(robot) == ["part"]


_PACKAGE = """
import dataclasses


class Plain:
    made = None

    @classmethod
    def again(cls):
        cls.made = cls.made or cls()
        return cls.made


class Slotted:
    __slots__ = ()


@dataclasses.dataclass(frozen=True)
class Frozen:
    width: float = 1.0
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package with robots of four kinds."""
    parts = {"plain": "Plain", "again": "Plain.again", "slotted": "Slotted", "frozen": "Frozen", "number": "Plain.mro"}
    entries = {name: f"robots_of_a_test:{reference}" for name, reference in parts.items()}
    install(tmp_path, "robots-of-a-test", _PACKAGE, {"strands_robots.robots": entries})
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("robots_of_a_test", None)


def test_robot_of_a_package_has_an_identity_and_a_mesh(package: None) -> None:
    robot = Robot("plain", peer_id="mine", tags="mobile")
    assert type(robot).__mro__[2].__name__ == "Plain"
    assert (robot.peer_id, robot.tags, robot.mesh, robot.tool_name_str) == ("mine", ("mobile",), None, "plain")
    assert robot.cleanup()["status"] == "error", "it has no way to halt, and says so"


@pytest.mark.parametrize("name", ["slotted", "frozen", "number"])
def test_object_that_cannot_be_given_an_identity_is_refused_by_name(package: None, name: str) -> None:
    with pytest.raises(ValidationError, match=f"robot {name} of robots-of-a-test 1.0 must make an object of a class"):
        Robot(name)


def test_package_that_makes_one_robot_twice_is_refused(package: None) -> None:
    Robot("again")
    with pytest.raises(ValidationError, match="must make a new robot at each call"):
        Robot("again")
