"""``doctor``: check the installation, and name remedies."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from strands_robots import __version__, settings
from strands_robots.cli.app import IMPORT_PACKAGE, other_owners, owner_remedy
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Screen, label, table
from strands_robots.cli.readiness import LOOPBACK, dial_problem, listen_problem, port_holder, unwritable
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import MESH
from strands_robots.fleet.device_connect.config import described
from strands_robots.safety.identity import robots_here
from strands_robots.safety.orders import ALLOW, REQUIRE_SIGNED, StopRules
from strands_robots.state_files import state_dir
from strands_robots.utils import DISTRIBUTION, MissingExtraError, ValidationError, install_line, redacted

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

FRAMEWORK = "0.2.5"
"""Release of device-connect-edge that the backends are written for."""

_GROUP = "224.0.0.224"
"""Zenoh's scouting group; any multicast address shows whether the network carries multicast."""

_EXTRAS: dict[str, tuple[str, ...]] = {
    "device-connect": ("device-connect-edge", "device-connect-agent-tools", "eclipse-zenoh", "nats-py"),
    "sim": ("mujoco", "numpy", "pillow"),
    "remote": ("websockets", "msgpack"),
    "agent": ("strands-agents",),
    "mcp": ("mcp", "starlette", "uvicorn"),
    "bridge": ("fastmcp",),
    "dashboard": ("starlette", "uvicorn", "websockets", "segno"),
    "groot": ("msgpack",),
    "lerobot-async": ("grpcio",),
    "record": ("mcap", "pillow"),
    "dataset": ("av", "mcap", "numpy", "pillow", "pyarrow"),
    "lerobot": ("lerobot",),
    "rosbridge": ("websockets",),
    "ros2": ("cyclonedds",),
    "reachy": ("httpx", "websockets", "zeroconf"),
    "mesh": ("eclipse-zenoh", "cryptography"),
    "iot": ("awsiotsdk",),
}
_REQUIRED = ("device-connect",)
_RENDER_S = 20.0

# Runs in its own process: MuJoCo chooses its OpenGL at import, and a broken driver may end the process.
_RENDER = """
from strands_robots.simulation.engine import BACKEND, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_step(model, data)
renderer = mujoco.Renderer(model, 32, 32)
renderer.update_scene(data)
assert renderer.render().any(), "an empty picture"
renderer.close()
print("rendered with", BACKEND or "the default OpenGL")
"""


# Foreign code, which may hang or end its process.
_LOAD = """
import sys
from importlib.metadata import entry_points
[entry.load() for entry in entry_points(group=sys.argv[1]) if entry.name == sys.argv[2]]
"""
_LOAD_S = 30.0


