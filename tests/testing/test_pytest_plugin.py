"""The pytest plug-in is stated by the package, and costs a foreign test run nothing until a fixture is used."""

from __future__ import annotations

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import strands_robots.testing

ROOT = Path(__file__).parents[2]
HEAVY = ("zenoh", "numpy", "mujoco", "device_connect_edge", "device_connect_agent_tools", "strands", "asyncio", "nats")


def test_package_states_its_plug_in_by_entry_point() -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]["pytest11"]
    assert stated == {"strands_robots": "strands_robots.testing.pytest_plugin"}
    assert importlib.import_module(stated["strands_robots"]).robots


def test_plug_in_imports_pytest_and_nothing_heavy() -> None:
    program = (
        "import pytest, sys; before = set(sys.modules); import strands_robots.testing.pytest_plugin;"
        "print(*sorted(each for each in set(sys.modules) - before))"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert [each for each in loaded if each.partition(".")[0] in HEAVY] == []
    ours = {"strands_robots", "strands_robots.testing", "strands_robots.testing.pytest_plugin"}
    assert {each for each in loaded if each.startswith("strands_robots")} == ours


def test_testing_package_does_not_import_pytest() -> None:
    program = "import strands_robots.testing, sys; print('pytest' in sys.modules, 'zenoh' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "False"]


def test_each_name_of_the_testing_package_is_there() -> None:
    assert [each for each in strands_robots.testing.__all__ if not hasattr(strands_robots.testing, each)] == []
    assert dir(strands_robots.testing) == sorted(strands_robots.testing.__all__)
    assert not hasattr(strands_robots.testing, "no_such_name")
