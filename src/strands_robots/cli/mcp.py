"""``mcp``: all robots for MCP clients, on stdio or over HTTP."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import device_id, install_line, port

if TYPE_CHECKING:
    from strands_robots.fleet.networks import Networks


def mcp(
    screen: Screen,
    network: Network,
    *,
    source: Annotated[str, typer.Option("--as", help="The caller that robots see.")] = "mcp",
    read_only: Annotated[bool, typer.Option("--read-only", help="Tools that read and stop, none that moves.")] = False,
    http: Annotated[
        str | None, typer.Option("--http", metavar="[HOST:]PORT", help="Serve HTTP there instead of stdin and stdout.")
    ] = None,
    http_cert: Annotated[Path | None, typer.Option("--http-cert", help="Certificate of the HTTP server (PEM).")] = None,
    http_key: Annotated[Path | None, typer.Option("--http-key", help="Its private key (PEM).")] = None,
    http_name: Annotated[
        list[str] | None, typer.Option("--http-name", help="A host name by which clients reach it (repeat).")
    ] = None,
) -> None:
    """Serve all robots to an MCP client that starts this (stdio), or over HTTP."""
    name = device_id("--as", source)
    try:
        from strands_robots.mcp.server import serve_stdio  # noqa: PLC0415 - loaded when it is used
    except ModuleNotFoundError as missing:
        raise CliError(f"The MCP server needs the extra mcp ({install_line('mcp')}): {missing}.") from missing

    def networks_of(caller: str) -> Networks:
        return network.networks(source=caller, stays=True)

    if http is None:
        with networks_of(name) as networks:
            asyncio.run(serve_stdio(networks, name, read_only=read_only))
        return
    from strands_robots.http_access import Token  # noqa: PLC0415 - as above
    from strands_robots.mcp.http import Address, serve_http  # noqa: PLC0415 - as above

    host, _, number = http.rpartition(":")
    try:
        at = port("--http", int(number))
    except ValueError:
        raise CliError(f"--http takes a port or HOST:PORT, not {http!r}.", Exit.USAGE) from None
    address = Address(host.strip("[]") or "127.0.0.1", at, http_cert, http_key, tuple(http_name or ()))
    default = Token(name, read_only=read_only)
    try:
        asyncio.run(serve_http(networks_of, address, default=default, ready=screen.say))
    except CliError:
        raise
    except (StrandsRobotsError, OSError) as problem:
        raise CliError(str(problem), Exit.USAGE) from problem
