"""Access rules of a Zenoh session, and the check of an operator's file of them.

Measured on Zenoh 1.10 with mutual TLS: every name of a subject is taken literally (``"*"`` is no wildcard), a field
that is absent or null restricts nothing, absent ``flows`` are both, a deny wins over every allow, and
``interfaces: ["lo"]`` is every process of the machine.
"""

from __future__ import annotations

import json
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from strands_robots.mesh import topics
from strands_robots.mesh.transport import TransportError

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
