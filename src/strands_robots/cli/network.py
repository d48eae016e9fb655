"""Network of a command: its flags, else the environment, else this machine."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.cli.output import CliError, Exit, Screen, plain
from strands_robots.cli.readiness import other_user
from strands_robots.errors import (
    AmbiguousRobotError,
    ArgumentsError,
    NoSuchRobotError,
    RefusalError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import DEVICE_CONNECT, SOURCE
from strands_robots.fleet.device_connect.config import LinkFlags, as_flag
from strands_robots.fleet.mesh.config import put_settings
from strands_robots.fleet.profiles import FleetProfile, mesh_at, profile_for, profile_name
from strands_robots.utils import ValidationError, near, port, redacted, shown

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.fleet.networks import Networks
    from strands_robots.fleet.remote_robot import RemoteRobot
    from strands_robots.mesh import Mesh

logger = logging.getLogger(__name__)


OF_NO_LINK = ("profile", "mesh")
"""Fields of :class:`Network` that are no flags of Device Connect."""


def _option(flag: str, text: str, **more: Any) -> Any:
    return typer.Option(flag, help=text, rich_help_panel="Network", **more)


@dataclass(frozen=True)
class Network:
    """Network flags as the user gave them, over a connection profile."""

    profile: Annotated[
        str | None, _option("--fleet", "Connection profile: its name, or a .toml file.", metavar="NAME")
    ] = None
    nats: Annotated[
        list[str] | None, _option("--nats", "NATS server, such as nats://host:4222 (repeat).", metavar="URL")
    ] = None
    connect: Annotated[
        list[str] | None, _option("--connect", "Zenoh endpoint to connect to (repeat).", metavar="EP")
    ] = None
    listen: Annotated[list[str] | None, _option("--listen", "Zenoh endpoint to listen on (repeat).", metavar="EP")] = (
        None
    )
    multicast: Annotated[bool, _option("--multicast", "Find peers on the local network by multicast.")] = False
    port: Annotated[int | None, _option("--port", "Loopback port where local robots meet.", min=1, max=65535)] = None
    tenant: Annotated[str | None, _option("--tenant", "Device Connect tenant: a fleet that sees no other one.")] = None
    insecure: Annotated[bool, _option("--insecure", "Accept a transport without authentication.")] = False
    tls_ca: Annotated[Path | None, _option("--tls-ca", "Authority that peers are checked against (PEM).")] = None
    tls_cert: Annotated[Path | None, _option("--tls-cert", "This side's certificate (PEM).")] = None
    tls_key: Annotated[Path | None, _option("--tls-key", "This side's private key (PEM).")] = None
    credentials: Annotated[Path | None, _option("--credentials", "Device Connect credentials file (JSON).")] = None
    mesh: Annotated[bool, typer.Option("--mesh", help="On the native mesh alone.")] = False

    def link(self) -> LinkConfig:
        """Return the link that the flags describe.

        Raises:
            CliError: the flags contradict one another, or leave this machine without authentication.
            MissingExtraError: Device Connect is not installed.
        """
        try:
            profile = self._profile
            link = self.stated.link(as_flag)
        except ValidationError as exc:
            raise CliError(str(exc), Exit.USAGE) from exc
        if profile is not None:
            if self.on_mesh_alone:
                raise CliError(f"The connection profile {profile.label} has a mesh alone: give --mesh.", Exit.USAGE)
            mesh = None if self._usable_mesh is False else profile.mesh
            # The mesh of the environment may be another fleet's.
            put_settings({"STRANDS_MESH": "false"} if mesh is None else mesh)
        self._put_credentials()
        return link

    def check(self) -> None:
        """Refuse a connection profile that cannot be used.

        Raises:
            ValidationError: naming the file, the value and its domain.
        """
        profile = self._profile
        if profile is not None:
            profile.check()

    def caller(self) -> str:
        """Return the caller's name of the connection profile, else the usual one.

        One that cannot be used is left out: a stop needs none.
        """
        profile = self._profile
        try:
            return (profile.name if profile is not None else None) or SOURCE
        except ValidationError as unfit:
            logger.warning("%s The caller is %s.", unfit, SOURCE)
            return SOURCE

    @property
    def _given(self) -> dict[str, Any]:
        """Return the flags of Device Connect that were given."""
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in OF_NO_LINK}
        return {name: value for name, value in given.items() if value is not None and value not in (False, [])}

    @cached_property
    def _profile(self) -> FleetProfile | None:
        # Read once: a file that changes meanwhile must not give one command two fleets.
        return profile_for(self.profile, self._given)

    @property
    def stated(self) -> LinkFlags:
        """The flags of Device Connect, over those of the profile."""
        profile = self._profile
        return LinkFlags(**self._given) if profile is None else profile.flags(self._given)

    def _put_credentials(self) -> None:
        """Name the credentials to the processes that a command starts."""
        if credentials := self.stated.credentials:
            settings.put("MESSAGING_CREDENTIALS_FILE", str(credentials))

    def networks(
        self,
        *,
        source: str | None = None,
        stays: bool = False,
        console: bool = False,
        with_mesh: bool = False,
    ) -> Networks:
        """Return the networks of the flags, not joined yet.

        Args:
            with_mesh: the native mesh in any case, so that its absence is told.
            source: the caller's name; by default that of :meth:`caller`.
            stays: the command lasts, and goes on trying to join what is not there yet.
            console: a safety controller, whose name is its whole id on the mesh.

        Raises:
            CliError: the flags contradict one another, or leave this machine without authentication.
            MissingExtraError: no network is installed.
        """
        from strands_robots.fleet.profiles import networks_of  # noqa: PLC0415 - loaded when a network is used

        name = self.caller() if source is None else source
        if self.mesh:
            self.use_mesh()
            if mesh_env_request() is False:
                raise CliError("The native mesh is off: STRANDS_MESH switches it off.", Exit.SILENT)
            return networks_of(None, {}, name, devices=False, mesh=True, stays=stays, console=console)
        try:
            mesh = True if with_mesh else self._usable_mesh
            networks = networks_of(self._profile, self._given, name, mesh=mesh, stays=stays, console=console)
        except ValidationError as exc:
            raise CliError(str(exc), Exit.USAGE) from exc
        if not networks.stated and not self.on_mesh_alone:
            # It names the extra.
            self.stated.link(as_flag)
        self._put_credentials()
        return networks

    @contextmanager
    def joined(self, *, source: str | None = None, stays: bool = False, in_turn: bool = False) -> Iterator[Networks]:
        """Join the networks of the flags, or those of them that are there.

        Args:
            source: the caller's name, as in :meth:`networks`.
            stays: as in :meth:`networks`.
            in_turn: as in :meth:`Networks.open`.

        Raises:
            CliError: none can be reached, all fail in use, or the flags cannot be used.
        """
        try:
            with closing(self.networks(source=source, stays=stays)) as networks:
                networks.open(in_turn=in_turn)
                yield networks
        except UnreachableError as refusal:
            raise CliError(plain(f"The network does not carry this: {refusal.why}", 2000), Exit.SILENT) from refusal

    def other_user(self, networks: Networks) -> str:
        """Return who else serves robots where those of this machine meet, or ""."""
        devices = any(each.name == DEVICE_CONNECT for each in networks.stated)
        return other_user(self.stated.link(as_flag)) if devices else ""

    @property
    def _usable_mesh(self) -> bool | None:
        """False where the profile's mesh cannot be used, and is left out."""
        profile = self._profile
        try:
            _ = None if profile is None else profile.mesh
        except ValidationError as unfit:
            logger.warning("%s The mesh is left out.", unfit)
            return False
        return None

    @property
    def flags(self) -> str:
        """The flags as given, without passwords, for another command."""
        words = ["--mesh"] if self.mesh else list[str]()
        for name, value in {"fleet": profile_name(self.profile, self._given), **self._given}.items():
            flag = as_flag(name)
            if isinstance(value, list):
                words += [word for one in value for word in (flag, redacted(one))]
            elif value is not None:
                words += [flag] if value is True else [flag, str(value)]
        return "".join(f" {shlex.quote(word)}" for word in words)

    @property
    def on_mesh_alone(self) -> bool:
        """True for a connection profile that has a mesh and no Device Connect."""
        profile = self._profile
        return profile is not None and not profile.reaches_devices(self._given)

    def use_mesh(self) -> None:
        """Apply the flags to the native mesh, which takes ``--fleet`` and ``--port``.

        Raises:
            CliError: another flag was given, or the connection profile has no mesh.
            ValidationError: the port is not one, or the profile cannot be used.
        """
        if self._given.keys() - {"port"}:
            raise CliError(
                "--mesh takes no network flag but --fleet and --port; docs/mesh.md has its settings.", Exit.USAGE
            )
        profile = self._profile
        if profile is not None:
            if profile.mesh is None:
                raise CliError(f"--mesh: the connection profile {profile.label} has no mesh.", Exit.USAGE)
            put_settings(profile.mesh)
        if self.port is not None:
            put_settings(mesh_at(port("--port", self.port)))


