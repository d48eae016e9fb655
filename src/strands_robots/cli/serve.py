"""``serve ROBOT``: put a robot on the network until Ctrl-C."""

from __future__ import annotations

import gc
import json
import math
import os
import shlex
import signal
import sys
import threading
import tomllib
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.adapted import adapt
from strands_robots.cli.app import assignments, parse_ports
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.own_robot import device_of, peer_of
from strands_robots.cli.readiness import mesh_problems, shortcomings
from strands_robots.cli.record import record_robot
from strands_robots.contract import put_away
from strands_robots.envelope import text_of
from strands_robots.fleet.adapter import SOURCE
from strands_robots.fleet.device_connect.config import described
from strands_robots.policies import warm_profiles
from strands_robots.policies.base import SPEED_MAX
from strands_robots.policies.profiles import load_profiles
from strands_robots.safety.authorization import listed, motion_refusal
from strands_robots.tags import own_tags
from strands_robots.utils import (
    ValidationError,
    identifier,
    number,
    optional_module,
    own_device_id,
    redacted,
    shown,
    text,
)

if TYPE_CHECKING:
    from device_connect_edge.drivers import DeviceDriver

    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.threads import StopSignal

EVERY_PROGRAM_HERE = "Every program of this machine can drive and read it, no other machine can."
READ_BY_EVERY_PROGRAM = "Every program of this machine can read it and stop it, no other machine can."

NO_CALLER = f"No command here may move it. With --rpc-allow {SOURCE} this command line may, after a grant."

_MOTIONS = {"execute": " instruction=wave duration=5", "setGripper": " opening=0.5", "wakeUp": ""}
"""Motions for a first try, the best first, with their arguments."""

_ANYWHERE = ("0.0.0.0", "[::]")
"""Hosts of a listener on every address of this machine."""


@dataclass(frozen=True, slots=True)
class ServedRobot:
    """A robot that is on the network: what its banner needs to know."""

    peer_id: str
    link: LinkConfig
    functions: Collection[str]
    hardware: bool
    key: str = ""


def show_banner(screen: Screen, served: ServedRobot, lacking: Sequence[str]) -> None:
    """Print ten lines: the network, commands to paste, the robot's key.

    Args:
        screen: where it is printed.
        served: the robot.
        lacking: reasons why it is not ready.
    """
    link = served.link
    for each in lacking:
        screen.say(f"NOT READY. {each}", "bold red")
    screen.say(f"{served.peer_id}. {described(link)}", "bold red" if lacking else "bold green")
    if link.loopback_only and not link.authenticated:
        screen.say(READ_BY_EVERY_PROGRAM if _caller_refusal(served) else EVERY_PROGRAM_HERE)
    named = {"Tenant": "" if link.tenant == "default" else link.tenant, "Cell": settings.raw("STRANDS_CELL")}
    if any(named.values()):
        screen.say(" ".join(f"{what} {name}." for what, name in named.items() if name))
    screen.say("From another terminal:", "bold")
    for each in commands(served):
        screen.copyable(f"  {each}")
    if _caller_refusal(served):
        screen.say(NO_CALLER)
    if served.key:
        screen.say(f"Its key, to compare when it is enrolled: {served.key}")
    screen.say("Ctrl-C stops the robot, then takes it off the network.")


def commands(served: ServedRobot) -> Iterator[str]:
    """Yield command lines for another terminal: look, approve, move, stop."""
    name, flags = served.peer_id, flags_elsewhere(served.link)
    yield f"strands-robots peers {name}{flags}"
    motion = next((each for each in _MOTIONS if each in served.functions and _may_try(served, each)), "")
    if motion and served.hardware and not listed(motion, name, settings.items("STRANDS_ROBOT_COMMAND_ALLOW")):
        yield f"{_state()}strands-robots grant {motion}@{name}"
    if motion or "getStatus" in served.functions:
        yield f"strands-robots call {name} {motion or 'getStatus'}{_MOTIONS.get(motion, '')}{flags}"
    yield f"strands-robots stop {name}{flags}"
    yield f"strands-robots estop{flags}"


