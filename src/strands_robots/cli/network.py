"""Which network a command uses: its flags, else the environment, else this machine alone."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.output import Exit, Failure
from strands_robots.utils import missing_extra, port

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

_NEEDS = (
    "Leaving this machine needs proof of who is who: certificates (--tls-ca, --tls-cert, --tls-key), "
    "credentials (--credentials FILE) or --insecure, which lets anybody on that network drive the robot."
)


@dataclass(frozen=True, slots=True)
class Network:
    """The network flags as they were given."""

    nats: str | None = None
    connect: list[str] | None = None
    listen: list[str] | None = None
    multicast: bool = False
    port: int | None = None
    tenant: str | None = None
    insecure: bool = False
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    credentials: Path | None = None

    @property
    def opted_in(self) -> bool:
        """True when the user accepts a transport without authentication."""
        return self.insecure or settings.boolean("DEVICE_CONNECT_ALLOW_INSECURE")

    def link(self) -> LinkConfig:
        """The link that the flags describe.

        Raises:
            Failure: the flags contradict one another, or leave this machine without any proof of identity.
            MissingExtraError: Device Connect is not installed.
        """
        if self.nats and (self.connect or self.listen or self.multicast):
            raise Failure("--nats names a broker; --connect, --listen and --multicast are for Zenoh.", Exit.USAGE)
        link = self._secured(self._reached())
        if not link.authenticated and not link.loopback_only and not self.opted_in:
            raise Failure(_NEEDS, Exit.USAGE)
        return link

    def on_mesh(self) -> None:
        """Take the port, which is all that the native mesh has a use for.

        Raises:
            Failure: another flag was given.
            ValidationError: the port is none.
        """
        if any(getattr(self, each.name) for each in fields(self) if each.name != "port"):
            raise Failure("--mesh takes no network flag but --port; docs/mesh.md has its settings.", Exit.USAGE)
        if self.port is not None:
            settings.put("STRANDS_MESH_PORT", str(port("--port", self.port)))

    def _reached(self) -> LinkConfig:
        backends = _backends()
        tenant = self.tenant or settings.raw("TENANT")
        if self.credentials:
            settings.put("MESSAGING_CREDENTIALS_FILE", str(self.credentials))
        if self.nats or self.connect or self.listen or self.multicast:
            mode = "peer" if self.listen or self.multicast else "auto"
            reached: LinkConfig = backends.LinkConfig(
                transport="nats" if self.nats else "zenoh",
                mode="auto" if self.nats else mode,
                connect=(self.nats,) if self.nats else _endpoints(self.connect),
                listen=_endpoints(self.listen),
                multicast=True if self.multicast else None,
                tenant=tenant,
            )
            if self.credentials:
                stated = backends.link_from_environment(tenant, reached.transport)
                reached = replace(
                    reached,
                    jwt=stated.jwt,
                    nkey_seed=stated.nkey_seed,
                    ca=stated.ca,
                    cert=stated.cert,
                    key=stated.key,
                    tenant=stated.tenant,
                )
            return reached
        from strands_robots.device_connect.links import usual_link  # noqa: PLC0415 - loaded when a network is used

        return usual_link(tenant, self.port)

    def _secured(self, link: LinkConfig) -> LinkConfig:
        return replace(
            link,
            ca=_pem("--tls-ca", self.tls_ca, link.ca),
            cert=_pem("--tls-cert", self.tls_cert, link.cert),
            key=_pem("--tls-key", self.tls_key, link.key),
        )


def describe(link: LinkConfig) -> str:
    """One sentence: who can reach what is served over ``link``."""
    proof = "both sides prove who they are" if link.authenticated else "nobody proves who they are"
    if link.transport == "nats":
        return f"NATS at {', '.join(link.connect) or 'its default address'}; {proof}."
    if link.meeting_point:
        return f"This machine alone: {link.meeting_point}; nothing leaves 127.0.0.1."
    ways = [f"connects to {', '.join(link.connect)}"] if link.connect else []
    ways += [f"listens on {', '.join(link.listeners)}"] if link.listeners else []
    ways += ["finds peers by multicast"] if link.uses_multicast else []
    return f"Zenoh: {'; '.join(ways)}; {proof}."


def _backends() -> Any:
    # Looked for and not imported: a command that refuses its flags need not load the framework for it.
    if find_spec("device_connect_edge") is None:
        raise missing_extra("Device Connect", "device-connect")
    from strands_robots.device_connect import backends  # noqa: PLC0415 - loaded when a network is used

    return backends


def _pem(flag: str, path: Path | None, otherwise: str) -> str:
    if path is not None and not path.is_file():
        raise Failure(f"{flag} {path} is no file.", Exit.USAGE)
    return str(path) if path is not None else otherwise


def _endpoints(given: list[str] | None) -> tuple[str, ...]:
    from strands_robots.device_connect.backends.config import endpoints  # noqa: PLC0415 - as above

    return endpoints([part for each in given or [] for part in each.split(",")])


def _option(name: str, annotation: Any, flag: str, text: str, default: Any = None, **more: Any) -> Parameter:
    described = Annotated[annotation, typer.Option(flag, help=text, rich_help_panel="Network", **more)]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=described)


NETWORK_OPTIONS: tuple[Parameter, ...] = (
    _option("nats", str | None, "--nats", "NATS server, such as nats://host:4222.", metavar="URL"),
    _option("connect", list[str] | None, "--connect", "Zenoh endpoint to connect to (repeat).", metavar="EP"),
    _option("listen", list[str] | None, "--listen", "Zenoh endpoint to listen on (repeat).", metavar="EP"),
    _option("multicast", bool, "--multicast", "Find peers on the local network by multicast.", False),
    _option("port", int | None, "--port", "Loopback port where local robots meet.", min=1, max=65535),
    _option("tenant", str | None, "--tenant", "Device Connect tenant."),
    _option("insecure", bool, "--insecure", "Accept a transport without authentication.", False),
    _option("tls_ca", Path | None, "--tls-ca", "Authority that peers are checked against (PEM)."),
    _option("tls_cert", Path | None, "--tls-cert", "This side's certificate (PEM)."),
    _option("tls_key", Path | None, "--tls-key", "This side's private key (PEM)."),
    _option("credentials", Path | None, "--credentials", "Device Connect credentials file (JSON)."),
)
"""The flags that say which network, the same for every command that uses one."""
