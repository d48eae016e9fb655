"""Banner of ``serve``: its network, and commands for another terminal."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from strands_robots import settings
from strands_robots.cli.output import Screen
from strands_robots.fleet.callers import SOURCE
from strands_robots.fleet.link_flags import described
from strands_robots.safety.authorization import listed, motion_refusal
from strands_robots.utils import redacted

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

EVERY_PROGRAM_HERE = "Every program of this machine can drive and read it, no other machine can."

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
        screen.say(EVERY_PROGRAM_HERE)
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
        from strands_robots.cli.certificates import own_host  # noqa: PLC0415 - its package is loaded when it is used

        here = own_host(link) or here
    for host in _ANYWHERE:
        endpoint = endpoint.replace(f"/{host}:", f"/{here}:")
    return endpoint
