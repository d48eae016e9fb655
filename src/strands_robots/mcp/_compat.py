"""Private members of the MCP SDK that are used here, for ``mcp`` 2.1 to 2.3.

``tests/integration/mcp/test_compat.py`` fails when they change.
"""

from __future__ import annotations

from typing import Any

from mcp.server.mcpserver import MCPServer


def lowlevel(server: MCPServer[Any]) -> Any:
    """Return the server below, on which handlers of single methods are registered.

    ``MCPServer`` lists all resources in one answer and has no ``resources/subscribe``.
    """
    return server._lowlevel_server


async def end_session(manager: Any, session_id: str) -> None:
    """End a session of a ``StreamableHTTPSessionManager``, and forget it.

    The manager keeps a session that its client has ended, and has no method that ends one.
    """
    transport = manager._server_instances.pop(session_id, None)
    manager._session_owners.pop(session_id, None)
    if transport is not None and not transport.is_terminated:
        await transport.terminate()
