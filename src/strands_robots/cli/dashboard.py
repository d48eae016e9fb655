"""``dashboard``: every robot in a browser, with a STOP. ``demo``: an example."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen
from strands_robots.utils import device_id, missing_extra

if TYPE_CHECKING:
    from strands_robots.dashboard.access import RemoteAddress
    from strands_robots.dashboard.server import Dashboard

EXAMPLE = "strands_robots._demo"
"""Name of the example's package, which the wheel has, and a source tree keeps in ``examples/demo``."""


def demo(
    screen: Screen,
    *,
    output: Annotated[Path, typer.Option("--output", help="Folder for the pictures.")] = Path("demo-output"),
    record: Annotated[Path | None, typer.Option("--record", help="Write the terminal output as SVG.")] = None,
) -> None:
    """An agent in another process looks at a table and has a simulated arm put the red cube on the plate. A stop halts
    it; an emergency stop locks it until an operator's key frees it. Nothing leaves this machine.

    Exits with 1 when any step did not happen, or the cube is not on the plate.
    """
    example().run(screen, output, record)


def example(part: str = "") -> Any:
    """Return the example's package, or the module ``part`` of it."""
    if find_spec(EXAMPLE) is None:
        file = Path(__file__).parents[3] / "examples" / "demo" / "__init__.py"
        spec = spec_from_file_location(EXAMPLE, file)
        if spec is None or spec.loader is None:
            raise ModuleNotFoundError(f"{file} is no module.")
        sys.modules[EXAMPLE] = package = module_from_spec(spec)
        spec.loader.exec_module(package)
    return import_module(f"{EXAMPLE}.{part}" if part else EXAMPLE)


PORT = 8800
START_S = 10.0
POLL_S = 0.02


def dashboard(
    screen: Screen,
    network: Network,
    *,
    port: Annotated[int, typer.Option("--port", help="Port of the page; 0 for a free one.", min=0, max=65535)] = PORT,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Do not open a browser.")] = False,
    listen: Annotated[
        str | None,
        typer.Option(
            "--listen", help="Also serve it at this address, with TLS, a token and a QR code.", metavar="ADDRESS"
        ),
    ] = None,
    viewer: Annotated[bool, typer.Option("--viewer", help="Pages on this machine look and stop only.")] = False,
    key: Annotated[
        Path | None, typer.Option("--key", help="Sign stops with it; then only enrolled robots confirm one.")
    ] = None,
    operator_key: Annotated[
        Path | None, typer.Option("--operator-key", help="Frees robots; its passphrase is asked for on the page.")
    ] = None,
    passphrase_file: PassphraseFile = None,
    source: Annotated[str, typer.Option("--as", help="The caller and the source that robots see.")] = "dashboard",
    meet: Annotated[
        int | None, typer.Option("--meet", help="Loopback port where local robots meet.", min=1, max=65535)
    ] = None,
    mesh: Annotated[bool, typer.Option("--mesh", help="Say so where the native mesh is not there.")] = False,
    demo: Annotated[bool, typer.Option("--demo", help="Serve four simulated robots to try it with.")] = False,
) -> None:
    """Show every robot in a browser: watch, drive, stop; on 127.0.0.1 alone."""
    settings.warn_of_unread()
    source = device_id("--as", source)
    if operator_key is not None and not operator_key.is_file():
        raise CliError(f"--operator-key {operator_key} is no file.", Exit.USAGE)
    if demo and (operator_key is not None or meet is not None or mesh or network != Network()):
        raise CliError("--demo has robots, a network and an operator's key of its own.", Exit.USAGE)
    if mesh and mesh_env_request() is False:
        raise CliError("--mesh: STRANDS_MESH switches the mesh off.", Exit.USAGE)
    signer = None if key is None else signing_key(key, passphrase_file)
    try:
        # Loaded when they are used.
        from strands_robots.dashboard.access import OperatorKey, access_for, remote_address  # noqa: PLC0415
        from strands_robots.dashboard.feeds import Feeds  # noqa: PLC0415 - as above
        from strands_robots.dashboard.fleet_model import FleetModel  # noqa: PLC0415 - as above
        from strands_robots.dashboard.server import Dashboard  # noqa: PLC0415 - as above
    except ModuleNotFoundError as exc:
        raise missing_extra("The page", "dashboard") from exc
    with ExitStack() as stack:
        robots: Any = None
        if demo:
            page_demo = example("page")
            robots = stack.enter_context(page_demo.page_robots(screen))
            meet, operator_key, network = robots.port, robots.key, replace(network, tenant=page_demo.TENANT)
        sockets = [stack.enter_context(_bound("127.0.0.1", port))]
        port = int(sockets[0].getsockname()[1])
        remote = None if listen is None else remote_address(listen, port)
        if remote is not None:
            sockets.append(stack.enter_context(_bound(remote.host, port)))
        model = FleetModel()
        networks = replace(network, port=meet).networks(source=source, stays=True, with_mesh=mesh)
        if not networks.stated:
            raise CliError(f"No network is there: {networks.absences}.", Exit.SILENT)
        stack.callback(networks.close)
        page = Dashboard(
            model,
            Feeds(model, networks, signer),
            access_for(port, remote, viewer=viewer),
            OperatorKey(operator_key),
            source=source,
            signed=signer is not None,
            starting=() if robots is None else tuple(page_demo.ROBOTS),
        )
        stack.callback(page.close)
        page.feeds.begin()
        _serve(screen, page, sockets, remote, robots, browser=not no_browser)