def flags_elsewhere(link: LinkConfig) -> str:
    """Return the flags that reach the link from another terminal.

    It may lack our environment and folder; passwords are left out.
    """
    words: list[str] = []
    if link.transport == "nats":
        words += [word for url in link.connect for word in ("--nats", redacted(url))]
    else:
        endpoints = link.connect or tuple(_reachable(link, each) for each in link.listen)
        words += [word for each in endpoints for word in ("--connect", each)]
        words += ["--multicast"] if link.uses_multicast and not words else []
    if link.meet_port is not None and str(link.meet_port) != settings.default("STRANDS_DC_PORT"):
        words += ["--port", str(link.meet_port)]
    words += [] if link.tenant == "default" else ["--tenant", link.tenant]
    for flag, pem in (("--tls-ca", link.ca), ("--tls-cert", link.cert), ("--tls-key", link.key)):
        words += [flag, str(Path(pem).absolute())] if pem else []
    if link.jwt:
        named = settings.raw("MESSAGING_CREDENTIALS_FILE") or settings.raw("NATS_CREDENTIALS_FILE")
        words += ["--credentials", str(Path(named).absolute())]
    words += [] if link.authenticated or link.loopback_only else ["--insecure"]
    return "".join(f" {shlex.quote(word)}" for word in words)


def _caller_refusal(served: ServedRobot) -> str | None:
    """Return why the command line may not move the robot at all, or None."""
    return motion_refusal(SOURCE, settings.items("DEVICE_CONNECT_RPC_ALLOW"), hardware=served.hardware)


def _may_try(served: ServedRobot, motion: str) -> bool:
    """Return True for a motion that the command line can have, once it is granted."""
    if _caller_refusal(served):
        return False
    return not served.hardware or motion != "execute" or settings.boolean("STRANDS_ALLOW_MOCK")


def _state() -> str:
    """Return the assignment that names the directory of grants, or empty."""
    stated = settings.verbatim("STRANDS_STATE_DIR")
    return f"STRANDS_STATE_DIR={shlex.quote(str(Path(stated).expanduser().absolute()))} " if stated else ""


def _reachable(link: LinkConfig, endpoint: str) -> str:
    """Return the endpoint of a listener as this machine reaches it."""
    if not any(f"/{host}:" in endpoint for host in _ANYWHERE):
        return endpoint
    here = "127.0.0.1"
    if endpoint.startswith("tls/") and link.verify_hostname:
        from strands_robots.cli.readiness import own_host  # noqa: PLC0415 - its package is loaded when it is used

        here = own_host(link) or here
    for host in _ANYWHERE:
        endpoint = endpoint.replace(f"/{host}:", f"/{here}:")
    return endpoint


PAGE_CALLER = "dashboard"
PAGE_VERBS = ("acquireControl", "moveJoints", "moveBy", "setGripper", "lead")
"""Verbs with which the operator's page drives a robot by hand."""

EMULATED = ("so100", "so101")
"""Arms whose servos can be emulated."""

_POLL_S = 0.2


def _allow(flag: str, text: str) -> Any:
    return typer.Option(flag, help=text, rich_help_panel="Authorization", metavar="LIST")


