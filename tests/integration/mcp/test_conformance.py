"""The official conformance scenarios of MCP pass, without a list of expected failures."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.mcp_site import McpSite
from fixtures.waiting import free_port

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

pytestmark = pytest.mark.system

FOLDER = Path(__file__).resolve().parents[3] / ".mcp-conformance"
NODE = str(FOLDER / "node_modules/node/bin/node")
PROGRAM = [NODE, str(FOLDER / "node_modules/@modelcontextprotocol/conformance/dist/index.js"), "server"]
NEXT = FOLDER / "node_modules/conformance-next/dist/index.js"

APPLY = (
    *("server-initialize", "ping", "tools-list", "resources-list", "prompts-list", "server-sse-multiple-streams"),
    *("dns-rebinding-protection", "resources-subscribe", "resources-unsubscribe"),
)
"""Scenarios that call nothing but what every server has."""

APPLY_NEXT = (
    *("tools-list", "resources-list", "prompts-list", "server-sse-multiple-streams", "dns-rebinding-protection"),
    *("caching", "http-header-validation", "sep-2164-resource-not-found"),
)
"""Such scenarios of revision 2026-07-28."""

FIXED = 32
"""Scenarios up to revision 2025-11-25."""


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    if not Path(PROGRAM[0]).exists():
        pytest.skip("needs scripts/mcp-conformance.sh")


def conformance(*flags: str, program: list[str] = PROGRAM) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*program, *flags], capture_output=True, text=True, timeout=110, check=False)


@pytest.mark.parametrize("scenario", APPLY)
def test_the_server_passes_what_applies_to_it(site: McpSite, served: str, scenario: str) -> None:
    ran = conformance("--url", served, "--scenario", scenario)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize("scenario", APPLY_NEXT)
def test_the_server_passes_what_applies_to_it_in_the_newest_revision(site: McpSite, served: str, scenario: str) -> None:
    if not NEXT.exists():
        pytest.skip("needs scripts/mcp-conformance.sh")
    flags = ("--url", served, "--scenario", scenario, "--spec-version", "2026-07-28")
    ran = conformance(*flags, program=[NODE, str(NEXT), "server"])
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.fixture(scope="module")
def served(site: McpSite) -> Iterator[str]:
    with site.http() as url:
        yield url


# The suite still asks for sampling, which the newest SDK calls deprecated.
@pytest.mark.filterwarnings("ignore:The sampling capability is deprecated")
def test_a_server_with_the_fixtures_passes_every_scenario(site: McpSite) -> None:
    command = [sys.executable, "-m", "fixtures.mcp_conformance", str(site.port), str(free_port())]
    with subprocess.Popen(command, env=site.environment, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            ran = conformance("--url", server.stdout.readline().strip(), "--suite", "all")
        finally:
            server.terminate()
    summary = [line for line in ran.stdout.splitlines() if " passed, " in line and ": " in line]
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert sum(line.startswith("✓") for line in summary) == FIXED, summary
