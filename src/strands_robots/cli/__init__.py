"""``strands-robots``: serve a robot, find robots, drive them, stop them.

Exit codes: 0 done, 1 refused or failed, 2 wrong usage, 3 no answer, 130 Ctrl-C.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import NoReturn

from strands_robots import __version__
from strands_robots.device_connect import load_when_used
from strands_robots.utils import DISTRIBUTION

__all__ = ["main"]


def main() -> None:
    """Run the ``strands-robots`` command."""
    if sys.argv[1:] == ["--version"]:
        print(f"{DISTRIBUTION} {__version__}")
        return
    from strands_robots.cli.app import build  # noqa: PLC0415 - importing the package loads no command

    load_when_used()

    try:
        build(sys.argv[1] if len(sys.argv) > 1 else "")()
    except SystemExit as exit_:
        _leave(exit_.code)


AUDIT_S = 1.0
"""Seconds that the end of a command waits for its last record."""


def _leave(code: object) -> NoReturn:
    """End the process after flushing all output.

    Native network threads may still release callbacks. If the interpreter shut down under them, the C library would
    abort the process, and a script would read -6 in place of the exit code.
    """
    policies = sys.modules.get("strands_robots.policies.preload")
    if policies is not None:
        policies.name_unfinished()
    sightings = sys.modules.get("strands_robots.safety.sightings")
    if sightings is not None:
        # What runs at an interpreter's end does not run here.
        sightings.flush_sightings()
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            code = code or 1
    audit = sys.modules.get("strands_robots.audit")
    if audit is not None:
        audit.flush_audit(AUDIT_S)
    os._exit(code if isinstance(code, int) else int(code is not None))
