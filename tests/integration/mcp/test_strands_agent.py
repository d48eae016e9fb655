"""A Strands agent does the task of the demo through the MCP server."""

from __future__ import annotations

import sys

import pytest
from fixtures.mcp_site import McpSite

from strands_robots.testing import ScriptedModel

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp.client.stdio import StdioServerParameters, stdio_client
from strands import Agent
from strands.tools.mcp import MCPClient

CUBE, PLATE = (0.25, 0.05), (0.24, -0.12)


def test_a_strands_agent_puts_the_cube_on_the_plate(site: McpSite) -> None:
    arm = site.arm
    arm.add_object("cube", "box", 0.0125, (*CUBE, 0.0125))
    arm.add_object("plate", "cylinder", (0.05, 0.004), (*PLATE, 0.004), fixed=True)
    server = StdioServerParameters(command=sys.executable, args=site.command(), env=site.environment)
    model = ScriptedModel(
        [
            ("list_robots", {}),
            ("get_picture", {"robot": "arm-2", "camera": "table"}),
            ("get_objects", {"robot": "arm-2"}),
            ("grasp", {"robot": "arm-2", "action": "pick", "object": "cube"}),
            ("grasp", {"robot": "arm-2", "action": "place", "on": "plate"}),
            "The cube is on the plate.",
        ]
    )
    with MCPClient(lambda: stdio_client(server)) as client:
        agent = Agent(model=model, tools=client.list_tools_sync(), callback_handler=None)
        assert "on the plate" in str(agent("Put the cube on the plate."))
    (cube,) = (each for each in arm.get_objects()["objects"].items() if each[0] == "cube")
    assert cube[1]["x"] == pytest.approx(PLATE[0], abs=0.03), cube
    assert cube[1]["y"] == pytest.approx(PLATE[1], abs=0.03), cube
    seen = str(model.seen[-1])
    assert "image" in seen, "the model was shown no picture"
    # Its threads began in this test.
    site.close_arm()
