"""``mcp``: all robots of a network for any MCP client, on stdin and stdout."""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from strands_robots.cli.command import command
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Screen
from strands_robots.utils import device_id, install_line


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    command(app, "mcp", network=True)(mcp)


def mcp(
    screen: Screen,
    network: Network,
    *,
    source: Annotated[str, typer.Option("--as", help="The caller that robots see.")] = "mcp",
    read_only: Annotated[bool, typer.Option("--read-only", help="Tools that read and stop, none that moves.")] = False,
) -> None:
    """Serve all robots to an MCP client that starts this command (stdio)."""
    name = device_id("--as", source)
    try:
        from strands_robots.mcp.caller import Caller  # noqa: PLC0415 - loaded when it is used
        from strands_robots.mcp.server import serve_stdio  # noqa: PLC0415 - as above
    except ModuleNotFoundError as missing:
        raise CliError(f"The MCP server needs the extra mcp ({install_line('mcp')}): {missing}.") from missing
    with network.fleet(name) as fleet:
        asyncio.run(serve_stdio(Caller(fleet), read_only=read_only))
