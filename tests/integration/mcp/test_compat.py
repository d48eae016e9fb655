"""The SDK's private members that the server uses are what they were."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from fixtures.mcp_frames import INITIALIZE

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp.server.lowlevel import Server
from mcp.server.mcpserver import MCPServer
from mcp.server.streamable_http_manager import StreamableHTTPSessionManager

from strands_robots.mcp._compat import end_session, lowlevel


def test_the_server_below_takes_handlers_of_methods() -> None:
    assert isinstance(lowlevel(MCPServer("any")), Server)
    assert callable(Server.add_request_handler)


async def test_an_ended_session_is_forgotten() -> None:
    manager = StreamableHTTPSessionManager(lowlevel(MCPServer("any")))
    received = Received()
    async with manager.run():
        await manager.handle_request(*received.request("POST", INITIALIZE))
        (session_id,) = manager._server_instances
        assert session_id == received.session_id
        await end_session(manager, session_id)
        assert not manager._server_instances
        assert not manager._session_owners


class Received:
    """One ASGI request, and the session that its answer names."""

    session_id = ""

    def request(self, method: str, message: dict[str, Any]) -> tuple[Any, Any, Any]:
        """Return scope, receive and send."""
        headers = {"host": "any", "accept": "application/json, text/event-stream", "content-type": "application/json"}
        pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "method": method, "path": "/mcp", "query_string": b"", "headers": pairs}
        received: asyncio.Queue[Any] = asyncio.Queue()
        received.put_nowait({"type": "http.request", "body": json.dumps(message).encode(), "more_body": False})

        async def send(sent: Any) -> None:
            self.session_id = dict(sent.get("headers", [])).get(b"mcp-session-id", b"").decode() or self.session_id

        return scope, received.get, send
