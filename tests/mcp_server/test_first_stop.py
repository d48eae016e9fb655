"""The first stop of a client finds everything loaded that it needs."""

from __future__ import annotations

import subprocess
import sys

STOP = """
import sys
from strands_robots.mcp import server
before = set(sys.modules)
for name, read in server.STOPS.items():
    read({"robot": "arm-1", "robot_name": "left", "only": ["arm-1"]})
print(*sorted(each for each in set(sys.modules) - before if each.startswith("strands_robots")))
"""


def test_first_stop_of_a_client_loads_no_module() -> None:
    said = subprocess.run([sys.executable, "-c", STOP], capture_output=True, text=True, timeout=60, check=True)
    assert said.stdout.strip() == ""
