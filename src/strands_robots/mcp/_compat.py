"""Private member of the MCP SDK that is used here, for ``mcp`` 2.1 to 2.3.

``tests/integration/mcp/test_compat.py`` fails when it changes.
"""

from __future__ import annotations

from typing import Any

from mcp.server.mcpserver import MCPServer


def lowlevel(server: MCPServer[Any]) -> Any:
    """Return the server below, on which handlers of single methods are registered.

    ``MCPServer`` lists all resources in one answer and has no ``resources/subscribe``.
    """
    return server._lowlevel_server
