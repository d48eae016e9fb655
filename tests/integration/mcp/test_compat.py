"""The SDK's private member that the server uses is what it was."""

from __future__ import annotations

import pytest

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp.server.lowlevel import Server
from mcp.server.mcpserver import MCPServer

from strands_robots.mcp._compat import lowlevel


def test_the_server_below_takes_handlers_of_methods() -> None:
    assert isinstance(lowlevel(MCPServer("any")), Server)
    assert callable(Server.add_request_handler)
