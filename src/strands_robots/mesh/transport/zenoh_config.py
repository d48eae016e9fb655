"""The Zenoh configuration of one session, from a posture and the topic table.

Measured on Zenoh 1.10: rules name keys with the namespace in front, and a downsampler keeps one clock for a whole
rule and drops by spacing. So only telemetry is downsampled, where a dropped message is followed by the next one,
and only on the way in, where each link has a clock of its own and a flood starves nobody but its sender.
"""

from __future__ import annotations

import json
from typing import Any

from strands_robots import settings
from strands_robots.mesh import topics
from strands_robots.mesh.transport.base import TransportError
from strands_robots.mesh.transport.posture import Posture

RETRY_MS = 250
LEASE_MS = 4000
HANDSHAKE_MS = 2000
WAIT_BEFORE_DROP_US = 10_000
HOW_TO_ACL = "STRANDS_MESH_ACCEPT_PERMISSIVE_ACL"


def hub(posture: Posture, session: str | None = None) -> dict[str, Any]:
    """A session that listens on the loopback hub's endpoint and fails where somebody else does."""
    found = _base(posture, session)
    found["mode"] = "peer"
    found["listen"] = {"endpoints": [posture.hub], "exit_on_failure": True}
    return found


def child(posture: Posture, session: str | None = None, timeout_ms: int = 1000) -> dict[str, Any]:
    """A client of the loopback hub; opening fails when no hub answers within ``timeout_ms``."""
    found = _base(posture, session)
    found["mode"] = "client"
    found["listen"] = {"endpoints": []}
    found["connect"] = {"endpoints": [posture.hub], "timeout_ms": timeout_ms, "exit_on_failure": True, "retry": _RETRY}
    return found


def explicit(posture: Posture, session: str | None = None) -> dict[str, Any]:
    """A session with the endpoints the operator stated; a listener must bind, a connection may come later.

    It is a router, because of two peers that are connected to a third, Zenoh lets neither hear the other. Like a peer
    it connects to those that gossip tells of, or multicast where that is on. Measured on 1.10 with peers, clients and
    routers on either side.
    """
    found = _base(posture, session)
    found["mode"] = "router"
    for scout in found["scouting"].values():
        scout["autoconnect"] = {role: ["router", "peer"] for role in ("router", "peer")}
    found["listen"] = {"endpoints": list(posture.listen), "exit_on_failure": True}
    backing_off = {**_RETRY, "period_init_ms": 1000, "period_max_ms": 8000, "period_increase_factor": 2}
    found["connect"] = {
        "endpoints": list(posture.connect),
        # Zero would be one attempt and no second.
        "timeout_ms": -1,
        "exit_on_failure": False,
        "retry": backing_off,
    }
    return found


_RETRY = {"period_init_ms": RETRY_MS, "period_max_ms": RETRY_MS, "period_increase_factor": 1}


def _base(posture: Posture, session: str | None) -> dict[str, Any]:
    prefix = f"{posture.namespace}/" if posture.namespace else ""
    # A burst of replies or stops must find room: Zenoh's own queues hold two batches and wait one millisecond.
    queue = {
        "size": {"real_time": 16, "interactive_high": 16, "data": 16},
        "congestion_control": {"drop": {"wait_before_drop": WAIT_BEFORE_DROP_US}},
    }
    link: dict[str, Any] = {"tx": {"lease": LEASE_MS, "queue": queue}}
    config: dict[str, Any] = {
        "scouting": {
            "multicast": {"enabled": posture.multicast},
            "gossip": {"enabled": True},
        },
        "adminspace": {"enabled": False},
        "transport": {
            # A session does not close while it waits for the first word of a far side that is no Zenoh.
            "unicast": {"max_sessions": posture.max_sessions, "open_timeout": HANDSHAKE_MS},
            "link": link,
        },
        "downsampling": _downsampling(prefix),
        "low_pass_filter": _low_pass(prefix),
    }
    if posture.namespace:
        config["namespace"] = posture.namespace
    if session:
        config["id"] = session
    if posture.credentials:
        link["protocols"] = ["tls"]
        link["tls"] = {
            "root_ca_certificate": str(posture.credentials.ca),
            "listen_certificate": str(posture.credentials.cert),
            "listen_private_key": str(posture.credentials.key),
            "connect_certificate": str(posture.credentials.cert),
            "connect_private_key": str(posture.credentials.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        config["access_control"] = access_control(posture, prefix)
    return config


def access_control(posture: Posture, prefix: str) -> dict[str, Any]:
    """The operator's rules, or the table's topics for every holder of a certificate and nothing else.

    Raises:
        TransportError: rules that cannot be read, are switched off, or allow by default without the opt-in.
    """
    if posture.access_control is None:
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {
                    "id": "mesh",
                    "permission": "allow",
                    "messages": list(MESSAGES),
                    "flows": ["ingress", "egress"],
                    "key_exprs": [f"{prefix}{topics.ROOT}/**"],
                }
            ],
            "subjects": [{"id": "certified"}],
            "policies": [{"rules": ["mesh"], "subjects": ["certified"]}],
        }
    rules = _parsed(posture.access_control)
    if rules.get("enabled") is not True:
        raise TransportError("STRANDS_MESH_ACL_FILE: access control must have enabled: true.")
    if rules.get("default_permission") != "deny" and not settings.boolean(HOW_TO_ACL):
        raise TransportError(
            f"STRANDS_MESH_ACL_FILE allows by default; set default_permission to deny, or {HOW_TO_ACL}=true."
        )
    return rules


MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


def _parsed(text: str) -> dict[str, Any]:
    import zenoh  # noqa: PLC0415 - the JSON5 reader is Zenoh's own

    try:
        config = zenoh.Config()
        config.insert_json5("access_control", text)
        rules = json.loads(config.get_json("access_control"))
    except (zenoh.ZError, ValueError) as exc:
        raise TransportError(f"STRANDS_MESH_ACL_FILE is no access control of Zenoh's: {exc}") from None
    return rules if isinstance(rules, dict) else {}


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
