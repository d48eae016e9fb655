"""Configuration of a link: endpoints, certificates, credentials, deadlines.

Also its choice, by arguments or by the environment, and what belongs to the network that it reaches.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlparse, urlsplit

from ... import settings
from ...safety.network_key import DEVICE_CONNECT, NetworkKey
from ...utils import ValidationError, choice, device_id, port, redacted, shown, text
from ...zenoh_session import transport_config, use_tls

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
INTERNET = ("tcp", "udp", "tls", "quic", "ws")
ZENOH_PORT = 7447

_DOTTED = re.compile(r"[0-9.]+")

# Variables with the URLs of a backend, the first that is set counts.
_URLS_OF = {"nats": ("NATS_URLS", "NATS_URL"), "zenoh": ("ZENOH_CONNECT",)}

# Variables of which any one names a network; without them a link stays on this machine.
_NAMES_A_NETWORK = (
    "MESSAGING_URLS",
    "MESSAGING_CREDENTIALS_FILE",
    "NATS_URL",
    "NATS_URLS",
    "NATS_CREDENTIALS_FILE",
    "ZENOH_CONNECT",
    "ZENOH_LISTEN",
)

DEFAULT_URL = "nats://127.0.0.1:4222"
"""NATS server of a link that names none."""

# Largest message in bytes that a receiver assembles from fragments; Zenoh's own default is 1 GiB.
MAX_MESSAGE_BYTES = 64 * 2**20

# Microseconds that Zenoh waits for a peer that does not read. An event is dropped after a wait that an event loop can
# bear, an event of many fragments, which goes out on a thread, after a longer one. Calls and replies are not dropped:
# they have a queue of their own, which only a peer that stopped reading ever fills, and such a peer loses its link.
WAIT_BEFORE_DROP_US = 500
WAIT_BEFORE_DROP_FRAGMENTS_US = 1_000_000
WAIT_BEFORE_CLOSE_US = 1_000_000


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """One link. Two links that compare equal share one session in the process.

    Args:
        transport: ``zenoh`` or ``nats``.
        mode: Zenoh only: ``peer``, ``client``, or ``auto``, which is a client where ``connect`` names a router
            and a peer where it is empty.
        connect: endpoints to connect to: ``tcp/host:port``, ``tls/host:port``, ``zenoh://host:port``,
            ``nats://host:port``.
        listen: Zenoh peers only: endpoints to listen on.
        meet_port: Zenoh peers only: the loopback port where local peers meet; see ``loopback_config``.
        multicast: Zenoh peers only: find peers by multicast. None: only where no endpoint is given.
        ca, cert, key: PEM text, or the path of a PEM file. With ``ca``, or a NATS URL ``tls://`` or ``wss://``, a link
            speaks TLS alone; ``ca`` takes the place of the system's authorities. With all three it is mutually
            authenticated.
        verify_hostname: check the server's name in its certificate.
        jwt, nkey_seed: NATS credentials.
        tenant: links of two tenants never share a session.
        connect_timeout_s: seconds until ``connect`` gives up.
    """

    transport: str = "zenoh"
    mode: str = "auto"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    meet_port: int | None = None
    multicast: bool | None = None
    ca: str = ""
    cert: str = ""
    key: str = field(default="", repr=False)
    verify_hostname: bool = True
    jwt: str = field(default="", repr=False)
    nkey_seed: str = field(default="", repr=False)
    tenant: str = "default"
    connect_timeout_s: float = 5.0

    def __post_init__(self) -> None:
        choice("transport", self.transport, ("zenoh", "nats"))
        choice("mode", self.mode, ("auto", "peer", "client"))
        # A wildcard here would join the links of all tenants.
        device_id("tenant", self.tenant)
        check = _check_nats if self.transport == "nats" else _check_zenoh
        for name, stated in (("connect", self.connect), ("listen", self.listen)):
            for endpoint in stated:
                check(name, endpoint)
        if self.meet_port is not None:
            port("meet_port", self.meet_port)
        if bool(self.cert) != bool(self.key):
            raise ValidationError("a certificate needs its key and a key its certificate; one of them is missing")
        if self.cert and not self.ca:
            raise ValidationError("a certificate needs ca, the authority that the other side is checked against")
        if bool(self.jwt) != bool(self.nkey_seed):
            raise ValidationError("jwt needs nkey_seed and nkey_seed needs jwt; one of them is missing")

    @property
    def is_peer(self) -> bool:
        """True when this link is a Zenoh peer and no client of a router."""
        return self.transport == "zenoh" and (self.mode == "peer" or (self.mode == "auto" and not self.connect))

    @property
    def encrypted(self) -> bool:
        """True when nothing is sent without TLS."""
        if self.transport == "nats":
            return bool(self.ca) or any(urlsplit(url).scheme in ("tls", "wss") for url in self.connect)
        return bool(self.ca)

    @property
    def identified(self) -> bool:
        """True when this side has a certificate, or credentials for a NATS server."""
        if self.transport == "nats" and not self.cert:
            return bool(self.jwt) or (bool(self.connect) and all(urlsplit(url).username for url in self.connect))
        return bool(self.cert)

    @property
    def authenticated(self) -> bool:
        """True when both sides prove who they are."""
        return self.encrypted and self.identified

    @property
    def loopback_only(self) -> bool:
        """True when the link reaches no other machine and lets none in."""
        if self.is_peer and (self.uses_multicast or not self.listeners):
            return False
        return all(host_of(endpoint) in (LOOPBACK, "localhost", "::1") for endpoint in self.connect + self.listeners)

    @property
    def uses_multicast(self) -> bool:
        """True when peers are looked for by multicast."""
        if self.multicast is None:
            return self.is_peer and not (self.connect or self.listen or self.meet_port)
        return self.is_peer and self.multicast

    @property
    def listeners(self) -> tuple[str, ...]:
        """The endpoints a peer listens on, without the meeting port."""
        if not self.is_peer or self.listen:
            return self.listen
        scheme = "tls" if self.cert else "tcp"
        local = self.meet_port is not None or (
            not self.uses_multicast and all(host_of(endpoint) == LOOPBACK for endpoint in self.connect)
        )
        return (f"{scheme}/{LOOPBACK}:0" if local else f"{scheme}/[::]:0",)

    @property
    def meeting_point(self) -> str | None:
        """The endpoint where local peers meet."""
        if self.meet_port is None:
            return None
        return f"{'tls' if self.cert else 'tcp'}/{LOOPBACK}:{self.meet_port}"

    @property
    def fingerprint(self) -> str:
        """A short name for this link that reveals none of its fields."""
        text = json.dumps([str(getattr(self, each.name)) for each in fields(self)])
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def filled(
        self,
        servers: Sequence[str],
        credentials: Mapping[str, Any] | None,
        tls: Mapping[str, Any] | None,
    ) -> LinkConfig:
        """Return this link, its open fields filled from the arguments of ``connect``."""
        link = self
        if servers and not (link.connect or link.listen or link.meet_port):
            link = replace(link, connect=endpoints(servers))
        if tls and not (link.ca or link.cert):
            parts = _tls_fields(tls)
            link = replace(link, ca=parts["ca"], cert=parts["cert"], key=parts["key"])
        if credentials and not link.jwt and credentials.get("jwt") and credentials.get("nkey_seed"):
            link = replace(link, jwt=credentials["jwt"], nkey_seed=credentials["nkey_seed"])
        return link

    def zenoh(self, *, meet: bool = False) -> dict[str, Any]:
        """Return the configuration that ``zenoh.open`` takes.

        Args:
            meet: listen on the meeting port too; opening then fails where another process has it.
        """
        peer = self.is_peer
        listen = list(self.listeners) + ([self.meeting_point] if meet and self.meeting_point else [])
        connect = list(self.connect) + ([self.meeting_point] if self.meeting_point and not meet else [])
        patience = -1 if peer else max(1, round(self.connect_timeout_s * 1000))
        config: dict[str, Any] = {
            "id": self._session_id(),
            "mode": "peer" if peer else "client",
            "listen": {"endpoints": listen if peer else [], "timeout_ms": 0, "exit_on_failure": True},
            "connect": {
                "endpoints": connect,
                "timeout_ms": patience,
                "exit_on_failure": not peer,
                "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
            },
            # Peers come and go; only a multicast peer gains by waiting for the first one.
            "open": {"return_conditions": {"connect_scouted": self.uses_multicast, "declares": True}},
            "scouting": {
                "multicast": {"enabled": self.uses_multicast, "autoconnect": {"peer": ["router", "peer"]}},
                "gossip": {
                    "enabled": peer,
                    "autoconnect": {"peer": ["router", "peer"]},
                    "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": self._dials_peers()}},
                },
            },
            "transport": transport_config(("data", "interactive_high"), WAIT_BEFORE_DROP_US),
        }
        link = config["transport"]["link"]
        link["tx"]["queue"]["congestion_control"]["drop"]["max_wait_before_drop_fragments"] = (
            WAIT_BEFORE_DROP_FRAGMENTS_US
        )
        link["tx"]["queue"]["congestion_control"]["block"] = {"wait_before_close": WAIT_BEFORE_CLOSE_US}
        link["rx"] = {"max_message_size": MAX_MESSAGE_BYTES}
        if self.ca:
            use_tls(config, ca=self.ca, cert=self.cert, key=self.key, verify_name=self.verify_hostname)
        return config

    def _session_id(self) -> str:
        """Return a fresh Zenoh id, a greater one where no listen endpoint is stated.

        Such a peer may be behind a firewall, and the greater id dials. The last byte counts most.
        """
        return f"51{secrets.token_hex(14)}{'01' if self.listen else 'ff'}"

    def _dials_peers(self) -> str:
        """Return Zenoh's dialling strategy: of two peers only the greater id dials.

        If both dialled, one transport would hold two links. When one of them expires on one side first, the peers
        meet again without their subscriptions, for good (eclipse-zenoh/zenoh issue 2806, open in 1.10). With
        certificates both dial all the same, because a certificate may name the addresses of one side only.
        """
        return "always" if self.ca else "greater-zid"

    def meeting_host(self) -> dict[str, Any]:
        """Return the configuration of a session that only listens on the meeting port."""
        return replace(self, listen=(self.meeting_point or "",), connect=(), meet_port=None, mode="peer").zenoh()


def loopback_config(meet_port: int | None = None, tenant: str = "default") -> LinkConfig:
    """Return a link for any number of processes on this machine.

    They need no configuration: the first process listens on ``meet_port`` (default: ``STRANDS_DC_PORT``), the others
    connect to it and learn of each other there. When the process that has the port goes, another takes it over within
    seconds. A bare agent joins with ``ZENOH_CONNECT=tcp/127.0.0.1:PORT DEVICE_CONNECT_DISCOVERY_MODE=d2d``. Nothing
    leaves the machine.
    """
    meet = settings.integer("STRANDS_DC_PORT") if meet_port is None else meet_port
    return LinkConfig(mode="peer", meet_port=meet, multicast=False, tenant=tenant)


def link_from_environment(
    tenant: str = "default",
    transport: str | None = None,
    credentials_file: str | Path | None = None,
    *,
    alone: bool = False,
) -> LinkConfig:
    """Return the link of the framework's own variables, else a multicast peer.

    Args:
        tenant: the tenant of the credentials where this is the default one.
        transport: that of the environment by default.
        credentials_file: that of the environment by default.
        alone: the credentials file alone counts, and no variable.

    Raises:
        ValidationError: an unknown backend, or a credentials file that cannot be read.
    """
    credentials = _credentials_in(credentials_file)
    backend = transport or (
        settings.raw("MESSAGING_BACKEND") if settings.is_set("MESSAGING_BACKEND") and not alone else ""
    )
    names = () if alone else ("MESSAGING_URLS", *_URLS_OF.get(backend, ("NATS_URL", "ZENOH_CONNECT")))
    urls = _first_set(*names)
    if not backend:
        backend = _backend_of(urls, credentials)
    section = credentials.get(backend) or {}
    if not urls:
        urls = tuple(section.get("urls") or ())
    files = {
        part: "" if alone else settings.raw(f"MESSAGING_TLS_{part.upper()}_FILE") for part in ("ca", "cert", "key")
    }
    from_file = _tls_fields(section.get("tls") or {})
    tls = {part: files[part] or from_file.get(part, "") for part in files}
    return LinkConfig(
        transport=choice("MESSAGING_BACKEND", backend, ("zenoh", "nats")),
        connect=endpoints(urls) if backend == "zenoh" else urls,
        listen=settings.items("ZENOH_LISTEN") if backend == "zenoh" and not alone else (),
        multicast=True if backend == "zenoh" and not urls else None,
        jwt=section.get("jwt", ""),
        nkey_seed=section.get("nkey_seed", ""),
        tenant=tenant if tenant != "default" else str(credentials.get("tenant", tenant)),
        ca=tls["ca"],
        cert=tls["cert"],
        key=tls["key"],
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
        "This transport is not authenticated: either stay on this machine with link=loopback_config(), or opt in with "
        "allow_insecure=True (or DEVICE_CONNECT_ALLOW_INSECURE=true), or give certificates (MESSAGING_TLS_CA_FILE, "
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


def split_urls(stated: Iterable[str]) -> tuple[str, ...]:
    """Return the URLs of values that may each hold several, with commas."""
    return tuple(url for value in stated for each in value.split(",") if (url := each.strip()))


def endpoints(servers: Sequence[str]) -> tuple[str, ...]:
    """Return Zenoh endpoints for the framework's URLs; ``zenoh://`` means none."""
    found = []
    for server in (each.strip() for each in servers):
        scheme, _, rest = server.partition("://")
        if rest and scheme in ("zenoh", "zenoh+tls"):
            url = urlparse(server)
            found.append(f"{'tls' if scheme.endswith('tls') else 'tcp'}/{url.hostname}:{url.port or ZENOH_PORT}")
        elif server and "://" not in server:
            found.append(server if "/" in server else f"tcp/{server}")
        elif rest:
            found.append(server)
    return tuple(found)


