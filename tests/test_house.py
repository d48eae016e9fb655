"""The rules of the house that a program can check: floors, circles, names, docstrings, exceptions."""

from __future__ import annotations

import ast
import builtins
import re
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "strands_robots"
SOURCES = sorted(PACKAGE.rglob("*.py"))

LINES_MAX = 700
"""Most files are far below this."""

FLOORS: list[set[str]] = [
    {
        "envelope",
        "errors",
        "settings",
        "tags",
        "utils",
        "bounded_json",
        "plug_ins",
        "state_files",
        "stop_log",
        "agent_tool",
        "_mesh_switch",
        "zenoh_session",
        "rate_limits",
        "threads",
        "certificates",
        "moved",
    },
    {"safety", "audit", "adapted", "contract", "verb_declaration", "verb_parameters"},
    {
        "arm_mixin",
        "datasets",
        "kinematics",
        "leader_thread",
        "policies",
        "recording",
        "lead_mixin",
        "teleop_mixin",
        "teleoperators",
    },
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
    {"fleet"},
    {"cli", "tools", "mcp", "dashboard", "evaluation", "robot", "http_access", "testing"},
]

ASKS_KINDS = {"adapted", "contract"}
"""The modules that ask of which kind a robot is."""

NAMES_NO_NETWORK = ("mcp", "cli.mcp")
"""Faces of every network at once, which reach them through the fleet."""

SIBLING_NAMES: dict[str, str] = {}
"""Public class names that stand for the same idea in sibling backends."""

FOREIGN_ROOTS: dict[str, str] = {}
"""Public exceptions that a framework wants under a root of its own, with the reason."""

RIDDLES = re.compile(
    "(seats?|doors?|desk|lanes?|herald|pursuit|freezer|intake|tray|slip|roads?|whoever|nobody|somebody|anybody|everybody)"
)
"""Words that no name in the code may use, because readers have to learn them first."""

LONG_SUMMARIES_MAX = 35
"""Docstrings whose first line has 80 characters or more: descriptions that commands, agents and peers are shown."""


@cache
def nodes_of(path: Path) -> tuple[Any, ...]:
    """Return every node of a file; it is parsed and walked once for all tests."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def module_of(path: Path) -> str:
    """Return a file's module name inside the package, "" for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


MODULES = {module_of(path): path for path in SOURCES}


def floor_of(module: str) -> int:
    """Return the floor of a module's top-level part."""
    part = module.split(".", maxsplit=1)[0]
    for number, parts in enumerate(FLOORS):
        if part in parts:
            return number
    raise AssertionError(f"{part} has no floor; give it one here and in docs/architecture.md")


@cache
def imports(module: str) -> frozenset[str]:
    """Return the modules of the package that a module imports: at its top, in functions, or for types alone."""
    found = set()
    for node in nodes_of(MODULES[module]):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = MODULES[module].relative_to(PACKAGE.parent).parts[: -node.level] if node.level else ()
            source = ".".join([*package, *([node.module] if node.module else [])])
            names = [f"{source}.{alias.name}" for alias in node.names]
        for name in names:
            top, _, inside = name.partition(".")
            if top == "strands_robots":
                # The last part of `from a.b import c` is a module or a name inside the module a.b.
                found.add(inside if inside in MODULES else inside.rpartition(".")[0])
    return frozenset(found - {module})


def siblings_of(importer: str, imported: str) -> tuple[str, str] | None:
    """Return the files or folders beside each other that two modules belong to, or None inside one of them."""
    ours, theirs = importer.split("."), imported.split(".")
    for depth, (own, other) in enumerate(zip(ours, theirs, strict=False), 1):
        if own != other:
            return ".".join(ours[:depth]), ".".join(theirs[:depth])
    return None


def circle_through(start: str) -> list[str] | None:
    """Return the shortest way along imports from a module back to itself, or None."""
    ways = [[start]]
    seen: set[str] = set()
    for way in ways:
        for following in sorted(imports(way[-1])):
            if following == start:
                return [*way, start]
            if following not in seen:
                seen.add(following)
                ways.append([*way, following])
    return None


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    """Every class of the package with the module that defines it."""
    for module, path in MODULES.items():
        for node in nodes_of(path):
            if isinstance(node, ast.ClassDef):
                yield module, node


def ancestors(name: str, bases: dict[str, set[str]]) -> set[str]:
    """Return the names of a class and of all its bases, as far as the package defines them."""
    found, waiting = {name}, [name]
    while waiting:
        new = bases.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found


def is_exception(name: str) -> bool:
    builtin = getattr(builtins, name, None)
    if isinstance(builtin, type):
        return issubclass(builtin, BaseException)
    return name.endswith(("Error", "Exception"))


@pytest.mark.parametrize("module", [module for module in MODULES if module])
def test_a_module_imports_only_its_own_floor_and_the_floors_below(module: str) -> None:
    own = floor_of(module)
    for imported in filter(None, imports(module)):
        assert floor_of(imported) <= own, f"{module} (floor {own}) imports {imported} (floor {floor_of(imported)})"


def test_no_two_modules_import_each_other_directly_or_through_others() -> None:
    found = {}
    for module in MODULES:
        circle = circle_through(module)
        if circle:
            found[frozenset(circle)] = " -> ".join(circle)
    assert not found, "\n".join(sorted(found.values()))


