from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from strands_robots import settings

ROOT = Path(__file__).resolve().parents[3]


def test_the_example_drives_and_stops_every_robot(tmp_path: Path) -> None:
    ours = {setting.name for setting in settings.declared()}
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    done = subprocess.run(
        [sys.executable, "-m", "examples.ros_bases"],
        env={**kept, "STRANDS_STATE_DIR": str(tmp_path)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for name in ("rover", "racer", "base"):
        assert f"{name}: Stopped drive." in done.stdout
