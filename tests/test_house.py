"""The house rules that a program can see."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "strands_robots"
SOURCES = sorted(PACKAGE.rglob("*.py"))

LINES_MAX = 700
"""A file is one concept; most are far below this."""

FLOORS: list[set[str]] = [
    {"envelope", "errors", "settings", "utils", "quaternions", "agent_tool", "_mesh_switch"},
    {"safety", "audit", "contract"},
    {"policies", "teleop_mixin", "teleoperators", "recording"},
    {
        "hardware",
        "simulation",
        "drivers",
        "ros",
        "ros_telemetry",
        "hardware_ros_bridge",
        "hardware_rtps_bridge",
        "bus_access",
    },
    {"serving"},
    {"device_connect", "mesh", "mesh_session"},
    {"cli", "tools", "robot"},
]


def floor_of(part: str) -> int:
    """The floor on which a top-level module or folder of the package lives."""
    for number, parts in enumerate(FLOORS):
        if part in parts:
            return number
    raise AssertionError(f"{part} has no floor; give it one here and in docs/architecture.md")


def part_of(path: Path) -> str:
    """The top-level module or folder of the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> Iterator[str]:
    """Every top-level part of the package that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                base = path.relative_to(PACKAGE.parent).parts[: -node.level]
                module = ".".join([*base, *module.split(".")] if module else base)
            names = [f"{module}.{alias.name}" if module == "strands_robots" else module for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "strands_robots" and len(parts) > 1:
                yield parts[1]


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [p for p in SOURCES if p.parent != PACKAGE or p.stem != "__init__"], ids=relative)
def test_a_module_imports_only_its_own_floor_and_the_floors_below(path: Path) -> None:
    own = floor_of(part_of(path))
    for part in imports(path):
        if part.startswith("__"):
            continue
        assert floor_of(part) <= own, f"{relative(path)} (floor {own}) imports {part} (floor {floor_of(part)})"


def test_device_connect_and_the_mesh_never_import_one_another() -> None:
    for path in SOURCES:
        here, there = part_of(path), set(imports(path))
        assert not (here == "device_connect" and "mesh" in there), relative(path)
        assert not (here == "mesh" and "device_connect" in there), relative(path)


def test_every_file_is_short_enough_to_hold_in_the_head() -> None:
    folders = ("src", "tests", "fixtures", "benchmarks", "examples", "scripts")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    long = {relative(path): count for path in files if (count := len(path.read_text("utf-8").splitlines())) > LINES_MAX}
    assert files
    assert not long


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_no_exception_is_swallowed(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ExceptHandler):
            assert not (len(node.body) == 1 and isinstance(node.body[0], ast.Pass)), f"{relative(path)}:{node.lineno}"


@pytest.mark.parametrize("path", [p for p in SOURCES if p.name != "settings.py"], ids=relative)
def test_only_settings_reads_the_environment(path: Path) -> None:
    reads = {"environ", "getenv"}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        name = node.attr if isinstance(node, ast.Attribute) else ""
        assert name not in reads, f"{relative(path)}:{node.lineno} reads the environment; declare it in settings.py"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_no_module_reads_an_underscore_name_of_another(path: Path) -> None:
    if path.name == "_compat.py":
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    modules = {
        alias.asname or alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            private = [a.name for a in node.names if a.name.startswith("_") and not a.name.startswith("__")]
            # The last two are documented for authors of tasks, under "Extending" in asyncio's own pages.
            allowed = {"_compat", "_mesh_switch", "_enter_task", "_leave_task"}
            if path.name == "__init__.py":
                allowed.add("_LOOP_JOIN_TIMEOUT_S")
            assert not set(private) - allowed, f"{relative(path)}:{node.lineno} imports {private}"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            # os._exit is public in spite of its name.
            private_name = node.attr.startswith("_") and not node.attr.startswith("__") and node.attr != "_exit"
            assert not private_name, f"{relative(path)}:{node.lineno} reaches into {node.value.id}.{node.attr}"


def test_no_file_carries_a_marker_of_unfinished_work() -> None:
    words = ("TO" + "DO", "FIX" + "ME", "XX" + "X", "HA" + "CK")
    for path in SOURCES:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            assert not any(word in line.split() or f"{word}:" in line for word in words), f"{relative(path)}:{number}"


def test_no_tracked_file_names_a_registry_host() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    hosts = tuple(name + "." + end for name, end in (("pypi", "org"), ("files.pythonhosted", "org"), ("npmjs", "org")))
    for name in listed.stdout.split():
        path = ROOT / name
        if path.is_file() and path.suffix not in {".png", ".gif", ".svg", ".pem"}:
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not any(host in text for host in hosts), name