def test_no_two_files_or_folders_beside_each_other_import_each_other() -> None:
    ways = {siblings_of(module, imported) for module in filter(None, MODULES) for imported in imports(module)}
    pairs = [way for way in ways if way is not None]
    assert ("serving", "safety") in pairs
    assert not [way for way in pairs if way[::-1] in pairs]


def test_only_contract_and_adapter_ask_of_which_kind_a_robot_is() -> None:
    asking = set()
    for module, path in MODULES.items():
        for node in nodes_of(path):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "issubclass"):
                kinds = {each.id for each in ast.walk(node.args[1]) if isinstance(each, ast.Name)}
                asking |= {module} if kinds & {"TaskRobot", "WorldRobot", "AdaptedRobot"} else set()
    assert asking == ASKS_KINDS


def test_device_connect_and_the_mesh_never_import_one_another() -> None:
    for module in MODULES:
        here, there = module.split(".")[0], {imported.split(".")[0] for imported in imports(module)}
        assert not (here == "device_connect" and "mesh" in there), module
        assert not (here == "mesh" and "device_connect" in there), module


def test_faces_of_every_network_name_none() -> None:
    faces = [module for module in MODULES if f"{module}.".startswith(tuple(f"{each}." for each in NAMES_NO_NETWORK))]
    assert set(NAMES_NO_NETWORK) <= set(faces)
    network = re.compile(r"device.connect|\bmesh\b", re.IGNORECASE)
    assert [module for module in faces if network.search(MODULES[module].read_text(encoding="utf-8"))] == []


def test_a_public_class_name_stands_for_one_idea() -> None:
    homes = defaultdict(set)
    for module, node in classes():
        if not node.name.startswith("_"):
            homes[node.name].add(module)
    twins = {name: sorted(modules) for name, modules in homes.items() if len(modules) > 1}
    assert not {name: modules for name, modules in twins.items() if name not in SIBLING_NAMES}


def test_every_public_exception_derives_from_the_one_root() -> None:
    bases: dict[str, set[str]] = defaultdict(set)
    for _, node in classes():
        bases[node.name] |= {ast.unparse(base).split(".")[-1].split("[")[0] for base in node.bases}
    unrooted = set()
    for name in bases:
        lineage = ancestors(name, bases)
        if not name.startswith("_") and any(map(is_exception, lineage)) and "StrandsRobotsError" not in lineage:
            unrooted.add(name)
    assert not unrooted - set(FOREIGN_ROOTS)


def docstrings() -> Iterator[tuple[str, str]]:
    """Every docstring of the package with its place."""
    for path in SOURCES:
        for node in nodes_of(path):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    yield f"{relative(path)}:{getattr(node, 'lineno', 1)}", text


def test_no_docstring_opens_with_a_question_word() -> None:
    question = re.compile(r"(What|Who|Whom|Whose|Where|How|Whether|Why|When)\b")
    found = [f"{place} {text.splitlines()[0]}" for place, text in docstrings() if question.match(text)]
    assert not found, "\n".join(found)


def test_the_first_line_of_a_docstring_is_short() -> None:
    found = [f"{place} {first}" for place, text in docstrings() if len(first := text.splitlines()[0]) >= 80]
    assert len(found) <= LONG_SUMMARIES_MAX, "\n".join(found)


def test_no_name_needs_a_word_that_readers_have_to_learn_first() -> None:
    found = []
    for path in SOURCES:
        names = {path.stem}
        for node in nodes_of(path):
            named = getattr(node, "name", None) or getattr(node, "arg", None) or getattr(node, "id", None)
            names.add(named or getattr(node, "attr", None) or "")
        for name in sorted(filter(None, names)):
            words = set(re.findall(r"[a-z]+", re.sub(r"([A-Z])", r"_\1", name).lower()))
            found += [f"{relative(path)}: {name}" for word in words if RIDDLES.fullmatch(word)]
    assert not found, "\n".join(found)


def test_every_file_is_short_enough_to_hold_in_the_head() -> None:
    folders = ("src", "plugins", "tests", "fixtures", "benchmarks", "examples", "scripts")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    long = {relative(path): count for path in files if (count := len(path.read_text("utf-8").splitlines())) > LINES_MAX}
    assert files
    assert not long


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_no_exception_is_swallowed(path: Path) -> None:
    for node in nodes_of(path):
        if isinstance(node, ast.ExceptHandler):
            assert not (len(node.body) == 1 and isinstance(node.body[0], ast.Pass)), f"{relative(path)}:{node.lineno}"


@pytest.mark.parametrize("path", [p for p in SOURCES if p.name != "settings.py"], ids=relative)
def test_only_settings_reads_the_environment(path: Path) -> None:
    reads = {"environ", "getenv"}
    for node in nodes_of(path):
        name = node.attr if isinstance(node, ast.Attribute) else ""
        assert name not in reads, f"{relative(path)}:{node.lineno} reads the environment; declare it in settings.py"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_no_module_reads_an_underscore_name_of_another(path: Path) -> None:
    if path.name == "_compat.py":
        return
    nodes = nodes_of(path)
    modules = {alias.asname or alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
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
