"""``demo``: run the example of an agent that puts a cube on a plate."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Annotated, Any

import typer

from strands_robots.cli.output import Screen

EXAMPLE = "strands_robots._demo"
"""Name of the example's package, which the wheel has, and a source tree keeps in ``examples/demo``."""


def demo(
    screen: Screen,
    *,
    output: Annotated[Path, typer.Option("--output", help="Folder for the pictures.")] = Path("demo-output"),
    record: Annotated[Path | None, typer.Option("--record", help="Write the terminal output as SVG.")] = None,
) -> None:
    """An agent in another process looks at a table and has a simulated arm put the red cube on the plate. A stop halts
    it; an emergency stop locks it until an operator's key frees it. Nothing leaves this machine.

    Exits with 1 when any step did not happen, or the cube is not on the plate.
    """
    example().run(screen, output, record)


def example(part: str = "") -> Any:
    """Return the example's package, or the module ``part`` of it."""
    if find_spec(EXAMPLE) is None:
        file = Path(__file__).parents[3] / "examples" / "demo" / "__init__.py"
        spec = spec_from_file_location(EXAMPLE, file)
        if spec is None or spec.loader is None:
            raise ModuleNotFoundError(f"{file} is no module.")
        sys.modules[EXAMPLE] = package = module_from_spec(spec)
        spec.loader.exec_module(package)
    return import_module(f"{EXAMPLE}.{part}" if part else EXAMPLE)
