"""``python -m benchmarks``: measure every claim of speed on this machine and print one table a part.

Each part measures ours and the bare part side by side in the same run, so that the ratio holds on any machine. Exits
with 1 when a bound is missed.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.table import Row, markdown

PARTS = {
    "rpc": "Calls and events over Zenoh and NATS",
    "remote": "Calls through a RemoteRobot",
    "cli": "Commands from prompt to prompt",
    "device": "Bring-up, import and fleets in one process",
    "fleet": "Hundreds of devices",
    "policies": "Trained policies",
    "simulation": "Physics",
    "reach": "Arms that reach and grasp",
    "motions": "Motions against the truth of the simulator",
    "safety": "From the controller's call to the last write",
    "answers": "Strangers that answer for a robot",
    "roster": "Robots that were away during a stop",
    "attacks": "Attacks on the way of a stop",
    "reachy": "Reachy Mini",
    "mesh": "The native mesh beside bare Zenoh",
    "mcp": "Robots for MCP clients",
    "recording": "Recording where robots are served",
    "dataset": "Recording of datasets",
    "dataset-train": "Training on a recorded dataset",
    "takeover": "Taking over from a policy",
    "dashboard": "The operator's page in Chromium",
    "ros": "Robots on ROS graphs",
    "arm": "A real arm (in the environment of `make real-arm`)",
}

LONG = {"dataset-train"}
"""Parts that are measured only when they are asked for by name."""

INTRODUCTION = """# Benchmarks

Measure every claim of speed on your machine:

```console
$ make bench                                                    # all parts
$ make bench ARGS=rpc                                           # one part
$ make bench ARGS="rpc mesh --markdown docs/benchmarks.md"      # and put its tables into this page
```

Each row sets ours beside the bare part in the same run, in turns. Take the ratios: the absolute figures are of one
shared machine with {cores} cores, Python {python}, on loopback only. A row with **no** misses its bound; the end of
the page has the reason.

The bare framework records a trace span for every message where the OpenTelemetry SDK is installed, as it is in the
development environment. Ours sets tracing up only where an OTLP endpoint is named.
"""


def shown(title: str, rows: list[Row]) -> Table:
    table = Table(title=title, title_justify="left")
    for heading in ("what", "ours", "against", "ratio", "must", "kept"):
        table.add_column(heading, justify="right" if heading == "ratio" else "left")
    for row in rows:
        kept = "[green]yes[/]" if row.ok else "[bold red]no[/]"
        table.add_row(row.what, row.ours, row.against, "" if row.ratio is None else f"{row.ratio:.2f}", row.must, kept)
    return table


def write(page: Path, measured: Mapping[str, str]) -> None:
    """Put the measured tables into the page and keep its other sections."""
    before = page.read_text(encoding="utf-8").split("\n## ")[1:] if page.exists() else []
    found = dict(section.split("\n\n", 1) for section in before)
    sections = {**{title: found[title] for title in PARTS.values() if title in found}, **measured}
    ordered = [title for title in PARTS.values() if title in sections]
    by_hand = {title: body for title, body in found.items() if title not in sections}
    introduction = INTRODUCTION.format(cores=os.cpu_count(), python=platform.python_version())
    texts = [*((title, sections[title]) for title in ordered), *by_hand.items()]
    tables = (f"## {title}\n\n{body.rstrip()}\n" for title, body in texts)
    page.write_text("\n".join([introduction, *tables]), encoding="utf-8")


def module_of(part: str) -> str:
    """Return the module of a part."""
    return part.replace("-", "_")


def main() -> int:
    here = Path(__file__).parent
    available = [name for name in PARTS if (here / f"{module_of(name)}.py").exists()]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"what to measure: {', '.join(available)} (all but those of hours)"
    )
    parser.add_argument("--quick", action="store_true", help="fewer repeats: a look, not a figure to quote")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write the tables there")
    options = parser.parse_args()
    if unknown := set(options.parts) - set(available):
        parser.error(f"no such part: {', '.join(sorted(unknown))}; there are {', '.join(available)}")

    console, kept = Console(), True
    pages: dict[str, str] = {}
    for name in options.parts or [each for each in available if each not in LONG]:
        started = time.monotonic()
        rows: list[Row] = importlib.import_module(f"benchmarks.{module_of(name)}").run(quick=options.quick)
        kept = kept and all(row.ok for row in rows)
        console.print(shown(PARTS[name], rows))
        console.print(f"[dim]{time.monotonic() - started:.0f} s, Python {platform.python_version()}[/]\n")
        pages[PARTS[name]] = f"`make bench ARGS={name}`\n\n{markdown(rows)}\n"
    if options.markdown:
        write(options.markdown, pages)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