def host_of(endpoint: str) -> str:
    """Return the host that an endpoint names, without brackets, credentials and port."""
    address = endpoint.partition("://")[2] or endpoint.partition("/")[2]
    return address.rpartition("@")[2].rpartition(":")[0].strip("[]")


def _check_zenoh(name: str, endpoint: str) -> None:
    """Refuse an endpoint unlike ``tcp/host:port``; serial ports and sockets pass.

    Raises:
        ValidationError: naming ``name``, the value and the domain.
    """
    scheme, slash, rest = endpoint.partition("/")
    if slash and scheme not in INTERNET and not scheme.endswith(":"):
        return
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    host, colon, number = address.rpartition(":")
    if not (slash and colon and _is_host(host) and number.isascii() and number.isdigit() and int(number) <= 65535):
        raise ValidationError(f"{name} must be like tcp/host:port or tls/host:port, not {shown(redacted(endpoint))}.")


def _check_nats(name: str, url: str) -> None:
    """Refuse a URL unlike ``nats://host:port``, of which the port may be left out.

    Raises:
        ValidationError: naming ``name``, the value and the domain.
    """
    try:
        parts = urlsplit(url if "://" in url else f"nats://{url}")
        good = parts.scheme in ("nats", "tls", "ws", "wss") and _is_host(parts.hostname or "") and parts.port != 0
    except ValueError:  # the port is no number
        good = False
    if not good:
        # A URL may carry a password, which must not reach a log.
        raise ValidationError(f"{name} must be like nats://host:port or tls://host:port, not {shown(redacted(url))}.")