class Mark(StrEnum):
    """Severity of a finding; only ``broken`` is required and does not work."""

    OK = "ok"
    NOTE = "note"
    WARN = "warn"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check; ``remedy`` is empty where nothing needs to be done."""

    name: str
    mark: Mark
    said: str
    remedy: str = ""


_STYLE = {Mark.OK: "green", Mark.NOTE: "cyan", Mark.WARN: "yellow", Mark.BROKEN: "bold red"}


def doctor(screen: Screen, network: Network) -> None:
    """Check what is installed and what works here; exit 1 when something required is broken."""
    findings = examine(network)
    broken = [finding.name for finding in findings if finding.mark is Mark.BROKEN]
    rows = ((label(found.mark, _STYLE[found.mark]), found.name, found.said) for found in findings)
    screen.show(table("", ("", "check", "found"), rows))
    remedies = [finding for finding in findings if finding.remedy]
    if remedies:
        screen.say("Remedies", "bold")
    for finding in remedies:
        screen.say(f"  {finding.name}: {finding.remedy}")
    checks = [asdict(finding) for finding in findings]
    if broken:
        raise CliError(f"Required and broken: {', '.join(broken)}.", checks=checks)
    screen.data({"status": "success", "checks": checks})
    screen.say("Everything that is required works.", "green")


def examine(network: Network) -> list[Finding]:
    """Run every check, in the order of the report."""
    link, found = _link_of(network)
    of_link = (_meeting_port, _listened, _dialled, _certificates)
    before: tuple[Callable[[], Iterator[Finding]], ...] = (_installation, _packages)
    after = (_multicast, _credentials, _stop_senders, _rendering, _state, _robot_keys, _plug_ins)
    return [
        *(finding for check in before for finding in check()),
        *found,
        *(finding for check in of_link if link is not None for finding in check(link)),
        *_mesh(network),
        *(finding for check in after for finding in check()),
    ]


def _installation() -> Iterator[Finding]:
    yield Finding("python", Mark.OK, sys.version.split()[0])
    others = other_owners()
    if others:
        said = f"{', '.join(others)} also installs the import package {IMPORT_PACKAGE}"
        yield Finding("distribution", Mark.WARN, said, owner_remedy(others))
        return
    installed = _version(DISTRIBUTION)
    said = f"{DISTRIBUTION} {__version__}"
    yield Finding("distribution", Mark.OK, said if installed else f"{said}, run from its source tree")


def _packages() -> Iterator[Finding]:
    for extra, names in _EXTRAS.items():
        have = {name: _version(name) for name in names}
        missing = [name for name, version in have.items() if version is None]
        if missing:
            absent = Mark.BROKEN if extra in _REQUIRED else Mark.NOTE
            said = "not installed" if len(missing) == len(names) else f"without {', '.join(missing)}"
            yield Finding(f"extra {extra}", absent, said, install_line(extra))
            continue
        versions = ", ".join(f"{name} {version}" for name, version in have.items())
        if extra == "device-connect" and have["device-connect-edge"] != FRAMEWORK:
            remedy = f"pip install device-connect-edge=={FRAMEWORK}; the backends are written for that release"
            yield Finding(f"extra {extra}", Mark.BROKEN, versions, remedy)
        else:
            yield Finding(f"extra {extra}", Mark.OK, versions)


def _link_of(network: Network) -> tuple[LinkConfig | None, list[Finding]]:
    """Return the link that every command would use, and what is found of it."""
    try:
        if network.on_mesh_alone:
            return None, [Finding("network", Mark.OK, "the connection profile has a mesh and no Device Connect")]
        link = network.link()
    except (CliError, ValidationError, MissingExtraError) as exc:
        said = "no usable network in the flags and the environment"
        return None, [Finding("network", Mark.BROKEN, said, str(exc))]
    proven = link.authenticated or link.loopback_only
    remedy = "" if proven else "give certificates or credentials; without them everybody there can drive the robots"
    return link, [Finding("network", Mark.OK if proven else Mark.WARN, described(link), remedy)]


def _dialled(link: LinkConfig) -> Iterator[Finding]:
    """Connect to each endpoint of the link, as a robot or a client of it does."""
    for endpoint in link.connect:
        problem = dial_problem(link, endpoint)
        where, remedy = redacted(endpoint), "start what should answer there, or name what does with --connect or --nats"
        if problem:
            yield Finding("dial", Mark.BROKEN, f"{where}: {problem}", remedy)
        else:
            yield Finding("dial", Mark.OK, f"{where} answers")


def _listened(link: LinkConfig) -> Iterator[Finding]:
    """Try the ports on which a robot would listen."""
    for endpoint in link.listen:
        if not (problem := listen_problem(endpoint)):
            yield Finding("listen", Mark.OK, f"{endpoint} is free")
        elif dial_problem(link, endpoint.replace("0.0.0.0", LOOPBACK).replace("[::]", "[::1]")):
            remedy = "end that program, or choose another port with --listen"
            yield Finding("listen", Mark.BROKEN, f"{endpoint}: {problem}{_holder(endpoint)}", remedy)
        else:
            remedy = "nothing, if you serve a robot there; a second one needs another port"
            yield Finding("listen", Mark.NOTE, f"{endpoint}: a robot process answers there{_holder(endpoint)}", remedy)


def _holder(endpoint: str) -> str:
    number = endpoint.rpartition(":")[2]
    uid, who = port_holder(int(number)) if number.isdecimal() else (None, "")
    return "" if uid is None else f", {who}"


def _meeting_port(link: LinkConfig) -> Iterator[Finding]:
    if link.meet_port is None or link.meeting_point is None:
        return
    where = f"{LOOPBACK}:{link.meet_port}"
    if not (problem := listen_problem(link.meeting_point)):
        yield Finding("port", Mark.OK, f"{where} is free")
        return
    uid, who = port_holder(link.meet_port)
    holder = "" if uid is None else f" ({who})"
    if dial_problem(link, link.meeting_point):
        remedy = "end that program, or choose another port with --port or STRANDS_DC_PORT"
        said = f"{where}: {problem}{holder}, and it is no robot process: robots are not found"
        yield Finding("port", Mark.BROKEN, said, remedy)
    else:
        remedy = "" if uid in (None, os.getuid()) else "choose another port with --port or STRANDS_DC_PORT"
        yield Finding("port", Mark.NOTE if remedy else Mark.OK, f"{where}: robots are served there{holder}", remedy)


def _mesh(network: Network) -> Iterator[Finding]:
    """Join the mesh that commands reach besides, where there is one."""
    try:
        networks = network.networks()
    except (CliError, ValidationError, MissingExtraError):
        return  # the check of the network has said so
    with closing(networks), suppress(UnreachableError):
        networks.open()
        networks.settled()
    if why := networks.missing.get(MESH):
        yield Finding("mesh", Mark.WARN, why, "start a robot there with serve --mesh, or correct STRANDS_MESH_CONNECT")
    else:
        yield Finding("mesh", Mark.OK, networks.absent.get(MESH, "its peers are reached by every command"))


def _multicast() -> Iterator[Finding]:
    failed = multicast_error()
    if failed is None:
        yield Finding("multicast", Mark.OK, "a datagram to this machine's own group came back")
    else:
        remedy = "only --multicast needs it; where it is missing use the loopback default or --connect and --listen"
        yield Finding("multicast", Mark.NOTE, f"does not work here: {failed}", remedy)


def multicast_error(within: float = 0.5) -> str | None:
    """Return the reason why no multicast datagram comes back in time, or None."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        try:
            listener.bind(("", 0))
            listener.settimeout(within)
            member = socket.inet_aton(_GROUP) + socket.inet_aton("0.0.0.0")
            listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            sender.sendto(b"strands-robots doctor", (_GROUP, listener.getsockname()[1]))
            listener.recv(64)
        except TimeoutError:
            return "the datagram did not come back"
        except OSError as exc:
            return exc.strerror or str(exc)
    return None