def serve(
    screen: Screen,
    network: Network,
    *,
    robot: Annotated[
        str, typer.Argument(help="Such as so100, an MJCF or URDF file, lerobot:TYPE, or a robot of another package.")
    ],
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
        str | None, typer.Option("--host", help="Of a Reachy Mini's daemon; REACHY_HOST or searched for by default.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of the robot, such as port=/dev/ttyACM0.", metavar="KEY=VALUE"),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="File of the robot's options: .json, .toml or LeRobot's .yaml.")
    ] = None,
    rpc_allow: Annotated[str | None, _allow("--rpc-allow", "Callers that may move it: globs, or 'anonymous'.")] = None,
    estop_allow: Annotated[str | None, _allow("--estop-allow", "Sources whose emergency stop counts: globs.")] = None,
    policy_allow: Annotated[str | None, _allow("--policy-allow", "Policy providers callers may ask for.")] = None,
    command_allow: Annotated[
        str | None, _allow("--command-allow", "Verbs approved on real hardware: verb, verb@peer or verb@peer:caller.")
    ] = None,
    drive_by_page: Annotated[
        bool,
        typer.Option(
            "--drive-by-page",
            help=f"Let the page drive it: adds {PAGE_CALLER} to --rpc-allow and {','.join(PAGE_VERBS)} to the verbs.",
            rich_help_panel="Authorization",
        ),
    ] = False,
    emulated: Annotated[
        bool, typer.Option("--emulated", help="A real arm's driver on emulated servos, in the place of --port.")
    ] = False,
    policies: Annotated[
        Path | None, typer.Option("--policies", help="File of policy profiles, which callers choose by name.")
    ] = None,
    allow_mock: Annotated[
        bool, typer.Option("--allow-mock", help="Let the policy mock, which follows no instruction, move hardware.")
    ] = False,
    speed_limit: Annotated[
        float | None,
        typer.Option(
            "--speed-limit",
            help="Greatest speed of each position, in its unit a second; by default 2 rad/s on a real arm.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", help="MJCF of a real arm, for motions to a point; its joints must fit the arm."),
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option("--detector", help="What sees objects for a real arm: a callable that makes it, module:name."),
    ] = None,
    state_hz: Annotated[float | None, typer.Option("--state-hz", help="stateUpdate events a second, idle.")] = None,
    cell: Annotated[
        str | None, typer.Option("--cell", help="The cell that it is in, for stops of one cell; none by default.")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", help="A word by which callers choose it (repeat).")] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Also record joints, pictures and events: a new .mcap file.")
    ] = None,
    record_cameras: Annotated[
        str | None, typer.Option("--record-cameras", help="Which cameras: names with commas, or none.", metavar="LIST")
    ] = None,
    until_stdin_closes: Annotated[bool, typer.Option("--until-stdin-closes", hidden=True)] = False,
) -> None:
    """Put a robot on the network. Ctrl-C or SIGTERM stops the robot first, then departs."""
    if drive_by_page:
        rpc_allow = added(rpc_allow, "DEVICE_CONNECT_RPC_ALLOW", (PAGE_CALLER,))
        command_allow = added(command_allow, "STRANDS_ROBOT_COMMAND_ALLOW", PAGE_VERBS)
        screen.say(f"The page may drive it: --rpc-allow {rpc_allow} --command-allow {command_allow}.")
    flags = {
        "DEVICE_CONNECT_RPC_ALLOW": rpc_allow,
        "DEVICE_CONNECT_ESTOP_ALLOW": estop_allow,
        "STRANDS_MESH_POLICY_TYPE_ALLOW": policy_allow,
        "STRANDS_ROBOT_COMMAND_ALLOW": command_allow,
        "STRANDS_ALLOW_MOCK": "true" if allow_mock else None,
        "STRANDS_DC_STATE_HZ": None if state_hz is None else str(number("--state-hz", state_hz, low=0.01, high=100)),
        "STRANDS_CELL": None if cell is None else identifier("--cell", cell),
        "STRANDS_TAGS": ",".join(own_tags(tag)) if tag else None,
    }
    for name, value in flags.items():
        if value is not None:
            settings.put(name, value)
    if policies is not None:
        load_profiles(policies.expanduser())
        settings.put("STRANDS_POLICIES", str(policies))
    peer_id = None if peer_id is None else own_device_id("--peer-id", peer_id)
    tcp_port, serial_port = parse_ports(port or [])
    network = replace(network, port=tcp_port)
    if network.mesh:
        network.use_mesh()
    link = None if network.mesh else network.link()
    from strands_robots.robot import LEROBOT, Robot, counts_as_hardware  # noqa: PLC0415 - heavy, and needed by this command alone

    limit = None if speed_limit is None else number("--speed-limit", speed_limit, above=0, high=SPEED_MAX)
    given = {"host": host, "port": serial_port, "speed_limit": limit}
    stated = {} if config is None else options_of_file(config, robot)
    chosen = stated | assignments(options or []) | {name: value for name, value in given.items() if value is not None}
    if emulated and (robot not in EMULATED or serial_port is not None or mode == "sim"):
        raise ValidationError(f"--emulated is for a real {' or '.join(EMULATED)} without a serial port.")
    always_real = robot == "reachy_mini" or robot.startswith(LEROBOT)
    mode = mode or ("real" if emulated or serial_port is not None or always_real else "sim")
    if serial_port is not None and mode == "sim":
        raise ValidationError(f"--mode must be real with the serial port {serial_port}, not sim.")
    peer_type = "real" if counts_as_hardware(robot) else mode
    chosen |= _arm_options(peer_type, model, detector)
    loading = [] if policies is None else warm_profiles()
    if loading:
        screen.say(f"Loading the policies {', '.join(loading)}.")
    with ExitStack() as stack:
        if emulated:
            from strands_robots.hardware.emulated import emulated_arm  # noqa: PLC0415 - as above

            chosen = stack.enter_context(emulated_arm()) | chosen
        body = Robot(robot, mode="real" if always_real else mode, **chosen)
        cleanup = getattr(body, "cleanup", None)
        if callable(cleanup):
            stack.callback(cleanup)
        stack.enter_context(record_robot(screen, body, peer_id or str(body.tool_name_str), record, record_cameras))
        if link is None:
            served = _on_mesh(screen, network, body, peer_id, peer_type)
        else:
            served = _on_device_connect(screen, network, link, body, peer_id)
        _serve(screen, body, served, piped=until_stdin_closes)


