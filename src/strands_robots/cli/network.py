"""Network of a command: its flags, else the environment, else this machine."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.output import CliError, Exit, plain
from strands_robots.envelope import Envelope
from strands_robots.fleet.link_flags import LinkFlags, as_flag
from strands_robots.utils import ValidationError, near, port, redacted

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.fleet.adapter import NetworkAdapter
    from strands_robots.mesh import Mesh

NO_METHOD = -32601
"""JSON-RPC's code of an unknown function."""

SOURCE = "strands-robots"
"""Caller's name that goes with the calls of the command line."""


def _option(flag: str, text: str, **more: Any) -> Any:
    return typer.Option(flag, help=text, rich_help_panel="Network", **more)


@dataclass(frozen=True, slots=True)
class Network:
    """Network flags as the user gave them."""

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

    @property
    def opted_in(self) -> bool:
        """True when the user accepts a transport without authentication."""
        return self._stated.opted_in

    def link(self) -> LinkConfig:
        """Return the link that the flags describe.

        Raises:
            CliError: the flags contradict one another, or leave this machine without authentication.
            MissingExtraError: Device Connect is not installed.
        """
        if self.credentials:
            # For the processes that a command starts, and for what it prints.
            settings.put("MESSAGING_CREDENTIALS_FILE", str(self.credentials))
        try:
            return self._stated.link(as_flag)
        except ValidationError as exc:
            raise CliError(str(exc), Exit.USAGE) from exc

    @property
    def _stated(self) -> LinkFlags:
        return LinkFlags(**{each.name: getattr(self, each.name) for each in fields(self)})

    @contextmanager
    def fleet(self, source: str = SOURCE) -> Iterator[FleetClient]:
        """Connect to the robots on this network for the length of the block.

        Raises:
            CliError: the network cannot be reached, or fails in use.
        """
        link = self.link()
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when a network is used

        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - as above

        try:
            with FleetClient(link, source) as fleet:
                yield fleet
        except MessagingError as exc:
            raise CliError(f"The network does not carry this: {exc}", Exit.SILENT) from exc

    @contextmanager
    def joined(self, *, on_mesh: bool = False, source: str = SOURCE) -> Iterator[NetworkAdapter]:
        """Join Device Connect, or the native mesh, for the length of the block.

        Raises:
            CliError: the network cannot be reached, fails in use, or takes no such flag.
        """
        with ExitStack() as stack:
            if on_mesh:
                from strands_robots.fleet.mesh.network import MeshNetwork  # noqa: PLC0415 - loaded when it is used

                self.use_mesh()
                mesh = stack.enter_context(mesh_peer(None, temporary_mesh_id("console"), "tool"))
                network: NetworkAdapter = MeshNetwork.joined(mesh)
            else:
                from strands_robots.fleet.device_connect.network import DeviceConnectNetwork  # noqa: PLC0415 - as above

                network = DeviceConnectNetwork.joined(stack.enter_context(self.fleet(source)))
            yield network

    @property
    def stated_tenant(self) -> str:
        """The tenant of Device Connect, of the flag or the environment."""
        return self._stated.stated_tenant

    @property
    def flags(self) -> str:
        """The flags as given, without passwords, for another command."""
        words = []
        for each in fields(self):
            value, flag = getattr(self, each.name), f"--{each.name.replace('_', '-')}"
            if isinstance(value, list):
                words += [word for one in value for word in (flag, redacted(one))]
            elif value is not None and value is not False:
                words += [flag] if value is True else [flag, str(value)]
        return "".join(f" {shlex.quote(word)}" for word in words)

    def use_mesh(self) -> None:
        """Apply the flags to the native mesh, which takes only ``--port``.

        Raises:
            CliError: another flag was given.
            ValidationError: the port is not one.
        """
        if any(getattr(self, each.name) for each in fields(self) if each.name != "port"):
            raise CliError("--mesh takes no network flag but --port; docs/mesh.md has its settings.", Exit.USAGE)
        if self.port is not None:
            settings.put("STRANDS_MESH_PORT", str(port("--port", self.port)))


@contextmanager
def answering(fleet: FleetClient, device: str) -> Iterator[None]:
    """Ask a device while the block runs.

    Raises:
        CliError: no such device or no answer (exit code 3), or the call was refused as such (exit code 1).
    """
    from strands_robots.device_connect.client import (  # noqa: PLC0415 - loaded when a network is used
        CallRefusedError,
        DeviceTimeoutError,
        NoSuchDeviceError,
    )

    try:
        yield
    except NoSuchDeviceError as exc:
        raise CliError(plain(f"{exc.args[0]}{near_devices(fleet, device)}", 2000), Exit.SILENT) from exc
    except DeviceTimeoutError as exc:
        raise CliError(plain(exc.args[0], 2000), Exit.SILENT) from exc
    except CallRefusedError as exc:
        raise CliError(plain(str(exc), 2000), Exit.REFUSED, jsonrpc_code=exc.code) from exc


def call_device(fleet: FleetClient, device: str, function: str, params: Mapping[str, Any], seconds: float) -> Envelope:
    """Call a function of a device and return its answer; raises as :func:`answering`."""
    try:
        with answering(fleet, device):
            return fleet.call(device, function, params, seconds)
    except CliError as failure:
        if failure.fields.get("jsonrpc_code") == NO_METHOD and (verbs := near_verbs(fleet, device, function)):
            said = plain(f"{failure.reason.rstrip('.')}.{verbs}", 2000)
            raise CliError(said, failure.code, **failure.fields) from failure
        raise


def near_verbs(fleet: FleetClient, device: str, function: str) -> str:
    """Return a sentence with the verbs of a device that resemble an absent one."""
    from strands_robots.serving.advertised import verb_names  # noqa: PLC0415 - only a refusal needs it

    try:
        return near(function, verb_names(fleet.describe(device).functions))
    except (LookupError, TimeoutError, RuntimeError):
        return ""


def near_devices(fleet: FleetClient, device: str) -> str:
    """Return a sentence with the ids that resemble an absent one."""
    names = [peer.id for peer in fleet.peers(1.0)]
    return "" if device in names else near(device, names)


def temporary_mesh_id(name: str) -> str:
    """Return a fresh mesh id for one command, covered by its certificate, if any."""
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - loaded when a network is used
    from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

    try:
        return visitor_id(name)
    except (TransportError, IdentityError) as exc:
        raise CliError(str(exc), Exit.USAGE) from exc


@contextmanager
def mesh_peer(robot: Any, peer_id: str | None, peer_type: str) -> Iterator[Mesh]:
    """Join the native mesh while the block runs; raise :class:`CliError` if it fails."""
    from strands_robots.tools.networks import MeshUnavailableError, joined_mesh  # noqa: PLC0415 - as above

    with ExitStack() as stack:
        try:
            mesh = stack.enter_context(joined_mesh(robot, peer_id, peer_type))
        except MeshUnavailableError as exc:
            raise CliError(str(exc)) from exc
        except ValueError as exc:
            raise CliError(str(exc), Exit.USAGE) from exc
        yield mesh
