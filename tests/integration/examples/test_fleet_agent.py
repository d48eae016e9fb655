"""The CI of an agent, as the example and the page have it, runs as a stranger runs it: by the installed plug-in."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from fixtures.child_pytest import ROOT, child_pytest

from strands_robots.cli.conform import TEMPLATE

pytestmark = pytest.mark.system

PAGE = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "testing.md").read_text(encoding="utf-8"), re.DOTALL)


def test_example_and_page_pass_in_a_folder_without_a_conftest(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "test_fleet_agent.py", tmp_path)
    tests = [each for each in PAGE if "robots)" in each]
    for number, program in enumerate(tests):
        (tmp_path / f"test_page_{number}.py").write_text(program, encoding="utf-8")
    run = child_pytest(tmp_path)
    assert run.code == 0, run.said
    assert list(run.results.values()) == ["passed"] * 4
    assert len(tests) == 2


def test_page_has_the_promises_as_a_new_package_has_them() -> None:
    (lines,) = (each.splitlines() for each in PAGE if "conformance_tests(" in each)
    written = (TEMPLATE / "tests" / "test_NAME.py.tmpl").read_text(encoding="utf-8").replace("$name", "my_robot")
    assert [each for each in lines if each not in written] == []
