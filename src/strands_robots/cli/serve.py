"""``serve ROBOT``: put a robot on the network until Ctrl-C, which stops the robot first."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.command import command
from strands_robots.cli.mesh import serve_on_mesh
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import Failure, Screen, label, plain, table
from strands_robots.cli.recorded import recorded
from strands_robots.cli.words import assignments, told_apart
from strands_robots.envelope import text_of
from strands_robots.utils import ValidationError, device_id, number

if TYPE_CHECKING:
    from device_connect_edge.drivers import DeviceDriver

    from strands_robots.device_connect.backends import LinkConfig

_WATCH_S = 0.2


def register(app: typer.Typer) -> None:
    """Add ``serve`` to the application."""
    command(app, "serve", network=True)(serve)


def _allow(flag: str, text: str) -> Any:
    return typer.Option(flag, help=text, rich_help_panel="Authorization", metavar="LIST")


def serve(
    screen: Screen,
    network: Network,
    *,
    robot: Annotated[str, typer.Argument(help="Such as so100, or an MJCF or URDF file.")],
    peer_id: Annotated[str | None, typer.Option("--peer-id", help="Its id on the network, without dots.")] = None,
    mode: Annotated[
        str | None, typer.Option("--mode", help="sim or real; real by itself with a serial port, and for reachy_mini.")
    ] = None,
    port: Annotated[
        list[str] | None,
        typer.Option(
            "--port",
            help="An arm's serial port, such as /dev/ttyACM0; or the number of the loopback port where robots meet.",
            metavar="PORT",
        ),
    ] = None,
    host: Annotated[
        str | None, typer.Option("--host", help="Of a Reachy Mini's daemon; without it one is looked for.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of the robot, such as port=/dev/ttyACM0.", metavar="KEY=VALUE"),
    ] = None,
    rpc_allow: Annotated[str | None, _allow("--rpc-allow", "Callers that may move it: globs, or 'anonymous'.")] = None,
    estop_allow: Annotated[str | None, _allow("--estop-allow", "Sources whose emergency stop counts: globs.")] = None,
    policy_allow: Annotated[str | None, _allow("--policy-allow", "Policy providers callers may ask for.")] = None,
    command_allow: Annotated[
        str | None, _allow("--command-allow", "Verbs approved on real hardware: verb or verb@peer.")
    ] = None,
    state_hz: Annotated[float | None, typer.Option("--state-hz", help="stateUpdate events a second, idle.")] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Also record joints, pictures and events: a new .mcap file.")
    ] = None,
    record_cameras: Annotated[
        str | None, typer.Option("--record-cameras", help="Which cameras: names with commas, or none.", metavar="LIST")
    ] = None,
    on_mesh: Annotated[bool, typer.Option("--mesh", help="On the native mesh instead of Device Connect.")] = False,
    until_stdin_closes: Annotated[bool, typer.Option("--until-stdin-closes", hidden=True)] = False,
) -> None:
    """Put a robot on the network. Ctrl-C or SIGTERM stops the robot first, then departs."""
    flags = {
        "DEVICE_CONNECT_RPC_ALLOW": rpc_allow,
        "DEVICE_CONNECT_ESTOP_ALLOW": estop_allow,
        "STRANDS_MESH_POLICY_TYPE_ALLOW": policy_allow,
        "STRANDS_ROBOT_COMMAND_ALLOW": command_allow,
        "STRANDS_DC_STATE_HZ": None if state_hz is None else str(number("--state-hz", state_hz, low=0.01, high=100)),
    }
    for name, value in flags.items():
        if value is not None:
            settings.put(name, value)
    wanted = None if peer_id is None else device_id("--peer-id", peer_id)
    meeting, serial = told_apart(port or [])
    network = replace(network, port=meeting)
    if on_mesh:
        network.on_mesh()
    link = None if on_mesh else network.link()
    from strands_robots.robot import Robot  # noqa: PLC0415 - heavy, and needed by this command alone

    chosen = assignments(options or []) | ({} if host is None else {"host": host})
    if serial is not None:
        chosen["port"] = serial
    kind = mode or ("real" if serial is not None or robot == "reachy_mini" else "sim")
    if serial is not None and kind == "sim":
        raise ValidationError(f"--mode must be real with the serial port {serial}, not sim.")
    body = Robot(robot, mode="real" if robot == "reachy_mini" else kind, **chosen)
    try:
        with recorded(screen, body, wanted or str(body.tool_name_str), record, record_cameras):
            if link is None:
                serve_on_mesh(screen, body, wanted, kind)
            else:
                _serve(screen, network, link, body, wanted=wanted, piped=until_stdin_closes)
    finally:
        cleanup = getattr(body, "cleanup", None)
        if callable(cleanup):
            cleanup()


def _serve(screen: Screen, network: Network, link: LinkConfig, body: Any, *, wanted: str | None, piped: bool) -> None:
    from strands_robots import device_connect  # noqa: PLC0415 - as above
    from strands_robots.device_connect.bringup import default_id, driver_for  # noqa: PLC0415

    driver = driver_for(body, "robot")
    with device_connect.StopSignal() as asked:
        try:
            runtime = device_connect.init_device_connect_sync(
                driver, peer_id=wanted or default_id(body), link=link, allow_insecure=True if network.opted_in else None
            )
        except (device_connect.DuplicateDeviceError, TimeoutError, OSError) as exc:
            raise Failure(f"The robot is not on the network: {exc}") from exc
        try:
            _announce(screen, str(runtime.device_id), link, driver, network)
            # What importing left behind stays: looking through it again would hold a control loop up for 10 ms or more.
            gc.collect()
            gc.freeze()
            heard = _wait(asked, piped)
        finally:
            still = _halt(screen, body)
            device_connect.stop_device_connect(runtime)
    screen.say("Off the network.")
    screen.data({"event": "departed", "peer_id": str(runtime.device_id), "signal": heard})
    if not still:
        raise Failure("The robot was left moving: it did not confirm its stop.")
    if heard == signal.SIGINT:
        raise KeyboardInterrupt


def _announce(screen: Screen, peer_id: str, link: LinkConfig, driver: DeviceDriver, network: Network) -> None:
    functions = {each.name: str(each.description).strip() for each in driver.capabilities.functions}
    screen.data(
        {
            "event": "serving",
            "peer_id": peer_id,
            "tenant": link.tenant,
            "network": describe(link),
            "pid": os.getpid(),
            "functions": functions,
        }
    )
    if screen.machine:
        return
    from rich.console import Group  # noqa: PLC0415 - Rich is loaded when something is shown
    from rich.panel import Panel  # noqa: PLC0415

    where = _where(link, network)
    lines: list[Any] = [
        label(describe(link)),
        *([label(f"Tenant {link.tenant}.")] if link.tenant != "default" else []),
        table("", ("function", "what it does"), ((name, _first(text)) for name, text in functions.items())),
        label("From another terminal:", "bold"),
        label(f"  strands-robots peers{where}"),
        label(f"  strands-robots call {peer_id} {_example(functions)}{where}"),
        label(f"  strands-robots stop {peer_id}{where}"),
        label(f"  strands-robots estop{where}"),
        label(""),
        label("Ctrl-C stops the robot, then takes it off the network."),
    ]
    screen.show(Panel(Group(*lines), title=label(peer_id, "bold"), title_align="left", border_style="green"))


def _where(link: LinkConfig, network: Network) -> str:
    """The flags with which another terminal reaches the same network; secrets are files and stay on this side."""
    words = []
    if network.nats:
        words += ["--nats", network.nats]
    for endpoint in network.connect or network.listen or []:
        words += ["--connect", endpoint.replace("0.0.0.0", "HOST").replace("[::]", "HOST")]
    words += ["--multicast"] if network.multicast else []
    words += ["--port", str(link.meet_port)] if network.port else []
    words += ["--tenant", link.tenant] if network.tenant else []
    words += ["--insecure"] if network.insecure else []
    return "".join(f" {plain(word)}" for word in words)


def _example(functions: Mapping[str, str]) -> str:
    return "execute instruction='wave' duration=5" if "execute" in functions else next(iter(functions), "FUNCTION")


def _first(description: str) -> str:
    return description.partition("\n")[0]


def _halt(screen: Screen, body: Any) -> bool:
    """Stop the robot and say so; True when it is known to stand still."""
    from strands_robots.contract import adapt, put_away  # noqa: PLC0415 - loaded when it is used

    screen.say("Stopping the robot...")
    # The device is still on the network: what is asked for after this halt would outlive the process.
    put_away(getattr(body, "robot", body))
    halt = getattr(body, "halt", None)
    if not callable(halt):
        halt = adapt(body).halt
    told = halt("the operator ended serve").envelope()
    screen.data({"event": "stopped", **{key: told[key] for key in ("status", "stopped", "halted") if key in told}})
    screen.say(text_of(told), "green" if told["status"] == "success" else "bold red")
    return told.get("stopped") is True


def _wait(asked: Any, piped: bool) -> int | None:
    """Until a signal comes, or standard input closes where ``piped``."""
    closed = threading.Event()

    def read() -> None:
        while sys.stdin.read(1):
            continue
        closed.set()

    if piped:
        threading.Thread(target=read, name="stdin", daemon=True).start()
    while not closed.is_set():
        heard: int | None = asked.wait(_WATCH_S)
        if heard is not None:
            return heard
    return None
