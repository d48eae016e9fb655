"""Configuration of a Zenoh session: endpoints, certificates, access rules, rates.

A mesh bound to loopback alone comes up without certificates. Leaving loopback needs mutual TLS, or an opt-in
that says in its name what it is.

Measured on Zenoh 1.10: rules name keys with the namespace in front, and a downsampler keeps one clock for a whole
rule and drops by spacing. So only telemetry is downsampled, where a dropped message is followed by the next one,
and only on the way in, where each link has a clock of its own and a flood starves only its own sender.

Access rules, with mutual TLS: every name of a subject is taken literally (``"*"`` is no wildcard), a field that is
absent or null restricts nothing, absent ``flows`` are both, a deny wins over every allow, and ``interfaces: ["lo"]`` is
every process of the machine.
"""

from __future__ import annotations

import json
import logging
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from strands_robots import certificates, settings
from strands_robots.certificates import AUTHORITY_DAYS, CA_CERT, ISSUED_DAYS
from strands_robots.mesh import topics
from strands_robots.mesh.transport import TransportError
from strands_robots.utils import ValidationError, peer_id
from strands_robots.zenoh_session import LEASE_MS, transport_config, use_tls

ACL_FILE = "STRANDS_MESH_ACL_FILE"
PERMISSIVE_ACL = "STRANDS_MESH_ACCEPT_PERMISSIVE_ACL"
ACL_MAX_BYTES = 256 * 1024
SHOWN = 3
"""Open rules that a message names; the others are counted."""

MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)

MOVING = tuple(topics.BY_NAME[name].pattern for name in ("cmd", "broadcast", "input"))
"""The topics on which a message can move a robot."""

RESTRICTIONS = ("interfaces", "usernames", "link_protocols", "zids")
"""Fields of a subject that no certificate proves."""