def _is_host(host: str) -> bool:
    if _DOTTED.fullmatch(host):
        octets = host.split(".")
        return len(octets) == 4 and all(octet and int(octet) <= 255 for octet in octets)
    return bool(host) and not re.search(r"[\s/]", host)


def _first_set(*names: str) -> tuple[str, ...]:
    for name in names:
        if name and settings.is_set(name):
            return settings.items(name)
    return ()


def _backend_of(urls: Sequence[str], credentials: Mapping[str, Any]) -> str:
    if urls:
        return "nats" if urls[0].startswith(("nats://", "tls://")) else "zenoh"
    return "nats" if "nats" in credentials and "zenoh" not in credentials else "zenoh"


def _credentials_in(stated: str | Path | None) -> dict[str, Any]:
    name = str(stated or "") or settings.raw("MESSAGING_CREDENTIALS_FILE") or settings.raw("NATS_CREDENTIALS_FILE")
    if not name:
        return {}
    try:
        text = Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise ValidationError(f"MESSAGING_CREDENTIALS_FILE={name!r} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValidationError(f"MESSAGING_CREDENTIALS_FILE={name!r} holds no text") from error
    try:
        content = json.loads(text)
    except ValueError:
        content = {"nats": _armoured(text)}
        if content["nats"].keys() < {"jwt", "nkey_seed"}:
            raise ValidationError(
                f"MESSAGING_CREDENTIALS_FILE={name!r} is neither JSON nor a NATS credentials file"
            ) from None
    if not isinstance(content, dict) or not all(isinstance(content.get(k, {}), dict) for k in ("nats", "zenoh")):
        raise ValidationError(
            f"MESSAGING_CREDENTIALS_FILE={name!r} holds no JSON object with objects for nats and zenoh"
        )
    return content


def _armoured(text: str) -> dict[str, str]:
    """Return token and seed of a NATS ``.creds`` file, each between BEGIN and END."""
    blocks: dict[str, str] = {}
    title = ""
    for line in (each.strip() for each in text.splitlines()):
        if "BEGIN" in line:
            title = "jwt" if "JWT" in line else "nkey_seed"
        elif "END" in line:
            title = ""
        elif title and line and not line.startswith("*"):
            blocks[title] = blocks.get(title, "") + line
    return blocks


def _tls_fields(tls: Mapping[str, Any]) -> dict[str, str]:
    return {part: str(tls.get(f"{part}_file") or tls.get(f"{part}_pem") or "") for part in ("ca", "cert", "key")}
