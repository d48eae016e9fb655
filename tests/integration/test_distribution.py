"""The wheel and the source archive: their contents, their metadata, and the demo run from the installed wheel.

Nothing here needs a network.
"""

from __future__ import annotations

import json
import re
import subprocess
import tarfile
import zipfile
from email.message import Message
from email.parser import HeaderParser
from pathlib import Path
from urllib.request import urlopen

import pytest
from fixtures.command_line import Machine
from fixtures.empty_environment import ROOT, build, empty_environment, run

from strands_robots import __version__

DEMO_S = 200.0
NOT_SHIPPED = (".ci/", ".github/", ".gitignore", ".pre-commit-config.yaml")
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the wheel and the source archive of this checkout."""
    folder = tmp_path_factory.mktemp("dist")
    build(ROOT, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    return built / f"strands_robots_edge-{__version__}-py3-none-any.whl"


@pytest.fixture(scope="module")
def about(wheel: Path) -> Message:
    """The metadata of the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read(f"strands_robots_edge-{__version__}.dist-info/METADATA").decode()
    return HeaderParser().parsestr(text)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of an environment that holds the wheel, what demo.lock names, and nothing else."""
    return empty_environment(tmp_path_factory.mktemp("empty"), wheel)


def tracked() -> set[str]:
    """Return every file that git tracks and that is here."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}


def test_the_wheel_holds_every_file_of_the_package_and_no_other(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    demo = {
        name.replace("examples/demo", "strands_robots/_demo") for name in tracked() if name.startswith("examples/demo/")
    }
    assert names == {name.removeprefix("src/") for name in tracked() if name.startswith("src/")} | demo
    assert "strands_robots/py.typed" in names


def test_the_source_archive_holds_what_a_test_run_needs(built: Path) -> None:
    top = f"strands_robots_edge-{__version__}/"
    with tarfile.open(built / f"strands_robots_edge-{__version__}.tar.gz") as archive:
        names = {name.removeprefix(top) for name in archive.getnames()}
    assert {"PKG-INFO", "pyproject.toml", "LICENSE", "Makefile", "README.md", "CHANGELOG.md", "SECURITY.md"} <= names
    assert not {name for name in tracked() if not name.startswith(NOT_SHIPPED)} - names


def test_the_metadata_names_the_distribution_its_license_its_command_and_its_pytest_plug_in(
    wheel: Path, about: Message
) -> None:
    assert (about["Name"], about["Version"]) == ("strands-robots-edge", __version__)
    assert about["Requires-Python"] == ">=3.11"
    assert about["License-Expression"] == "Apache-2.0"
    with zipfile.ZipFile(wheel) as archive:
        commands = archive.read(f"strands_robots_edge-{__version__}.dist-info/entry_points.txt").decode()
    assert "strands-robots = strands_robots.cli:main" in commands
    assert "[pytest11]\nstrands_robots = strands_robots.testing.pytest_plugin" in commands


def test_the_metadata_has_every_extra_that_a_page_or_a_refusal_names(about: Message) -> None:
    named: dict[str, str] = {}
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        lists = re.findall(r"(?:'\.|strands-robots-edge)\[([a-z0-9, -]+)\]", text)
        table = re.search(r"<!-- table: extras -->(.*?)<!-- end -->", text, flags=re.DOTALL)
        rows = re.findall(r"^\| `([a-z0-9-]+)`", table[1], flags=re.MULTILINE) if table else []
        for extra in [*rows, *(name.strip() for names in lists for name in names.split(","))]:
            named[extra] = page.name
    for path in (ROOT / "src").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for extra in re.findall(r"(?:missing_extra\([^)]*, |install_line\()[\"']([a-z0-9-]+)[\"']\)", text):
            named[extra] = path.name
    assert {"sim", "mesh", "device-connect", "all"} <= set(named)
    assert not {extra: where for extra, where in named.items() if extra not in (about.get_all("Provides-Extra") or ())}


def test_the_installed_wheel_says_its_name_and_version(installed: Path, tmp_path: Path) -> None:
    assert run(installed / "strands-robots", "--version", cwd=tmp_path) == f"strands-robots-edge {__version__}\n"
    where = run(installed / "python", "-c", "import strands_robots; print(strands_robots.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(installed.parent)


def test_the_installed_wheel_names_itself_in_the_hint_for_a_missing_extra(installed: Path, tmp_path: Path) -> None:
    code = "from strands_robots.utils import install_line; print(install_line('mesh'))"
    assert run(installed / "python", "-c", code, cwd=tmp_path) == "pip install 'strands-robots-edge[mesh]'\n"


def test_the_demo_runs_from_the_installed_wheel(installed: Path, tmp_path: Path) -> None:
    halt_on_a_busy_machine = {"STRANDS_STATE_DIR": str(tmp_path / "state"), "STRANDS_HALT_DEADLINE_S": "20"}
    report = json.loads(
        run(installed / "strands-robots", "demo", "--json", cwd=tmp_path, **halt_on_a_busy_machine),
    )
    assert report["status"] == "success"
    assert all(step["ok"] for step in report["steps"])
    assert (tmp_path / "demo-output" / "arm-path.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_starts_from_the_installed_wheel(installed: Path, tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    command = [installed / "strands-robots", "dashboard", "--no-browser", "--port", "0", "--json"]
    page = subprocess.Popen(command, cwd=tmp_path, env=machine.environment, stdout=subprocess.PIPE, text=True)
    try:
        assert page.stdout is not None
        url = json.loads(page.stdout.readline())["url"]
        with urlopen(url, timeout=20) as answer:
            assert b"<title>" in answer.read()
    finally:
        page.terminate()
        page.communicate(timeout=60)


def test_the_mcp_server_starts_from_the_installed_wheel(installed: Path, tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    client = {"name": "test", "version": "1"}
    params = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client}
    question = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": params}
    server = subprocess.Popen(
        [installed / "strands-robots", "mcp"],
        cwd=tmp_path,
        env=machine.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdin is not None
        assert server.stdout is not None
        server.stdin.write(json.dumps(question) + "\n")
        server.stdin.flush()
        assert json.loads(server.stdout.readline())["result"]["serverInfo"]
    finally:
        server.kill()
        server.communicate()