def allow(name: str, messages: Iterable[str], flows: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
    """Return one access rule that allows messages on key expressions."""
    return {"id": name, "permission": "allow", "messages": [*messages], "flows": [*flows], "key_exprs": [*keys]}


def deny_by_default(
    rules: list[dict[str, Any]], subjects: list[dict[str, Any]], policies: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return an access control that denies what no rule allows."""
    parts = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **parts}


def certified_peers(prefix: str) -> dict[str, Any]:
    """Return the rules used without a file: every topic for certified peers."""
    rule = allow("mesh", MESSAGES, ["ingress", "egress"], [f"{prefix}{topics.ROOT}/**"])
    return deny_by_default([rule], [{"id": "certified"}], [{"rules": ["mesh"], "subjects": ["certified"]}])


def named_rules(
    robots: Sequence[str],
    operators: Sequence[str] = (),
    relays: Sequence[str] | None = None,
    namespace: str = "strands",
) -> str:
    """Return Zenoh access rules (JSON5) that deny by default.

    Every certified peer receives everything, may stop the fleet and may relay a resume, which only the operator's
    key can have signed. A relay is a peer through which others are connected (the hub); what it forwards arrives
    under its own certificate, so others accept everything from it, and the signatures on the messages say whose
    they are. The relays are the operators where None.

    Raises:
        ValueError: no robot and no operator, or a name that is no peer id.
    """
    through = operators if relays is None else relays
    certified = [peer_id("peer_id", each) for each in dict.fromkeys((*robots, *operators, *through))]
    if not certified:
        raise ValidationError("robots or operators must name at least one peer.")
    prefix = f"{namespace}/{topics.ROOT}" if namespace else topics.ROOT
    receiving = [message for message in MESSAGES if message not in ("put", "delete")]
    rules: list[dict[str, Any]] = [
        allow("hear", receiving, ["ingress", "egress"], [f"{prefix}/**"]),
        allow("be-told", ["put", "delete"], ["egress"], [f"{prefix}/**"]),
        allow("safety", ["put"], ["ingress"], [f"{prefix}/safety/*"]),
        allow("relay", ["put", "delete"], ["ingress"], [f"{prefix}/**"]),
        allow("command", ["put"], ["ingress"], [f"{prefix}/*/cmd", f"{prefix}/broadcast"]),
    ]
    subjects, policies = [], []
    for peer in certified:
        # A certificate speaks for its name, and for what its owner calls NAME__something.
        names = (peer, f"{peer}__$*")
        own = [key for name in names for key in (f"{prefix}/{name}/**", f"{prefix}/*/response/{name}/**")]
        rules.append(allow(f"own-{peer}", ["put", "delete", "liveliness_token"], ["ingress"], own))
        subjects.append({"id": peer, "cert_common_names": [peer]})
        granted = ["hear", "be-told", "safety", f"own-{peer}"]
        granted += [rule for rule, peers in (("command", operators), ("relay", through)) if peer in peers]
        policies.append({"rules": granted, "subjects": [peer]})
    return json.dumps(deny_by_default(rules, subjects, policies), indent=2) + "\n"


def read_rules(path: Path) -> dict[str, Any]:
    """Return the access control in a JSON5 file, as Zenoh reads it.

    Raises:
        TransportError: the file is too large, open to the writes of others, or no access control that is enabled.
    """
    import zenoh  # noqa: PLC0415 - the JSON5 reader is Zenoh's own

    facts = path.stat()
    if facts.st_size > ACL_MAX_BYTES:
        raise TransportError(f"{ACL_FILE}: {path} is above {ACL_MAX_BYTES // 1024} KiB.")
    if stat.S_IMODE(facts.st_mode) & stat.S_IWOTH:
        raise TransportError(f"{ACL_FILE}: everyone may write {path}; run chmod o-w on it.")
    try:
        config = zenoh.Config()
        config.insert_json5("access_control", path.read_text(encoding="utf-8"))
        rules = json.loads(config.get_json("access_control"))
    except (zenoh.ZError, ValueError) as exc:
        raise TransportError(f"{ACL_FILE}: {path} is no access control of Zenoh's: {exc}") from None
    if not isinstance(rules, dict) or rules.get("enabled") is not True:
        raise TransportError(f"{ACL_FILE}: {path} must have enabled: true.")
    return rules


def literal_wildcard(rules: dict[str, Any]) -> str | None:
    """Return the reason why a subject names nobody, or None.

    Zenoh compares names as they are, so that a name with a wildcard is a rule for nobody.
    """
    for subject in rules.get("subjects") or ():
        for field in ("cert_common_names", *RESTRICTIONS):
            for name in subject.get(field) or ():
                if any(sign in str(name) for sign in "*?"):
                    return (
                        f"subject {subject['id']!r} has {field} {name!r}, which Zenoh takes literally, as the name of "
                        "nobody"
                    )
    return None


def open_rules(rules: dict[str, Any], prefix: str) -> list[str]:
    """Return a sentence for each rule that lets an unnamed peer move robots.

    A named peer is one whose certificate a subject lists.

    Args:
        prefix: the namespace and a slash, which stand in front of every topic in a rule.
    """
    import zenoh  # noqa: PLC0415 - key expressions are Zenoh's own

    moving = {f"{prefix}{pattern}": zenoh.KeyExpr(f"{prefix}{pattern}") for pattern in MOVING}
    # Every peer may stop the fleet, and no peer is called safety.
    stops = zenoh.KeyExpr(f"{prefix}{topics.ROOT}/safety/**")
    unnamed = [(rule, subject) for rule, subject in _joined(rules) if not subject.get("cert_common_names")]
    denied = [
        zenoh.KeyExpr(key)
        for rule, subject in unnamed
        if rule["permission"] == "deny" and not any(subject.get(field) for field in RESTRICTIONS)
        for key in rule["key_exprs"]
    ]
    found: dict[str, None] = {}
    if rules.get("default_permission") != "deny" and any(not _includes(denied, key) for key in moving.values()):
        found["default_permission is not deny"] = None
    for rule, subject in unnamed:
        if rule["permission"] != "allow":
            continue
        for text in rule["key_exprs"]:
            key = zenoh.KeyExpr(text)
            if stops.includes(key) or _includes(denied, key):
                continue
            reached = [name for name, topic in moving.items() if key.intersects(topic) and not _includes(denied, topic)]
            if reached:
                found[
                    f"rule {rule['id']!r} ({text}) lets subject {subject['id']!r}{_stated(subject)}, which names no "
                    f"certificate, publish on {', '.join(reached)}"
                ] = None
    return [*found]


def stops_get_in(rules: dict[str, Any], prefix: str) -> bool:
    """Return False where no rule lets an emergency stop of any peer in."""
    import zenoh  # noqa: PLC0415 - key expressions are Zenoh's own

    estop = zenoh.KeyExpr(f"{prefix}{topics.estop()}")
    reaching = [(rule, subject) for rule, subject in _joined(rules) if _includes(rule["key_exprs"], estop)]
    if any(
        rule["permission"] == "deny" and not any(subject.get(field) for field in ("cert_common_names", *RESTRICTIONS))
        for rule, subject in reaching
    ):
        return False
    return rules.get("default_permission") != "deny" or any(rule["permission"] == "allow" for rule, _ in reaching)


def shortened(sentences: list[str]) -> str:
    """Return the first sentences as one, with the number of the others."""
    more = len(sentences) - SHOWN
    return "; ".join(sentences[:SHOWN]) + (f"; and {more} more" if more > 0 else "")


def _joined(rules: dict[str, Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Pair each rule for incoming messages with its subjects."""
    by_id = {rule["id"]: rule for rule in rules.get("rules") or ()}
    subjects = {subject["id"]: subject for subject in rules.get("subjects") or ()}
    for policy in rules.get("policies") or ():
        for rule in (by_id[name] for name in policy["rules"] if name in by_id):
            if "put" in rule["messages"] and "ingress" in (rule["flows"] or ("ingress",)):
                for name in policy["subjects"]:
                    if name in subjects:
                        yield rule, subjects[name]


def _includes(keys: Iterable[Any], other: Any) -> bool:
    import zenoh  # noqa: PLC0415 - key expressions are Zenoh's own

    return any(zenoh.KeyExpr(str(key)).includes(other) for key in keys)


def _stated(subject: dict[str, Any]) -> str:
    stated = [f"{field} {subject[field]}" for field in RESTRICTIONS if subject.get(field)]
    return f" ({', '.join(stated)})" if stated else ""


logger = logging.getLogger(__name__)

KEYS_COMMAND = "strands-robots mesh keys init"
TLS_FILES = ("STRANDS_MESH_TLS_CA", "STRANDS_MESH_TLS_CERT", "STRANDS_MESH_TLS_KEY")

RETRY_MS = 250
WAIT_BEFORE_DROP_US = 10_000
_RETRY = {"period_init_ms": RETRY_MS, "period_max_ms": RETRY_MS, "period_increase_factor": 1}

DISCOVERY_S = 1.1
"""Two heartbeats: within these seconds a peer that is linked to us is in the registry."""

LINK_DISCOVERY_S = 12.0
"""The same where links go to stated endpoints: of two attempts the second may come 8 s after the first."""


@dataclass(frozen=True, slots=True)
class TlsCredentials:
    """The PEM files of mutual TLS for one peer."""

    ca: Path
    cert: Path
    key: Path

    @classmethod
    def from_settings(cls) -> TlsCredentials | None:
        """The three files, checked; None when none of them is stated.

        Raises:
            TransportError: only some are stated, or one is missing, a symbolic link, or a key open to others.
        """
        stated = {name: settings.raw(name) for name in TLS_FILES}
        if not any(stated.values()):
            return None
        missing = [name for name, value in stated.items() if not value]
        if missing:
            raise TransportError(f"mutual TLS needs {', '.join(TLS_FILES)}; {', '.join(missing)} is not set.")
        ca, cert, key = (_plain_file(name, Path(value).expanduser()) for name, value in stated.items())
        if stat.S_IMODE(key.stat().st_mode) & 0o077:
            raise TransportError(f"STRANDS_MESH_TLS_KEY: others may read {key}; run chmod 600 on it.")
        return cls(ca, cert, key)

    def settings(self) -> dict[str, str]:
        """The environment that makes a peer use these files."""
        return {
            "STRANDS_MESH_TLS_CA": str(self.ca),
            "STRANDS_MESH_TLS_CERT": str(self.cert),
            "STRANDS_MESH_TLS_KEY": str(self.key),
        }


def make_authority(folder: Path, name: str = "strands-robots mesh", days: int = AUTHORITY_DAYS) -> Path:
    """Make the authority of a fleet; raises as :func:`strands_robots.certificates.init`."""
    return certificates.init(folder, name, days)


def issue_certificate(folder: Path, peer: str, hosts: Sequence[str] = (), days: int = ISSUED_DAYS) -> TlsCredentials:
    """Make a peer's certificate, whose common name is the peer's id.

    Raises as :func:`strands_robots.certificates.issue`.
    """
    return TlsCredentials(folder / CA_CERT, *certificates.issue(folder, peer_id("peer_id", peer), hosts, days))


@dataclass(frozen=True, slots=True)
class Posture:
    """Configuration of a session.

    Attributes:
        hub: loopback endpoint of the automatic hub; None where endpoints are stated.
        access_control: Zenoh's access rules; None without certificates.
    """

    namespace: str
    connect: tuple[str, ...]
    listen: tuple[str, ...]
    hub: str | None
    credentials: TlsCredentials | None
    access_control: dict[str, Any] | None
    multicast: bool
    max_sessions: int

    @classmethod
    def from_settings(cls) -> Posture:
        """The posture that the environment asks for.

        Raises:
            TransportError: it would leave loopback without certificates and without the opt-in, or a certificate
                file is missing, a link, or a key that others can read, or the access rules are refused.
        """
        connect, listen = stated_endpoints()
        multicast = settings.boolean("STRANDS_MESH_MULTICAST")
        credentials = None if _insecure() else TlsCredentials.from_settings()
        if credentials is None:
            _refuse_to_leave_loopback(connect + listen, multicast)
        if multicast:
            logger.warning("Multicast scouting is on: every Zenoh process on this network learns of this peer.")
        if credentials is None:
            _say_unused()
        namespace, scheme = settings.raw("STRANDS_MESH_NAMESPACE"), "tls" if credentials else "tcp"
        return cls(
            namespace=namespace,
            connect=connect,
            listen=listen,
            hub=None if connect or listen else f"{scheme}/127.0.0.1:{settings.integer('STRANDS_MESH_PORT')}",
            credentials=credentials,
            access_control=_access_control(_prefix(namespace)) if credentials else None,
            multicast=multicast,
            max_sessions=settings.integer("STRANDS_MESH_MAX_SESSIONS"),
        )


def discovery_timeout(default: float) -> float:
    """Seconds to wait for a peer: longer than ``default`` with stated endpoints."""
    return LINK_DISCOVERY_S if any(stated_endpoints()) else default


def stated_endpoints() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the endpoints that the mesh connects to, and those it listens on."""
    own = (settings.items("STRANDS_MESH_CONNECT"), settings.items("STRANDS_MESH_LISTEN"))
    shared = (settings.items("ZENOH_CONNECT"), settings.items("ZENOH_LISTEN"))
    connect, listen = (
        () if stated == (settings.NO_ENDPOINT,) else stated or other for stated, other in zip(own, shared, strict=True)
    )
    return connect, listen


def is_loopback(endpoint: str) -> bool:
    """Return True for an endpoint of this machine, ``tcp/127.0.0.1:7447``."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith(("unix", "vsock")):
        return protocol.startswith("unix")
    host = address.split("#")[0].split("?")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def hub(posture: Posture, session: str | None = None) -> dict[str, Any]:
    """Configure a session that listens as the loopback hub, or fails.

    Hubs that multicast finds on other machines connect to a port of their own; each relays for its machine.
    """
    config = _base(posture, session)
    config["mode"] = "peer"
    outside = [f"{'tls' if posture.credentials else 'tcp'}/0.0.0.0:0"] if posture.multicast else []
    config["listen"] = {"endpoints": [posture.hub, *outside], "exit_on_failure": True}
    return config


def child(posture: Posture, session: str | None = None, timeout_ms: int = 1000) -> dict[str, Any]:
    """Configure a client of the loopback hub; opening fails without a hub."""
    config = _base(posture, session)
    config["mode"] = "client"
    config["listen"] = {"endpoints": []}
    config["connect"] = {"endpoints": [posture.hub], "timeout_ms": timeout_ms, "exit_on_failure": True, "retry": _RETRY}
    return config


def explicit(posture: Posture, session: str | None = None) -> dict[str, Any]:
    """Configure a session with stated endpoints; a connection may come later.

    It is a router, because Zenoh does not forward between two peers that are connected to a third. Like a peer it
    connects to those that gossip tells of, or multicast where that is on. Measured on 1.10 with peers, clients and
    routers on either side.
    """
    config = _base(posture, session)
    config["mode"] = "router"
    for scout in config["scouting"].values():
        scout["autoconnect"] = {role: ["router", "peer"] for role in ("router", "peer")}
    config["listen"] = {"endpoints": list(posture.listen), "exit_on_failure": True}
    config["connect"] = {
        "endpoints": list(posture.connect),
        # Zero would be one attempt and no second.
        "timeout_ms": -1,
        "exit_on_failure": False,
        "retry": {"period_init_ms": 1000, "period_max_ms": 8000, "period_increase_factor": 2},
    }
    return config


def stops_through(posture: Posture) -> tuple[str, ...]:
    """Return endpoints by which a session for stops reaches the others, if any."""
    if posture.hub is not None:
        return (posture.hub,)
    return posture.connect or tuple(_from_here(each) for each in posture.listen if not each.endswith(":0"))


def stops(posture: Posture, session: str) -> dict[str, Any]:
    """Configure the session that carries stops alone.

    It is a client of the hub, of a stated endpoint, or of our own listener: it needs no port then, and stops pass on
    links of their own.
    """
    config = _base(posture, session)
    config["mode"] = "client"
    config["listen"] = {"endpoints": []}
    config["connect"] = {"endpoints": [*stops_through(posture)], "exit_on_failure": True}
    config["scouting"]["multicast"]["enabled"] = False
    return config


def _from_here(endpoint: str) -> str:
    """Return the endpoint at which this machine dials its own listener."""
    address = endpoint.partition("#")[0]
    host, _, port = address.rpartition(":")
    scheme, _, name = host.partition("/")
    local = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}.get(name, name)
    return f"{scheme}/{local}:{port}" + ("#verify_name_on_connect=false" if scheme == "tls" else "")


def _base(posture: Posture, session: str | None) -> dict[str, Any]:
    prefix = _prefix(posture.namespace)
    # A burst of replies or stops must find room.
    transport = transport_config(("real_time", "interactive_high", "data"), WAIT_BEFORE_DROP_US)
    transport["unicast"]["max_sessions"] = posture.max_sessions
    transport["link"]["tx"]["lease"] = LEASE_MS
    config: dict[str, Any] = {
        "scouting": {
            "multicast": {"enabled": posture.multicast},
            "gossip": {"enabled": True},
        },
        "adminspace": {"enabled": False},
        "transport": transport,
        "downsampling": _downsampling(prefix),
        "low_pass_filter": _low_pass(prefix),
    }
    if posture.namespace:
        config["namespace"] = posture.namespace
    if session:
        config["id"] = session
    own = posture.credentials
    if own:
        tls = use_tls(config, ca=str(own.ca), cert=str(own.cert), key=str(own.key))
        tls["close_link_on_expiration"] = True
        config["access_control"] = posture.access_control
    return config


def _prefix(namespace: str) -> str:
    return f"{namespace}/" if namespace else ""


def _downsampling(prefix: str) -> list[dict[str, Any]]:
    rules = [
        {"key_expr": f"{prefix}{topic.pattern}", "freq": float(topic.ceiling_hz)}
        for topic in topics.TABLE
        if topic.ceiling_hz
    ]
    return [{"id": "rates", "messages": ["put"], "flows": ["ingress"], "rules": rules}]


def _low_pass(prefix: str) -> list[dict[str, Any]]:
    # One rule a size, on the way in: each rule costs every message time, and our own are measured before they leave.
    sizes = sorted({topic.max_bytes for topic in topics.TABLE})
    return [
        {
            "id": f"size-{size}",
            "flows": ["ingress"],
            "messages": ["put"],
            "key_exprs": [f"{prefix}{topic.pattern}" for topic in topics.TABLE if topic.max_bytes == size],
            "size_limit": size,
        }
        for size in sizes
    ]


def _insecure() -> bool:
    if settings.boolean("STRANDS_MESH_LOCAL_DEV"):
        return True
    if settings.raw("STRANDS_MESH_AUTH_MODE").lower() != "none":
        return False
    if settings.boolean("STRANDS_MESH_I_KNOW_THIS_IS_INSECURE"):
        return True
    logger.warning(
        "STRANDS_MESH_AUTH_MODE=none is ignored without STRANDS_MESH_I_KNOW_THIS_IS_INSECURE=true; "
        "the mesh stays with mutual TLS."
    )
    return False


def _refuse_to_leave_loopback(endpoints: tuple[str, ...], multicast: bool) -> None:
    outside = [endpoint for endpoint in endpoints if not is_loopback(endpoint)]
    if multicast:
        outside.append("multicast scouting")
    if not outside:
        return
    if _insecure():
        logger.warning("The mesh is open to everyone on the network: %s, without certificates.", ", ".join(outside))
        return
    raise TransportError(
        f"{', '.join(outside)} leaves this machine, and the mesh has no certificates: run '{KEYS_COMMAND}' and set "
        "STRANDS_MESH_TLS_CA, STRANDS_MESH_TLS_CERT and STRANDS_MESH_TLS_KEY."
    )


def _plain_file(name: str, path: Path) -> Path:
    if path.is_symlink():
        raise TransportError(f"{name}: {path} is a symbolic link; name the file itself.")
    if not path.is_file():
        raise TransportError(f"{name}: there is no file {path}.")
    return path


def _access_control(prefix: str) -> dict[str, Any]:
    """The operator's rules, or by default every topic for certified peers.

    Raises:
        TransportError: rules that cannot be read, are switched off or name nobody, or that let a peer command which no
            certificate names, without the opt-in.
    """
    stated = settings.raw(ACL_FILE)
    if not stated:
        logger.info("%s is not set: every peer with a certificate of the fleet may send commands.", ACL_FILE)
        return certified_peers(prefix)
    path = _plain_file(ACL_FILE, Path(stated).expanduser())
    rules = read_rules(path)
    dead, opened = literal_wildcard(rules), open_rules(rules, prefix)
    if dead is not None:
        raise TransportError(f"{ACL_FILE}: in {path} {dead}; leave the field out, or name each.")
    if opened and not settings.boolean(PERMISSIVE_ACL):
        raise TransportError(
            f"{ACL_FILE}: in {path} {shortened(opened)}. Deny by default and name who may command in "
            f"cert_common_names ('strands-robots mesh keys acl' writes such rules) or set {PERMISSIVE_ACL}=true."
        )
    if opened:
        logger.warning("%s: in %s %s; accepted by %s.", ACL_FILE, path, shortened(opened), PERMISSIVE_ACL)
    if not stops_get_in(rules, prefix):
        logger.warning("%s: in %s no rule lets an emergency stop in; none over the mesh stops.", ACL_FILE, path)
    return rules


def _say_unused() -> None:
    """Log the certificates and rules that are stated and have no effect."""
    unused = [name for name in (*TLS_FILES, ACL_FILE) if settings.raw(name)]
    if unused:
        logger.warning("The mesh is without certificates, so that %s has no effect.", ", ".join(unused))
