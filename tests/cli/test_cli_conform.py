"""``conform`` and ``new``: what they refuse, by name, before anything is made or moves."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from textwrap import dedent

import pytest
from tests.cli.conftest import Run

from strands_robots.cli.conform import subject_of
from strands_robots.cli.output import Exit
from strands_robots.testing import Tier, promises
from strands_robots.utils import ValidationError

PAGE = Path(__file__).parents[2] / "docs" / "your-robot.md"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("math:tau", "--motion", "wave"), "--motion is for real hardware and for --live"),
        (("so100", "--limit", "0"), "--limit must"),
        (("so101_follower", "--set", "port=/dev/ttyACM0"), "port is that of a real arm"),
        (("so100", "--tier", "iron"), "--tier must be one of bronze, silver, gold, platinum, not 'iron'"),
        (("arm-1", "--live", "--motion", "1up"), "--motion must be VERB KEY=VALUE"),
        (("arm-1", "--live", "--motion", "wave 'to me"), "--motion must be VERB KEY=VALUE"),
        (("arm-1", "--live", "--motion", "wave speed=NaN"), "speed must be finite"),
        (("arm-1", "--live", "--motion", "wave", "--approve-motions", "00"), "which names this list, not '00'"),
        (("arm 1", "--live"), "TARGET must"),
        (("so100", "--port", "4711"), "give --live with it"),
        ((), "TARGET must say which robot is checked"),
    ],
    ids=str,
)
def test_conform_refuses_by_name(run: Run, arguments: tuple[str, ...], said: str) -> None:
    refused = run("conform", *arguments, "--json")
    assert refused.exit_code == Exit.USAGE
    assert said in json.loads(refused.stdout.splitlines()[-1])["reason"]


def test_list_has_each_check_with_its_promise_and_why_it_matters(run: Run) -> None:
    (line,) = run("conform", "--list", "--json").stdout.splitlines()
    listed = json.loads(line)["checks"]
    assert [each["check"] for each in listed] == [each.name for each in promises()]
    assert {each["tier"] for each in listed} == {"bronze", "silver", "gold", "platinum"}
    assert all(each["promise"] and each["matters"] and each["look"] for each in listed)
    words = " ".join(run("conform", "--list").stdout.split())
    assert all(f"{each['check']}: {each['promise']}" in words for each in listed)


@pytest.mark.parametrize(
    "arguments",
    [
        ("reachy_mini",),
        ("lerobot:so100",),
        ("so100", "--set", "mode=real", "--set", "port=/dev/ttyACM0"),
        ("strands_robots:Robot", "--set", "name=lerobot:so100", "--set", "port=/dev/ttyACM0"),
        ("strands_robots:Robot", "--set", "name=reachy_mini"),
        ("strands_robots.drivers.reachy:make_reachy",),
    ],
)
def test_conform_moves_no_hardware_before_its_list_is_approved(run: Run, arguments: tuple[str, ...]) -> None:
    refused = run(
        "conform", *arguments, "--motion", "execute instruction=wave duration=2", "--tier", "silver", "--json"
    )
    listed, failed = map(json.loads, refused.stdout.splitlines())
    made, moved, wrong, let_go = listed["motions"]
    assert refused.exit_code == Exit.REFUSED
    assert made.startswith("It is made")
    assert ("/dev/ttyACM0" in made) is ("port=/dev/ttyACM0" in arguments)
    assert moved.startswith("execute(instruction='wave', duration=2), up to 5 times")
    assert "wrong" in wrong
    assert "sinks" in let_go
    assert failed["reason"].startswith("Nothing was moved.")
    assert failed["reason"].endswith(f"--approve-motions {listed['digest']}")


def test_list_of_another_arm_or_motion_has_another_digest(run: Run) -> None:
    ports = [("--set", f"port=/dev/ttyACM{number}") for number in (0, 1)]
    lines = [*ports, (*ports[0], "--motion", "execute duration=2"), (*ports[0], "--motion", "execute duration=3")]
    digests = [
        json.loads(run("conform", "so100", "--set", "mode=real", *line, "--json").stdout.splitlines()[0])["digest"]
        for line in lines
    ]
    assert len(set(digests)) == len(lines)


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("no_such_module:subject", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("json:no_such_name", "AttributeError"),
        ("math:pi", "must be a Subject, or make one or a robot, not 3.14"),
    ],
)
def test_target_that_makes_no_robot_is_refused_by_name(target: str, said: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(said)):
        subject_of(target, {})


@pytest.mark.parametrize(
    "name", ["", "My_Robot", "my-robot", "1robot", "a" * 51, "../x", "class", "json", "numpy", "so100"]
)
def test_new_refuses_a_name_that_is_no_free_package(run: Run, name: str, tmp_path: Path) -> None:
    refused = run("new", name, "--folder", str(tmp_path / "made"), "--json")
    assert refused.exit_code == Exit.USAGE
    assert "name must" in json.loads(refused.stdout)["reason"]
    assert list(tmp_path.iterdir()) == []


def test_approval_of_a_robot_is_none_of_its_namesake_on_another_network(run: Run) -> None:
    digests = set()
    for flags in ((), ("--port", "7447"), ("--mesh",)):
        refused = run("conform", "arm-1", "--live", "--motion", "wave", *flags, "--json")
        digests.add(json.loads(refused.stdout.splitlines()[0])["digest"])
    assert len(digests) == 3


def test_new_writes_into_no_folder_that_exists(run: Run, tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("mine")
    refused = run("new", "my_robot", "--folder", str(tmp_path), "--json")
    assert refused.exit_code == Exit.USAGE
    assert "--folder must not exist" in json.loads(refused.stdout)["reason"]
    assert [each.name for each in tmp_path.iterdir()] == ["kept"]


def test_new_writes_a_package_with_its_entry_point(run: Run, tmp_path: Path) -> None:
    made = run("new", "left_arm", "--folder", str(tmp_path / "made"), "--json")
    assert json.loads(made.stdout) == {"status": "success", "folder": str(tmp_path / "made")}
    assert 'left_arm = "left_arm:LeftArm"' in (tmp_path / "made" / "pyproject.toml").read_text()
    files = {str(each.relative_to(tmp_path / "made")) for each in (tmp_path / "made").rglob("*") if each.is_file()}
    assert {"README.md", "src/left_arm/robot.py", "src/left_arm/bus.py", "tests/test_left_arm.py"} <= files
    for each in (tmp_path / "made").rglob("*.py"):
        compile(each.read_text(), str(each), "exec")


def test_page_shows_the_code_that_new_writes(run: Run, tmp_path: Path) -> None:
    run("new", "my_robot", "--folder", str(tmp_path / "made"), "--json")
    blocks = re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE.read_text("utf-8"), flags=re.DOTALL)
    assert {file for file, _ in blocks} == {"robot.py", "bus.py", "conformance.py"}
    for file, block in blocks:
        written = (tmp_path / "made" / "src" / "my_robot" / file).read_text()
        assert dedent(block) in dedent_each(written), block


def dedent_each(text: str) -> str:
    """Return a program with the methods and blocks of its classes at the margin, besides itself."""
    lines = text.splitlines(keepends=True)
    return "\n".join("".join(line.removeprefix(" " * margin) for line in lines) for margin in (0, 4, 8))


def test_page_states_the_counts_of_the_suite() -> None:
    counts = Counter(each.tier.label for each in promises(Tier.GOLD))
    rows = "".join(f"  {tier}: {count} passed\n" for tier, count in counts.items())
    assert f"```text\nmy_robot: gold\n{rows}```" in PAGE.read_text("utf-8")
