"""``teleop`` as a command, on a simulated follower."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.leaders import write_csv
from tests.cli.conftest import Run

from strands_robots.cli.network import one_robot
from strands_robots.utils import ValidationError


def test_recording_leads_a_simulated_arm_to_its_end(run: Run, tmp_path: Path) -> None:
    frames = [(0.02 * step, {"shoulder_pan": 0.004 * step}) for step in range(100)]
    write_csv(tmp_path / "run.csv", frames)
    result = run("teleop", str(tmp_path / "run.csv"), "so100", "--json")
    assert result.exit_code == 0, result.output
    ended = json.loads(result.stdout)
    assert ended["state"] == "completed"
    assert ended["stopped"] is True
    assert ended["frames"] >= 10


def test_unusable_leader_is_refused_by_name(run: Run, tmp_path: Path) -> None:
    for leader, reason in (("no-such-leader", "recording"), (str(tmp_path / "none.csv"), "cannot be read")):
        result = run("teleop", leader, "so100", "--no-network", "--json")
        assert result.exit_code == 2
        assert reason in json.loads(result.stdout)["reason"]


def test_keyboard_is_refused_without_a_terminal(run: Run) -> None:
    result = run("teleop", "keyboard", "so100", "--no-network", "--json")
    assert result.exit_code != 0


def test_unknown_real_follower_is_refused(run: Run) -> None:
    result = run("teleop", "keyboard", "no-such-arm@/dev/ttyACM0", "--json")
    assert result.exit_code in (1, 2)


def test_robot_that_no_leader_can_lead_is_refused_by_name_and_let_go(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    let_go: list[str] = []
    barista = SimpleNamespace(tool_name_str="barista", cleanup=lambda: let_go.append("barista"))
    monkeypatch.setattr("strands_robots.robot.Robot", lambda *_, **__: barista)
    result = run("teleop", "keyboard", "barista", "--no-network", "--json")
    assert result.exit_code == 2
    assert "barista has no attach_teleop" in json.loads(result.stdout)["reason"]
    assert let_go == ["barista"]


@pytest.mark.parametrize("line", [("replay", "FILE", "--to", "arm-1"), ("teleop", "FILE", "arm-1")])
def test_follower_of_another_process_takes_no_option_of_one_here(
    run: Run, tmp_path: Path, line: tuple[str, ...]
) -> None:
    write_csv(tmp_path / "run.csv", [(0.0, {"shoulder_pan": 0.0})])
    words = [str(tmp_path / "run.csv") if word == "FILE" else word for word in line]
    result = run(*words, "--peer-id", "arm-2", "--json")
    assert result.exit_code == 2
    assert "arm-1 is served elsewhere" in json.loads(result.stdout)["reason"]
    result = run(*words, "--no-network", "--json")
    assert result.exit_code == 2
    assert "is led by its id, over a network" in json.loads(result.stdout)["reason"]


@pytest.mark.parametrize(
    ("line", "argument"), [(("replay", "FILE", "--to", "cell"), "--to"), (("teleop", "FILE", "cell"), "FOLLOWER")]
)
def test_world_of_several_robots_is_led_only_where_one_is_named(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: tuple[str, ...], argument: str
) -> None:
    world = SimpleNamespace(id="cell", robots={"left": None, "right": None})
    monkeypatch.setattr("strands_robots.cli.teleop.reached", lambda *_: nullcontext((None, world)))
    write_csv(tmp_path / "run.csv", [(0.0, {"shoulder_pan": 0.0})])
    result = run(*(str(tmp_path / "run.csv") if word == "FILE" else word for word in line), "--json")
    assert result.exit_code == 2
    assert f"{argument} must be one of cell/left, cell/right, not 'cell'" in json.loads(result.stdout)["reason"]


@pytest.mark.parametrize(("part", "chosen"), [("", "world"), ("left", "left")])
def test_only_robot_of_a_world_need_not_be_named(part: str, chosen: str) -> None:
    world: Any = SimpleNamespace(id="cell", robots={"left": "left"})
    assert one_robot(world, part, "--to") == (world if chosen == "world" else "left")
    with pytest.raises(ValidationError, match="--to must be one of cell/left, not 'cell/right'"):
        one_robot(world, "right", "--to")


def test_refused_option_is_not_reported_as_unknown_follower(run: Run, tmp_path: Path) -> None:
    write_csv(tmp_path / "run.csv", [(0.0, {"shoulder_pan": 0.0})])
    result = run("teleop", str(tmp_path / "run.csv"), "so100", "--publish", "safety", "--json")
    assert result.exit_code == 2
    reason = json.loads(result.stdout)["reason"]
    assert "safety" in reason
    assert "Device Connect" not in reason


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("so100", "--no-network", "--peer-id", "arm-1"), "--no-network goes without --peer-id"),
        (("so100", "--no-network", "--mesh"), "--no-network goes without"),
        (("so100", "--peer-id", "arm-1", "--publish", "lead-1"), "arm-1 and lead-1 are two"),
        (("so100", "--peer-id", "arm.1"), "arm.1"),
        (("mesh:arm-1", "--peer-id", "arm-2"), "not for mesh:arm-1"),
        (("mesh:arm-1", "--no-network"), "not for mesh:arm-1"),
    ],
    ids=" ".join,
)
def test_flags_of_the_network_that_exclude_one_another_are_refused(
    run: Run, tmp_path: Path, arguments: tuple[str, ...], reason: str
) -> None:
    write_csv(tmp_path / "run.csv", [(0.0, {"shoulder_pan": 0.0})])
    result = run("teleop", str(tmp_path / "run.csv"), *arguments, "--json")
    assert result.exit_code == 2
    assert reason in json.loads(result.stdout)["reason"]
