"""The pages name files, sections, commands, programs, settings and extras that exist."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.main import get_command

from strands_robots.cli.app import build

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "src" / "strands_robots"
NAMED_FROM = (ROOT, SOURCES, ROOT / "tests" / "integration" / "safety")
"""Folders that the pages name files from: safety-proofs.md has a table of its integration tests by name alone."""

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def test_the_tables_of_settings_and_extras_are_those_of_the_code() -> None:
    run = subprocess.run(
        [sys.executable, "scripts/tables.py", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr


def sections(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file_and_a_section_of_it(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in target and not target.startswith("mailto:"):
            file, _, anchor = target.partition("#")
            linked = page.parent / file if file else page
            assert linked.exists(), f"{page.name} links to {target}"
            assert not anchor or anchor in sections(linked), f"{page.name} links to {target}"


def invocations(text: str) -> Iterator[list[str]]:
    """The words of every ``strands-robots`` command in the code of a page, without comments and outputs."""
    code = re.findall(r"```(?:console|bash)\n(.*?)```", text, flags=re.DOTALL)
    code += re.findall(r"`(strands-robots [^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    for block in code:
        for line in block.replace("\\\n", " ").splitlines():
            for command in re.findall(
                r"(?:^\$ |^|\s)(?:[\w./]*/)?strands-robots ((?:(?!strands-robots |  #).)+)", line
            ):
                yield command.rstrip(".").split()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_option_that_a_page_names_exists(page: Path) -> None:
    application = get_command(build())
    for words in invocations(page.read_text(encoding="utf-8")):
        command, rest = application, words
        while rest and rest[0] in getattr(command, "commands", {}):
            command, rest = command.commands[rest[0]], rest[1:]
        assert command is not application or words[0].startswith("--"), f"{page.name}: strands-robots {' '.join(words)}"
        options = {option for parameter in command.params for option in [*parameter.opts, *parameter.secondary_opts]}
        for word in rest:
            if re.fullmatch(r"--?[a-z][a-z-]*", word):
                assert word in {*options, "--help"}, f"{page.name}: strands-robots {' '.join(words)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_program_of_a_page_parses_and_imports_names_that_exist(page: Path) -> None:
    for program in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
        for node in ast.walk(ast.parse(program)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("strands_robots"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{page.name}: {node.module} has no {alias.name}"


def test_every_term_of_the_glossary_is_linked_from_another_page() -> None:
    glossary = ROOT / "docs" / "glossary.md"
    linked = {
        anchor
        for page in PAGES
        if page != glossary
        for anchor in re.findall(r"glossary\.md#([\w-]+)", page.read_text(encoding="utf-8"))
    }
    terms = re.findall(r"^### (.+)$", glossary.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert terms
    assert not [term for term in terms if term.lower().replace(" ", "-") not in linked]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_make_target_that_a_page_names_exists(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    for named in re.findall(r"`make ([a-z-]+)", page.read_text(encoding="utf-8")):
        assert named in targets, named


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    for span in re.findall(r"`([^`\s]+)`", page.read_text(encoding="utf-8")):
        file, _, test = span.partition("::")
        if file != "_compat.py" and re.fullmatch(r"[\w./-]*\w\.(py|sh)|\w[\w/]*/", file):
            found = [root / file for root in NAMED_FROM if (root / file).exists()]
            assert found, f"{page.name} names {span}"
            assert not test or f"def {test}(" in found[0].read_text(encoding="utf-8"), f"{page.name} names {span}"


ENTRY_POINT_GROUPS = ("strands_robots.robots", "strands_robots.teleoperators", "strands_robots.policies")
"""Groups of entry points, which are no modules."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_module_and_class_that_a_page_names_exists(page: Path) -> None:
    # The tables are written from the code; one has the modules of an earlier release.
    text = re.sub(r"<!-- table: .*?<!-- end -->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for dotted in re.findall(r"\b(?:strands_robots|drivers|simulation|fixtures)(?:\.(?!md\b|py\b)\w+)+", text):
        if dotted in ENTRY_POINT_GROUPS:
            continue
        parts = dotted.split(".")
        for length in range(len(parts), 0, -1):
            homes = [root.joinpath(*parts[:length]) for root in (ROOT, SOURCES.parent, SOURCES)]
            files = [
                file for home in homes for file in (home.with_suffix(".py"), home / "__init__.py") if file.is_file()
            ]
            if files:
                rest = parts[length : length + 1]
                assert not rest or re.search(rf"\b{rest[0]}\b", files[0].read_text(encoding="utf-8")), dotted
                break
        else:
            raise AssertionError(f"{page.name} names {dotted}")


def test_every_make_target_that_the_pipelines_run_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    for pipeline in (ROOT / ".github" / "workflows" / "ci.yml", ROOT / ".ci" / "run"):
        if pipeline.exists():  # a source archive has neither
            named = re.findall(r"(?:^|run: )make ([a-z-]+)", pipeline.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert {"lint", "test", "test-all"} <= set(named) <= targets


def test_the_pipeline_runs_every_python_that_the_package_names() -> None:
    workflow = ROOT / ".github" / "workflows" / "ci.yml"
    if workflow.exists():
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        named = [line.rpartition(" ")[2] for line in project["classifiers"] if "Python :: 3." in line]
        tested = re.search(r"python: \[(.*)\]", workflow.read_text(encoding="utf-8"))
        assert tested is not None
        assert re.findall(r"3\.\d+", tested[1]) == named