def _certificates(link: LinkConfig) -> Iterator[Finding]:
    """Check the certificates of the flags, else those of the environment."""
    ca, cert, key = (settings.raw(f"MESSAGING_TLS_{part}_FILE") for part in ("CA", "CERT", "KEY"))
    used = link if link.ca else replace(link, ca=ca, cert=cert, key=key)
    if not used.ca:
        yield Finding("certificates", Mark.OK, "none configured; a network inside this machine needs none")
        return
    from strands_robots.cli.readiness import (  # noqa: PLC0415 - needs the [device-connect] extra
        certificate_problem,
        valid_until,
    )

    if problem := certificate_problem(used):
        remedy = "give matching PEM files by --tls-ca, --tls-cert and --tls-key, or by MESSAGING_TLS_CA_FILE and so on"
        yield Finding("certificates", Mark.BROKEN, problem, remedy)
    else:
        said = "the certificate fits its key and authority" if used.cert else "the authority can be used"
        yield Finding("certificates", Mark.OK, f"{said}, until {valid_until(used)}")


def _credentials() -> Iterator[Finding]:
    name = settings.raw("MESSAGING_CREDENTIALS_FILE") or settings.raw("NATS_CREDENTIALS_FILE")
    if not name:
        yield Finding("credentials", Mark.OK, "none configured; a network inside this machine needs none")
        return
    path = Path(name)
    try:
        path.read_bytes()
    except OSError as exc:
        yield Finding("credentials", Mark.BROKEN, f"{name} cannot be read: {exc.strerror}", "name a readable file")
        return
    if path.stat().st_mode & 0o077:
        yield Finding("credentials", Mark.WARN, f"{name} is open to other users", f"chmod 600 {name}")
    else:
        yield Finding("credentials", Mark.OK, name)