def say_missing(screen: Screen, networks: Networks) -> None:
    """Name the networks that were asked for and cannot be reached."""
    for name, why in networks.missing.items():
        screen.say(plain(f"Not reached: {name}, {why}", 2000), "yellow")


@contextmanager
def reached(screen: Screen, network: Network, robot: str) -> Iterator[tuple[Networks, RemoteRobot]]:
    """Join the networks to stay; yield them with the robot or world of that id.

    Raises:
        CliError: there is none, as :func:`answering` says.
    """
    from strands_robots.fleet import Fleet  # noqa: PLC0415 - loaded when a network is used

    with network.joined(stays=True) as there:
        there.settled()
        say_missing(screen, there)
        with answering(there, robot, ""):
            found = Fleet(there)[robot]
        yield there, found


def one_robot(world: RemoteRobot, part: str, argument: str) -> RemoteRobot:
    """Return the named robot of a world, or the only one that is there.

    Args:
        world: the world, or a robot that is none.
        part: the robot's name in its world; empty for the only one.
        argument: names it in a refusal.

    Raises:
        ValidationError: the world has several robots and none is named, or none of that name.
        RefusalError: it does not answer.
    """
    robots = world.robots
    if part not in robots and (part or len(robots) > 1):
        known = ", ".join(f"{world.id}/{name}" for name in robots) or world.id
        raise ValidationError(f"{argument} must be one of {known}, not {shown(f'{world.id}/{part}'.rstrip('/'))}.")
    return robots[part] if part else world