def added(given: str | None, setting: str, entries: Sequence[str]) -> str:
    """Return the allowed entries of a flag, or else of the environment, and more."""
    before = settings.raw(setting) if given is None else given
    named = [each.strip() for each in (before or "").split(",")]
    return ",".join(dict.fromkeys([*filter(None, named), *entries]))


def options_of_file(path: Path, robot: str) -> dict[str, Any]:
    """Read the options of ``robot`` from a .json, .toml or .yaml file.

    It holds a mapping, or one under ``robot``. LeRobot's own configuration of a robot is such a file; its ``type`` must
    be the robot that is served.

    Raises:
        ValidationError: the file cannot be read, is no mapping, or is of another type.
    """
    try:
        source = path.expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise ValidationError(f"--config {shown(str(path))} cannot be read: {exc}.") from exc
    try:
        content = _parsed(path, source)
    except ValueError as exc:
        raise ValidationError(f"--config {shown(str(path))} cannot be read: {' '.join(str(exc).split())}.") from exc
    options = content.get("robot", content) if isinstance(content, dict) else None
    if not isinstance(options, dict):
        raise ValidationError(f"--config {shown(str(path))} must have a robot's options by name.")
    kind = options.pop("type", None)
    if kind not in (None, robot, robot.partition(":")[2]):
        raise ValidationError(f"--config {shown(str(path))} is for the type {shown(kind)}, not for {robot}.")
    _check_names_and_numbers(path, options)
    return options


def _check_names_and_numbers(path: Path, value: object) -> None:
    """Refuse keys that are no text, NaN and infinities, at any depth."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValidationError(f"--config {shown(str(path))} must have finite numbers, not {value}.")
    for key in value if isinstance(value, dict) else ():
        if not isinstance(key, str):
            raise ValidationError(f"--config {shown(str(path))} must have names as keys, not {shown(key)}.")
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_names_and_numbers(path, each)


def _parsed(path: Path, source: str) -> object:
    """Parse by the ending of the name; raise :class:`ValueError` where it cannot."""
    if path.suffix == ".toml":
        return tomllib.loads(source)
    if path.suffix not in (".yaml", ".yml"):
        return json.loads(source)
    yaml = optional_module("yaml", what="A .yaml file", extra="lerobot")
    try:
        return yaml.safe_load(source)
    except yaml.YAMLError as exc:
        raise ValueError(str(exc)) from exc


def _arm_options(mode: str, model: Path | None, detector: str | None) -> dict[str, Any]:
    """Return the options of a real arm's motions, with the detector made."""
    if mode == "sim" and (model is not None or detector is not None):
        raise ValidationError(
            "--model and --detector are a real arm's; a simulated robot brings its model and objects."
        )
    chosen: dict[str, Any] = {} if model is None else {"model": str(model.expanduser())}
    if detector is None:
        return chosen
    module, _, attribute = text("--detector", detector).partition(":")
    try:
        return {**chosen, "detector": getattr(import_module(module), attribute)()}
    except Exception as exc:
        raise ValidationError(f"--detector {shown(detector)} cannot be made: {type(exc).__name__}: {exc}") from exc


