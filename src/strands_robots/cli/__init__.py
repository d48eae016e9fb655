"""``strands-robots``: serve a robot, find robots, drive them, stop them.

Exit codes: 0 done, 1 refused or failed, 2 wrong usage, 3 nobody answered, 130 Ctrl-C.
"""

from __future__ import annotations

__all__ = ["main"]


def main() -> None:
    """Entry point of the ``strands-robots`` command."""
    from strands_robots.cli.app import build  # noqa: PLC0415 - importing the package stays free

    build()()
