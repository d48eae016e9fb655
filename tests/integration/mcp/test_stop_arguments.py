"""No argument refuses a stop over MCP: none is needed, and what cannot be read stops more."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.mcp_site import McpSite

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots.safety.plane import plane

# The older revision runs with `make test-all`.
BOTH = pytest.mark.parametrize("mode", [pytest.param("legacy", marks=pytest.mark.system), "2026-07-28"])
STOPS: list[tuple[dict[str, Any], str]] = [
    ({}, ""),
    ({"robot": None}, ""),
    ({"robot": ""}, ""),
    ({"robot": 5}, "robot is no robot's id"),
    ({"robot": "a b"}, "robot is no robot's id"),
    ({"robot": "x" * 10_000}, "robot is no robot's id"),
    ({"robot": "arm-1", "robot_name": ["left"]}, "robot_name is not readable"),
    ({"robot": "arm-1", "robot_name": "x" * 10_000}, "robot_name is not readable"),
    ({"robot": "arm-1", "reason": "y" * 10_000, "": {}}, "2 unknown arguments"),
    ({"name": "arm-1"}, "1 unknown argument"),
]
EMERGENCY_STOPS: list[tuple[dict[str, Any], str]] = [
    ({}, ""),
    ({"reason": ""}, ""),
    ({"reason": None}, ""),
    ({"reason": 5}, "reason is a int"),
    ({"reason": {"why": []}}, "reason is a dict"),
    ({"reason": "smoke\x00"}, "cannot be printed"),
    ({"reason": "x" * 100_000}, "cut to 200 of 100000"),
    ({"robot": "arm-1", "now": True}, "2 unknown arguments"),
]


@BOTH
async def test_no_argument_refuses_a_stop(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        for given, said in STOPS:
            site.world.start_policy("left", "wave", duration=60.0)
            await site.until(True)
            answer = await client.call_tool("stop", given)
            assert not site.moving, given
            assert not answer.is_error, (given, answer)
            assert said in answer.structured_content["data"].get("ignored", ""), (given, answer)
            assert bool(said) is ("ignored" in answer.structured_content["data"])


@BOTH
async def test_no_argument_refuses_an_emergency_stop(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        for given, said in EMERGENCY_STOPS:
            answer = await client.call_tool("emergency_stop", given)
            assert len(locks()) == 1, given
            assert said in answer.structured_content["data"].get("ignored", ""), (given, answer)
            assert bool(said) is ("ignored" in answer.structured_content["data"])
            plane().clear_local("the test")


def locks() -> tuple[Any, ...]:
    """Return the lockouts of the world."""
    return next((held for name, held in plane().lockouts().items() if "arm-1" in name), ())