def _stop_senders() -> Iterator[Finding]:
    """Name who may stop and lock the robots of this machine."""
    name, rules = "emergency stops", StopRules()
    try:
        rules.require_keys()
    except ValidationError as exc:
        yield Finding(name, Mark.BROKEN, "signed stops alone count, and no key can sign one", str(exc))
        return
    if rules.required:
        yield Finding(name, Mark.OK, "only signed ones count, on Device Connect and on the mesh")
        return
    remedy = f"to accept signed stops alone on both networks: strands-robots keys estop FILE, and {REQUIRE_SIGNED}=true"
    who = f"any name may lock the robots, because {ALLOW} is not set" if rules.open else "names count as stated"
    where = "on the mesh, " if rules.signed else ""
    yield Finding(name, Mark.NOTE, f"{where}{who}", remedy)


def _rendering() -> Iterator[Finding]:
    if _version("mujoco") is None:
        yield Finding("rendering", Mark.NOTE, "needs the [sim] extra", install_line("sim"))
        return
    try:
        tried = subprocess.run(
            [sys.executable, "-c", _RENDER], capture_output=True, text=True, timeout=_RENDER_S, check=False
        )
    except subprocess.TimeoutExpired:
        yield Finding("rendering", Mark.WARN, f"no picture within {_RENDER_S:g} s", _rendering_remedy())
        return
    if tried.returncode == 0:
        yield Finding("rendering", Mark.OK, tried.stdout.strip().splitlines()[-1])
    else:
        last = (tried.stderr.strip() or f"ended with {tried.returncode}").splitlines()[-1]
        yield Finding("rendering", Mark.WARN, f"OpenGL does not work here: {last}", _rendering_remedy())


def _rendering_remedy() -> str:
    from strands_robots.simulation.engine import remedy  # noqa: PLC0415 - the simulation is not loaded for other commands

    return remedy()


def _state() -> Iterator[Finding]:
    folder = state_dir()
    if why := unwritable(folder):
        remedy = "set STRANDS_STATE_DIR to a directory that this user can write"
        yield Finding("state", Mark.BROKEN, f"{folder} cannot be written: {why}", remedy)
    else:
        yield Finding("state", Mark.OK, f"grants and lockouts are stored in {folder}")


def _robot_keys() -> Iterator[Finding]:
    for name, identity in robots_here().items():
        if isinstance(identity, str):
            yield Finding(f"key of {name}", Mark.WARN, identity, "its answers are not signed until this is mended")
        else:
            yield Finding(f"key of {name}", Mark.OK, f"fingerprint {identity.fingerprint}")


def _plug_ins() -> Iterator[Finding]:
    """Load each robot, teleoperator and policy of another package in a process of its own."""
    from strands_robots import policies, robot, teleoperators  # noqa: PLC0415 - no other check needs them
    from strands_robots.hardware.lerobot_device import lerobot_plug_ins  # noqa: PLC0415 - as above

    for stated in (robot.PLUG_INS, teleoperators.PLUG_INS, policies.PLUG_INS):
        refused = stated.refused()
        for name, why in refused.items():
            yield Finding(f"{stated.kind} {name}", Mark.WARN, why, "uninstall the package that you do not mean")
        for name in stated.names():
            plug_in = None if name in refused else stated.get(name)
            if plug_in is None:
                continue
            if problem := _load_problem(stated.group, name):
                said = f"{plug_in.package} cannot be loaded: {problem}"
                yield Finding(f"{stated.kind} {name}", Mark.WARN, said, f"mend or uninstall {plug_in.package}")
            else:
                yield Finding(f"{stated.kind} {name}", Mark.OK, plug_in.package)
    for package in lerobot_plug_ins():
        yield Finding("LeRobot plug-in", Mark.OK, f"{package}, loaded when its type is asked for")


def _load_problem(group: str, name: str) -> str:
    """Return why a plug-in cannot be loaded, or nothing."""
    command = [sys.executable, "-c", _LOAD, group, name]
    try:
        tried = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_LOAD_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"not loaded within {_LOAD_S:g} s"
    if tried.returncode == 0:
        return ""
    return (tried.stderr.strip() or f"it ended its process with {tried.returncode}").splitlines()[-1]


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
