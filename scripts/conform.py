"""Check every built-in robot and driver on its emulated bus, and write the table of their tiers in the README.

``make conform`` runs it. Each robot is checked in a process of its own, by ``strands-robots conform``. One that is
below gold, or takes more than a minute, fails the run and keeps its row. A robot whose virtual environment is missing
is named, and keeps its row.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

# As a program that is run by its path, it has its own folder on the path and not that of the repository.
sys.path.insert(0, str(Path(__file__).parent.parent))

from fixtures.conformance_table import BUILT_INS, ROOT, TIER, BuiltIn, rows, write

from strands_robots.testing import Tier

LONGEST_S = 60


def report_of(robot: BuiltIn) -> dict[str, Any]:
    """Return the report on a robot as JSON; without its checks where there is none."""
    python = sys.executable if robot.venv == ".venv" else str(ROOT / robot.venv / "bin" / "python")
    command = [python, "-m", "strands_robots.cli", "conform", robot.target, "--tier", TIER, "--json"]
    try:
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        return {"said": f"it took more than {LONGEST_S} s"}
    lines = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    reports = [line for line in lines if line.get("event") == "report"]
    return reports[-1] if reports else {"said": (ran.stdout + ran.stderr).strip()[-2000:]}


def main() -> int:
    """Check all of them, or those whose target is an argument; return the exit code."""
    lowest = Tier[TIER.upper()].value
    kept = rows()
    failed = []
    for robot in BUILT_INS:
        if sys.argv[1:] and robot.target not in sys.argv[1:]:
            continue
        if not (ROOT / robot.venv).is_dir():
            print(f"{robot.target}: not checked, for {robot.venv} is missing: make real-arm", flush=True)
            continue
        began = time.monotonic()
        report = report_of(robot)
        print(f"{robot.target}: {report.get('tier')}, {time.monotonic() - began:.0f} s", flush=True)
        if report.get("tier") is None or Tier[report["tier"].upper()].value < lowest:
            failed.append(robot.target)
            for each in report.get("checks", [report]):
                if each.get("mark") != "passed":
                    print(f"  {each.get('mark', '')} {each.get('check', '')} {each['said']}", flush=True)
            continue
        kept[robot] = robot.row(report)
    if write(kept):
        print("The table in README.md is written anew.")
    if failed:
        print(f"Below {TIER}, with their rows as they were: {', '.join(failed)}.")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
