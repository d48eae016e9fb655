"""Choice of a link, and what belongs to the network that it reaches."""

from __future__ import annotations

import atexit
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.device_connect.backends import LinkConfig, link_from_environment, loopback_config
from strands_robots.device_connect.backends.config import DEFAULT_URL, endpoints, split_urls
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.utils import ValidationError, choice, device_id, redacted, shown, text

logger = logging.getLogger(__name__)

_NAMES_A_NETWORK = (
    "MESSAGING_URLS",
    "MESSAGING_CREDENTIALS_FILE",
    "NATS_URL",
    "NATS_URLS",
    "NATS_CREDENTIALS_FILE",
    "ZENOH_CONNECT",
    "ZENOH_LISTEN",
)


def usual_link(
    tenant: str | None = None, port: int | None = None, credentials_file: str | Path | None = None
) -> LinkConfig:
    """Return the link that the environment names, else one on this machine alone.

    Args:
        tenant: ``TENANT`` by default.
        port: the loopback port where local robots meet; giving it means this machine alone.
        credentials_file: that of the environment by default.
    """
    tenant = tenant or settings.raw("TENANT")
    if port is None and (credentials_file or any(settings.is_set(name) for name in _NAMES_A_NETWORK)):
        return link_from_environment(tenant, credentials_file=credentials_file)
    return loopback_config(port, tenant)


def link_for(
    messaging_url: str | None, messaging_backend: str | None, tenant: str, link: LinkConfig | None
) -> LinkConfig:
    """Return the link that the arguments of ``init_device_connect`` describe.

    Raises:
        ValidationError: an argument out of its domain, or a ``link`` beside a URL or a backend.
    """
    device_id("tenant", tenant)
    if messaging_backend is not None:
        choice("messaging_backend", messaging_backend, ("zenoh", "nats"))
    if link is not None:
        if messaging_url is not None or messaging_backend is not None:
            raise ValidationError("link says everything; give no messaging_url and no messaging_backend beside it.")
        return link if tenant in ("default", link.tenant) else replace(link, tenant=tenant)
    if messaging_url is None:
        found = link_from_environment(tenant, messaging_backend)
        if found.transport == "nats" and not found.connect:
            raise ValidationError("nats needs a server: give messaging_url or set NATS_URL.")
        return found
    urls = split_urls([text("messaging_url", messaging_url, longest=500)])
    transport = messaging_backend or transport_of(urls[0] if urls else "")
    base = link_from_environment(tenant, transport)
    return replace(base, connect=endpoints(urls) if transport == "zenoh" else urls, listen=(), multicast=None)


def transport_of(url: str) -> str:
    """Return the transport of a URL; ``tls://`` is NATS, ``tls/`` is Zenoh.

    Raises:
        ValidationError: none of these.
    """
    lower = url.lower()
    if lower.startswith(("nats://", "tls://")):
        return "nats"
    if lower.startswith(("zenoh://", "zenoh+tls://", "tcp/", "tls/", "udp/", "quic/")):
        return "zenoh"
    raise ValidationError(
        f"messaging_url must be nats://host:port, tls://host:port or tcp/host:port, not {shown(redacted(url))}."
    )


def insecure_opt_in(allow_insecure: bool | None, link: LinkConfig, *, stated: bool) -> bool:
    """Return True, and warn, when a device may run on an unauthenticated link.

    Args:
        allow_insecure: the caller's choice; None leaves it to ``DEVICE_CONNECT_ALLOW_INSECURE``.
        stated: the caller gave this link; where it stays on this machine, that counts as the opt-in.

    Raises:
        ValidationError: ``allow_insecure`` is no boolean, or there is no opt-in.
    """
    if allow_insecure is not None and not isinstance(allow_insecure, bool):
        raise ValidationError(
            f"allow_insecure must be True, False or None, not {shown(allow_insecure)}; "
            "spellings belong to DEVICE_CONNECT_ALLOW_INSECURE."
        )
    if link.encrypted and not link.verify_hostname:
        logger.warning("verify_hostname is False: any holder of a certificate of the authority can pose as the server.")
    if link.authenticated:
        return False
    opted_in = settings.boolean("DEVICE_CONNECT_ALLOW_INSECURE") if allow_insecure is None else allow_insecure
    if opted_in:
        logger.warning(
            "INSECURE TRANSPORT: no peer is authenticated and %s. Anyone who reaches %s can drive "
            "and read this robot. Not for production.",
            "only the server proves who it is" if link.encrypted else "nothing is encrypted",
            redacted(", ".join(link.connect)) or ("the local network" if link.uses_multicast else "this machine"),
        )
        return True
    if allow_insecure is None and stated and link.loopback_only:
        # What the panel of serve says, too. Nothing has to be done about it.
        logger.info(
            "No authentication on 127.0.0.1: every program on this machine can drive and read this robot, "
            "no other machine can."
        )
        return True
    raise ValidationError(
        "This transport is not authenticated: either opt in with allow_insecure=True "
        "(or DEVICE_CONNECT_ALLOW_INSECURE=true), or give certificates (MESSAGING_TLS_CA_FILE, "
        "MESSAGING_TLS_CERT_FILE, MESSAGING_TLS_KEY_FILE) or, to a NATS server, TLS (tls://host:port) and "
        "credentials (MESSAGING_CREDENTIALS_FILE).",
        "INSECURE_TRANSPORT",
    )


def enrolled_robots(link: LinkConfig) -> dict[str, bytes]:
    """Return the enrolled public keys of the link's tenant, by device id.

    Raises:
        KeyFileError, OSError: the enrolled keys cannot be used.
    """
    from strands_robots.safety.identity import EnrolledKeys, of_tenant  # noqa: PLC0415 - a choice of links has no keys

    return of_tenant(EnrolledKeys().load(), link.tenant)


def network_of(link: LinkConfig) -> NetworkKey:
    """Return the key of the network that a link reaches."""
    met = (link.meeting_point,) if link.meeting_point else ()
    listened = [each for each in link.listen if not each.endswith(":0")]
    scouted = ("multicast",) if link.uses_multicast else ()
    default = DEFAULT_URL if link.transport == "nats" else "nowhere"
    stated = [*link.connect, *listened, *met, *scouted] or [default]
    return NetworkKey.of(DEVICE_CONNECT, stated, link.tenant)


def connect_agent(**options: Any) -> None:
    """Connect the framework's ``discover`` and ``invoke`` to our robots.

    Where the environment names no network, they are those of this machine. The end of the process disconnects: the
    framework's own thread, which the interpreter would end inside Zenoh, could abort the process.

    Args:
        options: of ``device_connect_agent_tools.connect``, such as ``request_timeout``.
    """
    from device_connect_agent_tools import connect, disconnect  # noqa: PLC0415 - loaded when an agent connects

    link = usual_link()
    if link.meeting_point:
        settings.put("ZENOH_CONNECT", link.meeting_point)
        if not settings.is_set("DEVICE_CONNECT_DISCOVERY_MODE"):
            settings.put("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    atexit.unregister(disconnect)
    atexit.register(disconnect)
    connect(**options)
