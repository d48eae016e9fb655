"""``python -m benchmarks.soak SECONDS``: a hundred robots at 10 Hz on the operator's page, for long."""

from __future__ import annotations

import sys

from rich.console import Console

from benchmarks.__main__ import PARTS, shown
from benchmarks.dashboard import hundred


def main() -> int:
    rows = hundred(float(sys.argv[1]) if len(sys.argv) > 1 else 600.0)
    Console().print(shown(PARTS["dashboard"], rows))
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