@contextmanager
def _bound(host: str, port: int) -> Iterator[socket.socket]:
    """Bind a listening socket, closed at the end.

    Raises:
        CliError: the address is not of this machine, or its port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY, so that small answers leave at once, only on sockets made with IPPROTO_TCP.
    with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((host, port))
        except OSError as exc:
            raise CliError(f"The page cannot be served at {host} port {port}: {exc.strerror}.") from exc
        yield bound


def _serve(
    screen: Screen,
    page: Dashboard,
    sockets: list[socket.socket],
    remote: RemoteAddress | None,
    robots: Any,
    *,
    browser: bool,
) -> None:
    """Serve until Ctrl-C or SIGTERM; the demo's robots start after the page."""
    from strands_robots.dashboard.server import QuietServer, configured  # noqa: PLC0415 - as above
    from strands_robots.threads import StopSignal  # noqa: PLC0415 - as above

    port = int(sockets[0].getsockname()[1])
    app, url = page.app(), f"http://127.0.0.1:{port}/"
    servers = [QuietServer(configured(app, "127.0.0.1", port), page.end_pictures)]
    if remote is not None:
        tls = {"ssl_certfile": str(remote.cert), "ssl_keyfile": str(remote.key), "lifespan": "off"}
        servers.append(QuietServer(configured(app, remote.host, port, **tls), page.end_pictures))

    async def run() -> None:
        await asyncio.gather(*(each.serve([bound]) for each, bound in zip(servers, sockets, strict=True)))

    thread = threading.Thread(target=lambda: asyncio.run(run()), name="dashboard", daemon=True)
    with StopSignal() as signals:
        thread.start()
        try:
            while not all(each.started for each in servers) and thread.is_alive():
                if signals.wait(POLL_S) is not None:
                    return
            _announce(screen, url, remote)
            if browser and screen.live:
                with contextlib.suppress(webbrowser.Error):  # the address is on the screen
                    webbrowser.open(url)
            if robots is not None:
                robots.start()
            while thread.is_alive() and signals.wait(0.2) is None:
                if robots is not None:
                    robots.check()
        finally:
            for each in servers:
                each.should_exit = True
            thread.join(START_S)
    screen.say("The page is off. Robots that were stopped stay locked.")


def _announce(screen: Screen, url: str, remote: RemoteAddress | None) -> None:
    facts: dict[str, Any] = {"event": "serving", "url": url}
    screen.say("The page is at")
    screen.copyable(f"  {url}")
    if remote is not None:
        from strands_robots.dashboard.access import ROLES, qr_code  # noqa: PLC0415 - as above

        facts |= {"remote": {role: remote.url(role) for role in ROLES}, "fingerprint": remote.fingerprint}
        for role in ROLES:
            screen.say(f"For a phone, as {role}:")
            screen.copyable(f"  {remote.url(role)}")
            for line in qr_code(remote.url(role)).splitlines():
                # A terminal with dark letters on white would show its negative, which some phones do not read.
                screen.copyable(line, "bright_white on black")
        screen.say("The browser asks about the certificate once. Its SHA-256 fingerprint:")
        screen.copyable(f"  {remote.fingerprint}")
    screen.data(facts)
    screen.say("Space stops all robots. Ctrl-C here ends the page, not the robots.")