def _serve(screen: Screen, body: Any, served: AbstractContextManager[str], *, piped: bool) -> None:
    """Serve until a signal comes, stop the robot, and leave the network."""
    from strands_robots.threads import StopSignal  # noqa: PLC0415 - loads nothing of the framework

    with StopSignal() as signals:
        with served as peer_id:
            try:
                # Objects left by the imports are exempt from collection: scanning them would stall a control loop
                # for 10 ms or more.
                gc.collect()
                gc.freeze()
                received = _wait(signals, piped)
            finally:
                stopped = _halt(screen, body)
        screen.say("Off the network.")
        screen.data({"event": "departed", "peer_id": peer_id, "signal": received})
    if not stopped:
        raise CliError("The robot was left moving: it did not confirm its stop.")
    if received == signal.SIGINT:
        raise KeyboardInterrupt


@contextmanager
def _on_mesh(screen: Screen, network: Network, body: Any, peer_id: str | None, peer_type: str) -> Iterator[str]:
    with peer_of(body, peer_id, peer_type) as mesh:
        lacking = mesh_problems()
        facts = {"peer_id": mesh.peer_id, "network": "mesh", "pid": os.getpid(), "not_ready": lacking}
        screen.data({"event": "serving", **facts})
        for each in lacking:
            screen.say(f"NOT READY. {each}", "bold red")
        others = f"strands-robots peers{network.flags}"
        screen.say(f"{mesh.peer_id} is on the mesh. From another terminal: {others}", "green")
        screen.say("Ctrl-C stops the robot, then takes it off the mesh.")
        yield mesh.peer_id


@contextmanager
def _on_device_connect(
    screen: Screen, network: Network, link: LinkConfig, body: Any, peer_id: str | None
) -> Iterator[str]:
    with device_of(network, link, body, peer_id) as (own_id, driver):
        _announce(screen, own_id, link, driver)
        yield own_id


def _announce(screen: Screen, peer_id: str, link: LinkConfig, driver: DeviceDriver) -> None:
    functions = {each.name: str(each.description).strip() for each in driver.capabilities.functions}
    identity = getattr(getattr(driver, "registration", None), "identity", None)
    key = identity.fingerprint if identity is not None else ""
    lacking = shortcomings(driver, link)
    screen.data(
        {
            "event": "serving",
            "peer_id": peer_id,
            "tenant": link.tenant,
            "network": described(link),
            "pid": os.getpid(),
            "functions": functions,
            "fingerprint": key,
            "not_ready": lacking,
        }
    )
    if not screen.machine:
        hardware = bool(getattr(driver, "hardware", True))
        show_banner(screen, ServedRobot(peer_id, link, functions, hardware, key), lacking)


def _halt(screen: Screen, body: Any) -> bool:
    """Stop the robot and report it; True when it is known to stand still."""
    # The robot is still on the network: a motion that started after this halt would outlive the process.
    put_away(getattr(body, "robot", body))
    halt = getattr(body, "halt", None)
    if not callable(halt):
        halt = adapt(body).halt
    verdict = halt("the operator ended serve")
    # A terminal that takes no more output must not delay it.
    screen.say("Stopping the robot...")
    answer = verdict.envelope()
    screen.data({"event": "stopped", **{key: answer[key] for key in ("status", "stopped", "halted") if key in answer}})
    screen.say(text_of(answer), "green" if answer["status"] == "success" else "bold red")
    if verdict.settling:
        screen.say(body.wait_settled())
    return answer.get("stopped") is True


def _wait(signals: StopSignal, piped: bool) -> int | None:
    """Wait for a signal, or for the end of a piped input; return its number."""
    closed = threading.Event()

    def read() -> None:
        while sys.stdin.read(1):
            continue
        closed.set()

    if piped:
        threading.Thread(target=read, name="stdin", daemon=True).start()
    while not closed.is_set():
        received = signals.wait(_POLL_S)
        if received is not None:
            return received
    return None
