"""Emulated arm in a process of its own.

It takes no interpreter time from the driver that it answers.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from strands_robots.hardware.emulated.arm import arm_servos, write_calibration
from strands_robots.hardware.emulated.bus import ServoBus


@contextmanager
def emulated_arm() -> Iterator[dict[str, Any]]:
    """Run the servos of one arm; yield a robot's options for it.

    Raises:
        ConnectionError: the process of the servos does not start.
    """
    with tempfile.TemporaryDirectory(prefix="emulated-arm-") as folder:
        link = Path(folder, "arm")
        command = [sys.executable, "-m", __name__, str(link)]
        # A Ctrl-C in the terminal stops the robot first: the servos end after it, when their input closes.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        try:
            if process.stdout is None or not process.stdout.readline():
                raise ConnectionError("The emulated arm did not start.")
            calibration = write_calibration(Path(folder, "calibration.json"))
            yield {"port": str(link), "calibration": str(calibration), "calibration_dir": folder}
        finally:
            process.communicate()


def main(link: Path) -> None:
    """Answer on the port ``link`` until the input closes."""
    with ServoBus(arm_servos(), link=link):
        print(link, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
