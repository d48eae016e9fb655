"""An import of strands-robots 0.5 works, or its error says what to use instead."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import strands_robots
from strands_robots.moved import GONE, MODULES, NAMES

ROOT = Path(strands_robots.__file__).parent


def imported(path: str) -> Any:
    """Import a name as programs do: ``from package import name``."""
    package, _, name = path.rpartition(".")
    found: dict[str, Any] = {}
    exec(f"from {package} import {name}", found)
    return found[name]


@pytest.mark.parametrize("path", NAMES)
def test_name_of_an_earlier_path_is_the_one_of_today(path: str) -> None:
    home, _, name = NAMES[path].partition(":")
    assert imported(path) is getattr(import_module(home), name)


@pytest.mark.parametrize("path", [path for path, home in MODULES.items() if ":" not in home])
def test_module_of_an_earlier_path_has_the_names_of_today(path: str) -> None:
    module, here = import_module(path), import_module(MODULES[path])
    assert sys.modules[path] is module
    assert here.__spec__ is not None
    assert here.__spec__.name == MODULES[path]
    public = next(name for name in vars(here) if not name.startswith("_"))
    assert getattr(module, public) is getattr(here, public)


@pytest.mark.parametrize("path", [path for path, home in MODULES.items() if ":" in home])
def test_module_of_a_tool_leaves_the_tool_where_it_is(path: str) -> None:
    package, _, name = path.rpartition(".")
    tool = imported(f"{path}.{name}")
    assert tool is getattr(import_module(package), name)
    assert tool is imported(path)


@pytest.mark.parametrize("path", GONE)
def test_import_of_what_is_gone_says_in_one_sentence_what_to_use(path: str) -> None:
    for ask in (imported, import_module):
        with pytest.raises(ImportError, match=f"^{path} is not in this release: ") as refused:
            ask(path)
        words = str(refused.value)
        assert words.endswith(".")
        assert "\n" not in words


def test_attribute_that_is_gone_is_absent_and_says_what_to_use() -> None:
    assert not hasattr(strands_robots, "stream_dataset")
    with pytest.raises(AttributeError, match=r"stream_dataset is not in this release: .* StreamingLeRobotDataset"):
        _ = strands_robots.stream_dataset


def test_what_is_in_a_package_that_is_gone_says_the_same() -> None:
    with pytest.raises(ImportError, match=r"^strands_robots.training is not in this release"):
        import_module("strands_robots.training.rl.ppo")


@pytest.mark.parametrize(
    "package", ["strands_robots", *(f"strands_robots.{each}" for each in ("mesh", "drivers.ros", "policies", "tools"))]
)
def test_name_that_never_was_is_refused_as_ever(package: str) -> None:
    module = import_module(package)
    with pytest.raises(AttributeError, match=f"^module '{package}' has no attribute 'never_was'$"):
        _ = module.never_was
    with pytest.raises(ImportError, match="cannot import name 'never_was'"):
        imported(f"{package}.never_was")
    with pytest.raises(ModuleNotFoundError, match="No module named"):
        import_module(f"{package}.never_was")
    assert find_spec(f"{package}.never_was") is None


def test_no_path_is_both_here_and_gone() -> None:
    stated = [*NAMES, *GONE, *MODULES]
    # A module of a tool is the tool's name as well.
    assert sorted({path for path in stated if stated.count(path) > 1}) == []
    for path in (*GONE, *MODULES):
        file = ROOT.joinpath(*path.split(".")[1:])
        assert not file.with_suffix(".py").exists(), path
        assert not (file / "__init__.py").exists(), path


def test_import_of_the_package_loads_no_table_and_lists_its_own_names() -> None:
    program = (
        "import sys, strands_robots; assert 'strands_robots.moved' not in sys.modules;"
        "found = {}; exec('from strands_robots import *', found);"
        "print(set(found) - {'__builtins__'} == set(strands_robots.__all__) == set(dir(strands_robots)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
