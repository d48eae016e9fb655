"""``policy check``: both sides of every question, and an exit code."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy
import pytest
from click.testing import Result
from fixtures.checkpoints import write_checkpoint, write_dataset
from fixtures.openpi_server import OpenPiServer

Run = Callable[..., Result]
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_checkpoint(tmp_path / "act", state=6, action=6, images={})
    write_dataset(tmp_path / "data", JOINTS, low=[*[-90.0] * 5, -10.0], high=[90.0] * 6)
    path = tmp_path / "policies.toml"
    lines = [
        "[pick]",
        'provider = "lerobot_local"',
        f"checkpoint = {json.dumps(str(tmp_path / 'act'))}",
        f"dataset = {json.dumps(str(tmp_path / 'data'))}",
        f"state = {json.dumps(JOINTS)}",
        f"action = {json.dumps(JOINTS)}",
        'units = "degrees"',
        "rate = 30",
    ]
    path.write_text("\n".join(lines))
    return path


def test_a_policy_that_fits_exits_with_0(run: Run, file: Path) -> None:
    result = run("policy", "check", "pick", "--policies", str(file), "--robot", "so101")
    assert result.exit_code == 0, result.output
    assert "state order" in result.output


def test_a_mismatch_exits_with_1_and_is_in_the_json(run: Run, file: Path) -> None:
    file.write_text(file.read_text().replace("rate = 30", "rate = 50"))
    result = run("policy", "check", "pick", "--policies", str(file), "--robot", "so101", "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout.splitlines()[0])
    assert [row["change"] for row in found["rows"] if row["outcome"] == "refused"] == ["set rate = 30"]


@pytest.mark.parametrize(("name", "words"), [("place", "NAME must be one of pick"), ("pick", "cannot be read")])
def test_an_unknown_profile_or_file_is_refused(run: Run, file: Path, name: str, words: str) -> None:
    if name == "pick":
        file.unlink()
    result = run("policy", "check", name, "--policies", str(file), "--robot", "so101")
    assert result.exit_code == 2
    assert words in result.output + result.stderr


def test_without_a_file_it_says_how_to_name_one(run: Run) -> None:
    result = run("policy", "check", "pick", "--robot", "so101")
    assert result.exit_code == 2
    assert "--policies must name the file" in result.output + result.stderr


def test_bench_prints_the_figures_of_a_server_against_the_budget(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_POLICIES", "")  # which the command sets
    with OpenPiServer(lambda observation: {"actions": numpy.zeros((10, 6), numpy.float32)}) as server:
        keys = json.dumps(JOINTS)
        entries = f'url = "{server.url}"\nstate = {keys}\naction = {keys}\nunits = "radians"\nrate = 30\n'
        file = tmp_path / "bench.toml"
        file.write_text(f'[pi]\nprovider = "openpi"\n{entries}')
        result = run("policy", "bench", "pi", "--policies", str(file), "--for", "1", "--json")
    found = json.loads(result.stdout.splitlines()[0])
    assert found["loop"]["inferences"] >= 2
    assert {row["what"].split(",")[0] for row in found["rows"]} >= {"latency", "underruns", "control period"}
    assert result.exit_code == (0 if found["kept"] else 1)


@pytest.mark.parametrize("good", [0, 2])
def test_bench_says_why_a_policy_failed(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: int) -> None:
    monkeypatch.setenv("STRANDS_POLICIES", "")  # which the command sets
    answers = iter([{"actions": numpy.zeros((4, 6), numpy.float32)}] * good)
    with OpenPiServer(lambda observation: next(answers, "RuntimeError: out of memory")) as server:
        keys = json.dumps(JOINTS)
        entries = f'url = "{server.url}"\nstate = {keys}\naction = {keys}\nunits = "radians"\nrate = 30\n'
        file = tmp_path / "bench.toml"
        file.write_text(f'[pi]\nprovider = "openpi"\n{entries}')
        result = run("policy", "bench", "pi", "--policies", str(file), "--for", "20")
    assert result.exit_code == 1
    said = " ".join((result.output + result.stderr).split())
    assert "pi failed:" in said
    assert "out of memory" in said
    assert "Traceback" not in said