@contextmanager
def answering(there: Networks, robot: str, verb: str) -> Iterator[None]:
    """Ask a robot while the block runs.

    Raises:
        CliError: no such robot or no answer (exit code 3), the call was refused as such, or two robots have the id
            (exit code 1), or its arguments were refused (exit code 2).
    """
    from strands_robots.fleet.reports import near_verbs, said  # noqa: PLC0415 - only a call needs it

    try:
        yield
    except RefusalError as refusal:
        answer = refusal.envelope
        if isinstance(refusal, UnreachableError) and not answer:
            raise
        several = isinstance(refusal, AmbiguousRobotError)
        reason, code = said(refusal), Exit.REFUSED if answer or several else Exit.SILENT
        if isinstance(refusal, ArgumentsError):
            code = Exit.USAGE
        fields: dict[str, Any] = {"answer": answer} if answer else {}
        if several:
            reason += " Give one of them another id; --mesh means the one on the mesh."
        elif isinstance(refusal, NoSuchRobotError):
            reason += "" if refusal.remedy else near_robots(there, robot)
            reason += "".join(f" Not reached: {name}, {why.rstrip('.')}." for name, why in there.missing.items())
        elif "jsonrpc_code" in answer:
            fields = {"jsonrpc_code": answer["jsonrpc_code"]}
            verbs = near_verbs(there, robot, verb) if isinstance(refusal, UnknownVerbError) else ""
            reason = f"{reason.rstrip('.')}.{verbs}" if verbs else reason
        raise CliError(plain(reason, 2000), code, **fields) from refusal


def near_robots(there: Networks, robot: str) -> str:
    """Return a sentence with the ids that resemble an absent one."""
    try:
        names = there.find(1.0)
    except RefusalError:
        return ""
    return "" if robot in names else near(robot, names)


@contextmanager
def mesh_peer(robot: Any, peer_id: str | None, peer_type: str) -> Iterator[Mesh]:
    """Join the native mesh while the block runs; raise :class:`CliError` if it fails."""
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - loaded when a network is used

    try:
        mesh = init_mesh(robot, peer_id, peer_type)
    except ValueError as exc:
        raise CliError(str(exc), Exit.USAGE) from exc
    if mesh is None:
        raise CliError("The native mesh is off: STRANDS_MESH switches it off.")
    with closing(mesh):
        if not mesh.alive:
            raise CliError("The native mesh has no session; the log says why.")
        yield mesh
