"""Download, install and grade the packages of fixtures/foreign_robots/catalogue.py, each in a process of its own.

Prints one line of JSON a package, and writes them and the table of docs/foreign-robots.md. ``scripts/foreign.sh`` runs
it in this project's environment. Names of packages choose from them; ``--table`` writes the table alone.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from fixtures.foreign_robots.catalogue import ROBOTS, ForeignRobot  # noqa: E402 - the path is set above
from fixtures.foreign_robots.table import PAGE, results, with_table, write_results  # noqa: E402 - as above

WITHIN_S = 300


def interpreter(robot: ForeignRobot) -> Path:
    """Return the Python of the environment with that version of LeRobot."""
    name = ".venv-lerobot" if robot.lerobot == "0.4.4" else f".venv-lerobot-{robot.lerobot}"
    return ROOT / name / "bin" / "python"


def install(robot: ForeignRobot, python: Path, folder: Path) -> None:
    """Install the package and what it needs into ``folder``, without what they ask for.

    Raises:
        subprocess.CalledProcessError: the index has it no more, or is not reachable.
    """
    wanted = (f"{robot.package}=={robot.version}", *robot.needs)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, "--target", str(folder), *wanted], check=True, capture_output=True, text=True)


def grade(robot: ForeignRobot, python: Path, folder: Path, tier: str = "gold") -> dict[str, Any]:
    """Grade an installed package, and return its facts."""
    with tempfile.TemporaryDirectory(prefix="foreign-home-") as home:
        paths = os.pathsep.join((str(ROOT / "src"), str(ROOT), str(folder)))
        environment = {**os.environ, "PYTHONPATH": paths, "HF_LEROBOT_HOME": home}
        command = [str(python), "-m", "fixtures.foreign_robots.grade", robot.package, tier]
        ran = subprocess.run(
            command,
            cwd=home,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=WITHIN_S,
            check=False,
        )
    lines = [line for line in ran.stdout.splitlines() if line.startswith('{"package"')]
    if not lines:
        raise RuntimeError(f"{robot.package} was not graded: {ran.stderr[-2000:]}")
    facts: dict[str, Any] = json.loads(lines[-1])
    return facts


def main() -> None:
    """Grade what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("packages", nargs="*", help="names of packages; all by default")
    parser.add_argument("--table", action="store_true", help="write the table of the page alone")
    asked = parser.parse_args()
    chosen = [robot for robot in ROBOTS if robot.package in asked.packages or not asked.packages]
    for robot in [] if asked.table else chosen:
        python = interpreter(robot)
        if not python.exists():
            print(f"{robot.package} needs LeRobot {robot.lerobot}: make real-arm-next", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
            try:
                install(robot, python, Path(folder))
            except subprocess.CalledProcessError as problem:
                print(f"{robot.package} cannot be installed: {problem.stderr[-500:]}", file=sys.stderr)
                continue
            facts = grade(robot, python, Path(folder))
        print(json.dumps(facts), flush=True)
        write_results({**results(), robot.package: facts})
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), results()), encoding="utf-8")


if __name__ == "__main__":
    main()
