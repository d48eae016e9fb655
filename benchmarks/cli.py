"""Commands from prompt to prompt beside a served arm, and a bare program that discovers and calls it.

All are processes, started in turns, so that what else the machine does falls on all of them.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from fixtures.command_line import COMMAND, Machine

from benchmarks.table import Row

PROMPT_S = 0.5
BOUNDS_S = {"peers": 0.3, "call arm-1 getStatus": 0.2, "estop": 0.35, "doctor": None}
"""Bounds of commands besides :data:`PROMPT_S`; ``doctor`` renders a picture and has none."""

TURNS, QUICK_TURNS = 15, 4

# The framework alone, as an agent uses it: import, connect, find the robot, ask it once.
BARE = """
import asyncio, sys
from device_connect_edge import DeviceRuntime
from fixtures.bare_caller import Caller
async def main():
    async with Caller(servers=("tcp/127.0.0.1:" + sys.argv[1],)) as caller:
        await caller.sees("arm-1")
        await caller.call("arm-1", "getStatus")
asyncio.run(main())
"""

# The least that ``estop`` can take: it asks the network for 0.2 s who must answer.
SEARCH = """
import json, sys, time, zenoh
config = {"mode": "client", "connect": {"endpoints": ["tcp/127.0.0.1:" + sys.argv[1]]}}
config["scouting"] = {"multicast": {"enabled": False}}
with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):
    time.sleep(0.2)
"""

PYTHON = "python -c pass"
SEARCHED = "Zenoh alone: import, link, 0.2 s of search"
DISCOVERY = "bare import, discovery and call"


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    with tempfile.TemporaryDirectory() as state:
        machine = Machine(Path(state))
        # Both networks meet at one port by default, so each command looks there for a mesh.
        machine.environment["STRANDS_MESH_PORT"] = machine.environment["STRANDS_DC_PORT"]
        # As after an installation, which compiles: without this each command may compile the whole package anew.
        machine.environment.pop("PYTHONDONTWRITEBYTECODE", None)
        with machine.serving("arm-1"):
            return _rows(machine, QUICK_TURNS if quick else TURNS)


def _rows(machine: Machine, turns: int) -> list[Row]:
    port = machine.environment["STRANDS_DC_PORT"]
    commands: dict[str, tuple[str, ...]] = {
        "--version": ("--version",),
        "peers": ("peers",),
        "call arm-1 getStatus": ("call", "arm-1", "getStatus"),
        "stop arm-1": ("stop", "arm-1"),
        "estop": ("estop",),
        "lockout": ("lockout",),
        "resume --local": ("resume", "--local"),
        "doctor": ("doctor",),
    }
    took: dict[str, list[float]] = {name: [] for name in (PYTHON, DISCOVERY, SEARCHED, *commands)}
    for words in commands.values():
        _checked([*COMMAND, *words], machine)
    for _ in range(turns):
        took[PYTHON].append(_timed(lambda: _checked([sys.executable, "-c", "pass"], machine)))
        took[DISCOVERY].append(_timed(lambda: _checked([sys.executable, "-c", BARE, port], machine)))
        took[SEARCHED].append(_timed(lambda: _checked([sys.executable, "-c", SEARCH, port], machine)))
        for name, words in commands.items():
            took[name].append(_timed(lambda words=words: _checked([*COMMAND, *words], machine)))  # type: ignore[misc]
    bare = statistics.median(took[DISCOVERY])
    rows = [
        Row(name, "", _s(statistics.median(took[name])), None, "for information", True) for name in (PYTHON, SEARCHED)
    ]
    for name in commands:
        median, bound = statistics.median(took[name]), BOUNDS_S.get(name, PROMPT_S)
        must = "for information, it renders a picture" if bound is None else f"≤ {bound:g} s"
        against = f"{DISCOVERY} {_s(bare)}"
        kept = bound is None or median <= bound
        rows.append(Row(f"strands-robots {name}, p50", _s(median), against, median / bare, must, kept))
    return rows


def _checked(line: list[str], machine: Machine) -> None:
    result = subprocess.run(line, env=machine.environment, capture_output=True, text=True, check=False)
    # Doctor exits with 1 where it finds something to mend.
    if result.returncode and "doctor" not in line:
        raise RuntimeError(f"{line} ended with {result.returncode}: {result.stderr}")


def _timed(work: Callable[[], None]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def _s(seconds: float) -> str:
    return f"{seconds:.2f} s"
