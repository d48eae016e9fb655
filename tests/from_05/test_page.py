"""The programs of docs/from-0.5.md, as they stand there, and the tables of what moved."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.command_line import Machine

from strands_robots import moved

PAGE = (Path(__file__).parents[2] / "docs" / "from-0.5.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
SAYS = (
    ("ok\nsuccess\n", "durration", "arm-1 True\n", "command rejected"),
    ("1 robots: arm-2.", "connect()", "strands_robot"),
    ("error ", "STRANDS_ROS2_COMMAND_ALLOW"),
    ("=\n",),
)
"""What each program of the page prints, in this order."""


@pytest.mark.parametrize(("program", "says"), zip(SNIPPETS, SAYS, strict=True), ids=range(len(SAYS)))
def test_program_of_the_page_prints_what_the_page_says(program: str, says: tuple[str, ...], tmp_path: Path) -> None:
    line = [sys.executable, "-W", "error::DeprecationWarning", "-c", program]
    environment = Machine(tmp_path).environment
    run = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=100.0, check=False)
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr, run.stderr
    rest = run.stdout
    for part in says:
        assert part in rest, run.stdout
        rest = rest.partition(part)[2]


def test_page_has_every_name_that_moved_and_every_one_that_is_gone() -> None:
    for old, new in {**moved.MODULES, **moved.NAMES}.items():
        assert f"| `{old}` | `{new.replace(':', '.')}` |" in PAGE
    for path, instead in moved.GONE.items():
        package, _, name = path.rpartition(".")
        rows = [
            row for row in PAGE.splitlines() if row.startswith(f"| `{package}` |") and row.endswith(f"| {instead} |")
        ]
        assert any(f"`{name}`" in row for row in rows), path
    for name, instead in moved.METHODS.items():
        rows = [row for row in PAGE.splitlines() if row.startswith("| `") and row.endswith(f"` | {instead} |")]
        assert any(f"`{name}`" in row for row in rows), name
