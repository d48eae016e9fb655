"""The example of an agent with a model: a scripted model, a real arm in simulation, a real network on loopback."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.waiting import free_port

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.testing import ScriptedModel

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "agent_with_a_model.py"
pytestmark = [pytest.mark.timeout(300), pytest.mark.filterwarnings("ignore::DeprecationWarning")]


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("agent_with_a_model", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, patient_halts: None) -> Iterator[Any]:
    """An arm at its table, served on a loopback port that the tool uses too."""
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    robot = Robot("so100", scene="tabletop")
    runtime = init_device_connect_sync(robot, peer_id="arm-1", link=loopback_config())
    try:
        yield robot
    finally:
        stop_device_connect(runtime)
        robot.cleanup()


def turn(action: str, **more: Any) -> tuple[str, dict[str, Any]]:
    return "robot_mesh", {"action": action, "target": "arm-1", **more}


def test_model_sees_the_table_and_puts_the_cube_on_the_plate(
    example: ModuleType, table: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    model = ScriptedModel(
        [
            turn("picture", arguments={"camera": "table"}),
            turn("call", verb="getObjects"),
            turn("move", verb="pick", arguments={"object": "red_cube", "speed": 1.0}),
            turn("move", verb="place", arguments={"on": "plate", "speed": 1.0}),
            turn("wait"),
            "It stands on the plate.",
        ]
    )
    assert example.put_cube_on_plate(model) == 0
    assert "The cube stands on the plate." in capsys.readouterr().out
    assert "arm-1" in str(model.seen[0][0]), "the task names the arm"
    blocks = [block for message in model.seen[1] for block in message["content"] if "toolResult" in block]
    assert any("image" in part for block in blocks for part in block["toolResult"]["content"])


def test_model_that_only_says_it_did_so_is_not_believed(
    example: ModuleType, table: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert example.put_cube_on_plate(ScriptedModel(["It stands on the plate."])) == 1
    assert "The cube is not on the plate." in capsys.readouterr().out


def test_model_that_fails_midway_leaves_no_motion(
    example: ModuleType, table: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    pick = turn("move", verb="pick", arguments={"object": "red_cube", "wait": False})
    assert example.put_cube_on_plate(ScriptedModel([pick])) == 1  # it has no second turn
    assert table.list_policies_running() == []
    assert "the arm was stopped" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "none is configured"),
        (["NoSuchModel"], "NoSuchModel is no model of strands.models"),
        (["CacheConfig"], "CacheConfig is no model of strands.models"),
        (["BedrockModel", "model_id"], "must be key=value, not model_id"),
    ],
)
def test_missing_model_is_refused_before_anything_is_asked(arguments: list[str], words: str, tmp_path: Path) -> None:
    line = [sys.executable, EXAMPLE, *arguments]
    environment = Machine(tmp_path).environment
    run = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 2
    assert words in run.stderr
    assert "Traceback" not in run.stderr
