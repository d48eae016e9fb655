"""Malformed calls are answered by name, whatever they hold, and none of them stops the server."""

from __future__ import annotations

import asyncio
import json
import random
from typing import Any

import pytest
from fixtures.mcp_site import McpSite

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

CALLS = 10_000
AT_ONCE = 20
STOPS = {"stop", "emergency_stop"}
"""Tools that no argument refuses; their test is in ``test_stop_arguments.py``."""

SLOW = {"lockouts", "list_robots", "describe_robot"}
"""Tools that look for all robots for a fifth of a second; they are called less often."""

WRONG: list[Any] = [
    *(None, True, False, 0, -1, 10**30, 1e308, 5e-324, "", " ", "\x00", "nan", "1.5", "true"),
    *("arm-1/../x", "*", ">", "a.b", "x" * 5000, "é" * 300, "[1]", '{"x": 1}', "ignore all rules", "robot\nstatus"),
    *([], [None], [[[[]]]], {}, {"x": True}, {"x": "1", "y": None, "z": []}, {"dx": {"dy": 1}}, {"": ""}),
]
GOOD: dict[str, list[Any]] = {"robot": ["arm-1", "arm-2", "none"], "action": ["pick", "place", "set_gripper"]}


def arguments(tool: Any, chance: random.Random) -> dict[str, Any]:
    """Return arguments of which at least one is wrong."""
    names = list(tool.input_schema.get("properties", {}))
    wrong = {name: chance.choice(WRONG) for name in names if chance.random() < 0.5}
    right = {name: chance.choice(GOOD[name]) for name in names if name in GOOD and chance.random() < 0.7}
    # One that the tool does not have, so that no call is good by chance.
    return {**wrong, **right, chance.choice(["unknown", "self", "context", "__class__", "wait ", "lease_id"]): 1}


@pytest.mark.timeout(400)
async def test_ten_thousand_malformed_calls_are_answered_by_name(site: McpSite) -> None:
    chance = random.Random(17)
    async with site.client() as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools if tool.name not in STOPS}

        async def refused() -> None:
            name = chance.choice(list(tools))
            given = arguments(tools[name], chance)
            answer = await client.call_tool(name, given)
            assert answer.is_error, (name, given, answer)
            said = answer.structured_content["text"]
            assert name in said, (name, given, said)
            assert "takes no argument" in said, (name, given, said)

        for _ in range(CALLS // AT_ONCE):
            await asyncio.gather(*(refused() for _ in range(AT_ONCE)))
        assert not (await client.call_tool("get_state", {"robot": "arm-1"})).is_error
    assert not site.moving


@pytest.mark.timeout(400)
async def test_wrong_values_are_refused_by_the_name_of_their_argument(site: McpSite) -> None:
    chance = random.Random(4)
    async with site.client() as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools if tool.name not in SLOW | STOPS}
        for _ in range(1500):
            tool = tools[chance.choice(list(tools))]
            name = chance.choice(list(tool.input_schema["properties"]))
            schema = json.dumps(tool.input_schema["properties"][name])
            good = {each: GOOD[each][-1] for each in tool.input_schema.get("required", []) if each in GOOD}
            value = chance.choice([each for each in WRONG if not fits(each, schema)] or [None])
            more = {"instruction": "wave"} if tool.name == "run_policy" else {}
            answer = await client.call_tool(tool.name, {**more, **good, name: value})
            assert answer.is_error, (tool.name, name, value, answer)
            assert name in answer.structured_content["text"], (tool.name, name, value, answer.structured_content)
    assert not site.moving


def fits(value: object, schema: str) -> bool:
    """True where a value may be what the argument takes, or the tool tells more of it."""
    if isinstance(value, str):
        return '"string"' in schema or value[:1] in {"[", "{", "n", "t", "1"}
    if value is None:
        return '"null"' in schema
    if isinstance(value, bool):
        return '"boolean"' in schema
    if isinstance(value, int | float):
        return '"number"' in schema or '"integer"' in schema
    return '"object"' in schema or isinstance(value, list)
