"""Certificates and access rules: ``strands-robots mesh keys init|issue|acl``.

One authority for a fleet, one certificate a peer with the peer's id as its common name, and Zenoh access rules
that let each peer publish under its own name alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from strands_robots import certificates
from strands_robots.certificates import AUTHORITY_DAYS, CA_CERT, CA_KEY, ISSUED_DAYS
from strands_robots.mesh import topics
from strands_robots.mesh.security import validate_peer_id
from strands_robots.mesh.transport.config import MESSAGES, TlsCredentials, allow, deny_by_default
from strands_robots.utils import ValidationError

__all__ = ["CA_CERT", "CA_KEY", "acl", "init", "issue"]


def init(folder: Path, name: str = "strands-robots mesh", days: int = AUTHORITY_DAYS) -> Path:
    """Make the authority; raises as :func:`strands_robots.certificates.init`."""
    return certificates.init(folder, name, days)


def issue(folder: Path, peer_id: str, hosts: Sequence[str] = (), days: int = ISSUED_DAYS) -> TlsCredentials:
    """Make a peer's certificate; raises as :func:`strands_robots.certificates.issue`."""
    return TlsCredentials(folder / CA_CERT, *certificates.issue(folder, validate_peer_id(peer_id), hosts, days))


def acl(
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
    certified = [validate_peer_id(each) for each in dict.fromkeys((*robots, *operators, *through))]
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
