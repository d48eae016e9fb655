"""Attacks on the audit: processes that end at once, secrets that disappear, files that are kept locked."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fixtures.plane_process import planned

from benchmarks.table import Row
from strands_robots.audit.journal import NAME

ROBOTS = [f"arm-{number}" for number in range(10)]
STOP_BOUND_S = 1.0

DYING = """
import os
from strands_robots.audit import log_safety_event
log_safety_event("emergency_stop", "arm-1", {"reason": "bench"})
os._exit(0)
"""

DROPPING = """
import os
from strands_robots.audit import log_safety_event
log_safety_event("e", "arm-1", {})
del os.environ["STRANDS_MESH_AUDIT_PSK"]
for _ in range(20):
    log_safety_event("e", "arm-1", {})
"""

VERIFYING = "from strands_robots.audit import verify_audit_integrity; print(int(verify_audit_integrity()['ok']))"


def rows(quick: bool) -> list[Row]:
    """Return the rows of all attacks."""
    return [dying_row(5 if quick else 100), dropped_row(2 if quick else 20), locked_row(5 if quick else 100)]


def _python(code: str, state: str, **environment: str) -> str:
    known = {**os.environ, "STRANDS_STATE_DIR": state, **environment}
    run = subprocess.run([sys.executable, "-c", code], env=known, capture_output=True, text=True, check=True)
    return run.stdout.strip()


def _records(state: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in (Path(state) / NAME).read_text().splitlines()]


def dying_row(processes: int) -> Row:
    """Processes that log one event and end without a goodbye."""
    with tempfile.TemporaryDirectory(prefix="bench-audit-") as state:
        for _ in range(processes):
            _python(DYING, state)
        found = len(_records(state))
    return Row(
        "processes that log an event and end at once (os._exit)",
        f"{found} of {processes} records on the disk",
        "",
        None,
        "none lost",
        found == processes,
    )


def dropped_row(processes: int) -> Row:
    """Processes whose secret disappears behind their first record; then checks with and without it."""
    unsigned = blind = seeing = 0
    secret = {"STRANDS_MESH_AUDIT_PSK": "the secret of the bench"}
    for _ in range(processes):
        with tempfile.TemporaryDirectory(prefix="bench-audit-") as state:
            _python(DROPPING, state, **secret)
            unsigned += sum("sig" not in each for each in _records(state))
            seeing += int(_python(VERIFYING, state, **secret))
            blind += int(_python(VERIFYING, state))
    return Row(
        "the audit's secret disappears in mid-process",
        f"{unsigned} unsigned records; ok with the secret in {seeing} of {processes} checks, without it in {blind}",
        "",
        None,
        "none unsigned, never ok unverified",
        not unsigned and seeing == processes and not blind,
    )


def locked_row(stops: int) -> Row:
    """Stops of a process while another one keeps the audit locked, beside stops with a free one."""
    took: dict[bool, list[float]] = {True: [], False: []}
    stopped = 0
    with tempfile.TemporaryDirectory(prefix="bench-audit-") as state, planned(ROBOTS, STRANDS_STATE_DIR=state) as site:
        for locked in (False, True):
            with (Path(state) / "mesh_audit.lock").open("w") as lock:
                if locked:
                    fcntl.flock(lock, fcntl.LOCK_EX)
                for _ in range(stops):
                    site.ask("move")
                    began = time.monotonic()
                    answers = site.ask("stop")
                    took[locked].append(time.monotonic() - began)
                    stopped += all(each is True for each, _ in answers)
                    site.ask("clear")
    free, held = (sorted(took[each])[len(took[each]) // 2] for each in (False, True))
    worst = max(took[True])
    return Row(
        f"{len(ROBOTS)} robots are stopped while another process keeps the audit locked, order to answers",
        f"p50 {held * 1e3:.1f} ms, worst {worst * 1e3:.1f} ms; {stopped} of {2 * stops} stopped",
        f"p50 {free * 1e3:.1f} ms with a free audit",
        held / free,
        f"all stopped, worst ≤ {STOP_BOUND_S:g} s",
        stopped == 2 * stops and worst <= STOP_BOUND_S,
    )
