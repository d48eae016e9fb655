"""``lerobot-record`` again and again, each a fork of an interpreter that has imported it, for its kills.

``python -m benchmarks.takeover_lerobot_children {}`` in the environment of ``make lerobot``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from fixtures.child import serve
from fixtures.forked import LEROBOT, Forked

RECORD = "lerobot.scripts.lerobot_record"


class Recorders:
    """Commands of this process, one at a time."""

    def __init__(self) -> None:
        self._process: Forked | None = None

    def record(self, arguments: list[str], said: str, environment: dict[str, str]) -> None:
        """Begin a command with more variables, whose output goes to the file ``said``."""
        with Path(said).open("w", encoding="utf-8") as out:
            self._process = Forked(
                [sys.executable, "-m", RECORD, *arguments],
                LEROBOT,
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
            )

    def kill(self) -> float:
        """Kill it; return the moment, in monotonic seconds, or 0 where it had ended before."""
        at = time.monotonic()
        if self._process is None or self._process.poll() is not None:
            return 0.0
        self._process.kill()
        self._process.wait()
        return at


def main() -> None:
    """Obey until standard input closes."""
    recorders = Recorders()
    serve({"record": recorders.record, "kill": recorders.kill})
    # Where the benchmark failed, one may still run.
    recorders.kill()


if __name__ == "__main__":
    main()
