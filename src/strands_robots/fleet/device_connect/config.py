"""Network of Device Connect: flags, else the environment, else this machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from strands_robots import settings
from strands_robots.utils import ValidationError, device_id, missing_extra, redacted, shown

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

Spelled = Callable[[str], str]
"""Gives the name of a flag as its user writes it."""


def as_flag(name: str) -> str:
    """Spell a flag as the command line does."""
    return f"--{name.replace('_', '-')}"


@dataclass(frozen=True, slots=True)
class LinkFlags:
    """Network flags as the user gave them.

    Attributes:
        nats: NATS servers, such as ``nats://host:4222``.
        connect: Zenoh endpoints to connect to.
        listen: Zenoh endpoints to listen on.
        multicast: find peers on the local network by multicast.
        port: loopback port where local robots meet.
        tenant: Device Connect tenant; that of the environment by default.
        insecure: accept a transport without authentication.
        tls_ca: authority that peers are checked against, a PEM file.
        tls_cert: this side's certificate.
        tls_key: this side's private key.
        credentials: Device Connect credentials file.
        alone: they say all, as those of a connection profile do: no variable that names a network, a port, a tenant or
            certificates counts besides.

    Raises:
        ValidationError: a tenant, a server or an endpoint that is given and empty.
    """

    nats: Sequence[str] | None = None
    connect: Sequence[str] | None = None
    listen: Sequence[str] | None = None
    multicast: bool = False
    port: int | None = None
    tenant: str | None = None
    insecure: bool = False
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    credentials: Path | None = None
    alone: bool = False

    def __post_init__(self) -> None:
        """Refuse what is given and empty: another network or tenant would take its place.

        Raises:
            ValidationError: naming it.
        """
        if self.tenant is not None:
            device_id("tenant", self.tenant)
        for name in ("nats", "connect", "listen"):
            stated: Sequence[str] = getattr(self, name) or ()
            for each in stated:
                if not each.replace(",", "").strip():
                    what = (
                        "a server, such as nats://host:4222" if name == "nats" else "an endpoint, such as tcp/host:7447"
                    )
                    raise ValidationError(f"{name} needs {what}, not {shown(each)}.")

    @property
    def opted_in(self) -> bool:
        """True when the user accepts a transport without authentication."""
        return self.insecure or settings.boolean("DEVICE_CONNECT_ALLOW_INSECURE")

    @property
    def stated_tenant(self) -> str:
        """The tenant of Device Connect, of the flag or the environment."""
        return self.tenant or (settings.default if self.alone else settings.raw)("TENANT")

    def link(self, spelled: Spelled = str) -> LinkConfig:
        """Return the link that the flags describe.

        Raises:
            ValidationError: the flags contradict one another, or leave this machine without authentication.
            MissingExtraError: Device Connect is not installed.
        """
        if self.nats and (self.connect or self.listen or self.multicast):
            zenoh = f"{spelled('connect')}, {spelled('listen')} and {spelled('multicast')}"
            raise ValidationError(f"{spelled('nats')} names a broker; {zenoh} are for Zenoh.")
        link = self._reached()
        link = replace(
            link,
            ca=_pem(spelled("tls_ca"), self.tls_ca, link.ca),
            cert=_pem(spelled("tls_cert"), self.tls_cert, link.cert),
            key=_pem(spelled("tls_key"), self.tls_key, link.key),
        )
        if not link.authenticated and not link.loopback_only and not self.opted_in:
            raise ValidationError(
                "A network beyond this machine needs authentication: certificates "
                f"({spelled('tls_ca')}, {spelled('tls_cert')}, {spelled('tls_key')}), credentials "
                f"({spelled('credentials')} FILE) or {spelled('insecure')}, which lets every program on that network "
                "drive the robot."
            )
        return link

    def _reached(self) -> LinkConfig:
        # The framework is looked up and not imported: a command that refuses its flags need not load it.
        if find_spec("device_connect_edge") is None:
            raise missing_extra("Device Connect", "device-connect")
        from strands_robots.device_connect import backends  # noqa: PLC0415 - loaded when a network is used
        from strands_robots.device_connect.backends.config import endpoints, split_urls, usual_link  # noqa: PLC0415 - as above

        tenant = self.stated_tenant
        if self.nats or self.connect or self.listen or self.multicast:
            transport = "nats" if self.nats else "zenoh"
            link = backends.LinkConfig(transport=transport, tenant=tenant)
            if self.credentials:
                link = backends.link_from_environment(tenant, transport, self.credentials, alone=self.alone)
            return replace(
                link,
                mode="peer" if self.listen or self.multicast else "auto",
                connect=split_urls(self.nats) if self.nats else endpoints(split_urls(self.connect or [])),
                listen=endpoints(split_urls(self.listen or [])),
                multicast=True if self.multicast else None,
                verify_hostname=True,
            )
        if self.alone and (self.port is not None or not self.credentials):
            meets = int(settings.default("STRANDS_DC_PORT")) if self.port is None else self.port
            return backends.loopback_config(meets, tenant)
        if self.alone:
            return backends.link_from_environment(tenant, credentials_file=self.credentials, alone=True)
        return usual_link(tenant, self.port, self.credentials)


def _pem(flag: str, path: Path | None, otherwise: str) -> str:
    if path is not None and not path.is_file():
        raise ValidationError(f"{flag} {path} is no file.")
    return str(path) if path is not None else otherwise


def enrolled_keys(link: LinkConfig) -> dict[str, bytes]:
    """Return the enrolled keys of the robots on this network.

    Raises:
        KeyFileError: the keys cannot be used.
    """
    from strands_robots.device_connect.backends.config import enrolled_robots  # noqa: PLC0415 - loaded when a network is used
    from strands_robots.safety.identity import KeyFileError  # noqa: PLC0415 - as above

    try:
        return enrolled_robots(link)
    except (KeyFileError, OSError) as exc:
        raise KeyFileError(f"The enrolled keys cannot be used: {exc}") from exc


def described(link: LinkConfig) -> str:
    """Describe in one sentence who can reach a robot over ``link``."""
    proof = "both sides are authenticated" if link.authenticated else "neither side is authenticated"
    if link.transport == "nats":
        return f"NATS at {redacted(', '.join(link.connect)) or 'its default address'}; {proof}."
    if link.meeting_point:
        return f"This machine alone: {link.meeting_point}; nothing leaves 127.0.0.1."
    ways = [f"connects to {', '.join(link.connect)}"] if link.connect else []
    ways += [f"listens on {', '.join(link.listeners)}"] if link.listeners else []
    ways += ["finds peers by multicast"] if link.uses_multicast else []
    return f"Zenoh: {'; '.join(ways)}; {proof}."
