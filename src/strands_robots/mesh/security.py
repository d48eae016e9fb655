"""What a peer may ask for: the bounds of commands and input frames, checked once at the door.

Identifiers and :class:`ValidationError` are :mod:`strands_robots.utils`'s; this module is their documented door on
the mesh, and holds the table of a command's fields. A machine reads ``ValidationError.code``.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from strands_robots import settings
from strands_robots.safety.authorization import provider_refusal
from strands_robots.utils import ValidationError, identifier, mapping, number, port, shown, text, whole

__all__ = [
    "ACTIONS",
    "ValidationError",
    "policy_host_refusal",
    "validate_command",
    "validate_input_frame",
    "validate_mesh_identifier",
    "validate_peer_id",
]

POLICY_HOST_NOT_ALLOWED = "POLICY_HOST_NOT_ALLOWED"
HF_REPO_NOT_ALLOWED = "HF_REPO_NOT_ALLOWED"
POLICY_TYPE_NOT_ALLOWED = "POLICY_TYPE_NOT_ALLOWED"
TELEOP_VALUE_OUT_OF_RANGE = "TELEOP_VALUE_OUT_OF_RANGE"

ACTIONS = (
    "status",
    "stop",
    "features",
    "state",
    "execute",
    "start",
    "step",
    "reset",
    "teleop_status",
    "teleop_receive",
    "teleop_stop",
    "resume",
    "ping",
)
MOTION = frozenset({"execute", "start", "step", "reset", "teleop_receive"})
"""Actions that move metal: the motion gate asks for attribution and the operator's approval."""

CHANGING = MOTION | {"stop", "teleop_stop", "resume"}
"""Actions that change something, each on record. A turn of them is carried out once; one of STOP_FIELDS each time."""

ANSWERED_WHILE_LOCKED = frozenset(
    {"status", "ping", "resume", "stop", "state", "features", "teleop_status", "teleop_stop"}
)

RESERVED_IDS = frozenset({"broadcast", "safety"})
BUILT_IN_ORGS = frozenset({"nvidia", "huggingface", "lerobot"})
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
PROVIDERS = frozenset({"mock", "remote", "lerobot_local", "lerobot"})
PROVIDERS_ELSEWHERE = frozenset(
    {"act", "cosmos", "cosmos3", "diffusion", "dreamgen", "dreamzero", "gr00t", "groot", "lerobot_async", "openpi"}
    | {"openvla", "pi0", "pi05", "pi0_fast", "pi0fast", "rdt", "sac", "smolvla", "sonic", "tdmpc", "vqbet", "wbc"}
)
"""Providers that peers of other builds have: they validate, and the robot answers that it has none of the name.

A name outside the table is added to it by the operator, in ``STRANDS_MESH_POLICY_TYPE_ALLOW``, or by a plug-in.
"""

INPUT_KEYS = 64
INPUT_KEY_CHARACTERS = 64
INPUT_VALUE_ABS = 720.0

_REPO = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]{0,95})/([A-Za-z0-9][A-Za-z0-9._-]{0,95})\Z")

STOP_FIELDS: Mapping[str, frozenset[str]] = {
    "stop": frozenset({"robot_name"}),
    "teleop_stop": frozenset({"source_peer_id", "device_name"}),
}
"""All that is looked at in what only takes energy away: nothing else in the message may keep it from doing so."""

Check = Callable[[str, object], Any]


def validate_mesh_identifier(value: object, name: str = "identifier") -> str:
    """A turn, sender, device or peer named in a message.

    Raises:
        ValidationError: anything but 1 to 128 letters, digits, ``.``, ``_``, ``-``, the first one alphanumeric.
    """
    return identifier(name, value)


def validate_peer_id(value: object) -> str:
    """A peer id: an identifier that is none of the reserved words."""
    peer = identifier("peer_id", value)
    if peer in RESERVED_IDS:
        raise ValidationError(f"peer_id must not be one of {', '.join(sorted(RESERVED_IDS))}, not {shown(value)}.")
    return peer


def validate_command(command: object, *, providers: Sequence[str] | Callable[[], Sequence[str]] = ()) -> dict[str, Any]:
    """The command with defaults filled in and unknown keys dropped.

    Args:
        command: an object with ``action`` and that action's fields.
        providers: policy providers that plug-ins added to the table, or what gives them; asked for a name that is
            in no table of ours.

    A resume's assertion is passed on as it is: whoever checks it counts what it refuses.

    Raises:
        ValidationError: naming the field, the value and its domain.
    """
    given = mapping("command", command)
    action = given.get("action")
    if not isinstance(action, str) or action not in ACTIONS:
        raise ValidationError(f"action must be one of {', '.join(ACTIONS)}, not {shown(action)}.")
    clean: dict[str, Any] = {"action": action}
    if action == "resume":
        return {**clean, "assertion": given.get("assertion")}
    looked_at = STOP_FIELDS.get(action, _FIELDS.keys())
    for name, value in given.items():
        check = _FIELDS.get(name)
        if check is not None and value is not None and name in looked_at:
            clean[name] = check(name, value)
    if action in ("execute", "start"):
        clean["policy_provider"] = _provider(given.get("policy_provider"), providers)
        clean.setdefault("duration", 30.0)
        clean.setdefault("policy_host", "localhost")
    else:
        clean.pop("policy_provider", None)
    if action == "teleop_receive" and "source_peer_id" not in clean:
        raise ValidationError("source_peer_id must name the leader for teleop_receive, not None.")
    return clean


def policy_host_refusal(host: str) -> str | None:
    """Why a policy server's host is not allowed, or None. Nothing is resolved: a name is compared as a name."""
    name = host.strip("[]").lower()
    allow = settings.items("STRANDS_MESH_POLICY_HOST_ALLOW")
    if name in LOOPBACK_NAMES or name in {entry.lower() for entry in allow}:
        return None
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        address = None
    if address is not None and (address.is_loopback or any(_within(address, entry) for entry in allow)):
        return None
    return f"policy_host must be loopback or listed in STRANDS_MESH_POLICY_HOST_ALLOW, not {shown(host)}."


def validate_input_frame(action: object, *, limit: float | None = None) -> dict[str, float]:
    """The action of one input frame as floats by joint.

    Args:
        action: at most 64 keys of at most 64 characters, each a finite number.
        limit: largest magnitude; ``STRANDS_MESH_INPUT_VALUE_ABS`` where None.

    Raises:
        ValidationError: a shape or key out of bounds; code TELEOP_VALUE_OUT_OF_RANGE for a number out of them.
    """
    most = settings.number("STRANDS_MESH_INPUT_VALUE_ABS") if limit is None else limit
    given = mapping("action", action)
    if len(given) > INPUT_KEYS:
        raise ValidationError(f"action must have at most {INPUT_KEYS} keys, not {len(given)}.")
    for key in given:
        if not 1 <= len(key) <= INPUT_KEY_CHARACTERS or not key.isprintable():
            raise ValidationError(f"action keys must be 1 to {INPUT_KEY_CHARACTERS} printable characters: {shown(key)}")
    try:
        return {key: number(key, value, low=-most, high=most) for key, value in given.items()}
    except ValidationError as exc:
        raise ValidationError(str(exc), TELEOP_VALUE_OUT_OF_RANGE) from None


def _provider(value: object, providers: Sequence[str] | Callable[[], Sequence[str]]) -> str:
    name = identifier("policy_provider", value)
    allow = settings.items("STRANDS_MESH_POLICY_TYPE_ALLOW")
    if name not in PROVIDERS and name not in PROVIDERS_ELSEWHERE and name not in allow:
        registered = providers() if callable(providers) else providers
        if name not in registered:
            known = ", ".join(sorted(PROVIDERS | set(registered)))
            raise ValidationError(
                f"policy_provider must be one of {known}, not {shown(value)}.", POLICY_TYPE_NOT_ALLOWED
            )
    refusal = provider_refusal(name, allow)
    if refusal is not None:
        raise ValidationError(refusal, POLICY_TYPE_NOT_ALLOWED)
    return name


def _policy_host(name: str, value: object) -> str:
    host = text(name, value, longest=253)
    refusal = policy_host_refusal(host)
    if refusal is not None:
        raise ValidationError(refusal, POLICY_HOST_NOT_ALLOWED)
    return host


def _repository(name: str, value: object) -> str:
    orgs = BUILT_IN_ORGS | set(settings.items("STRANDS_MESH_HF_REPO_ALLOW"))
    found = _REPO.match(value) if isinstance(value, str) else None
    if found is None or ".." in found[0] or found[1] not in orgs:
        raise ValidationError(
            f"{name} must be org/name with an org of {', '.join(sorted(orgs))}, not {shown(value)}.",
            HF_REPO_NOT_ALLOWED,
        )
    return found[0]


def _vector(longest: int, exactly: bool = False) -> Check:
    domain = f"{'' if exactly else 'at most '}{longest} numbers within 1e6"

    def check(name: str, value: object) -> list[float] | dict[str, float]:
        if isinstance(value, dict) and not exactly and len(value) <= longest:
            return {identifier(name, key): number(name, entry, low=-1e6, high=1e6) for key, entry in value.items()}
        if not isinstance(value, list) or len(value) > longest or (exactly and len(value) != longest):
            raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
        return [number(name, entry, low=-1e6, high=1e6) for entry in value]

    return check


def _within(address: ipaddress.IPv4Address | ipaddress.IPv6Address, entry: str) -> bool:
    try:
        network = ipaddress.ip_network(entry, strict=False)
    except ValueError:
        return False
    return address.version == network.version and address in network


_FIELDS: Mapping[str, Check] = {
    "instruction": lambda name, value: text(name, value, longest=2000),
    "duration": lambda name, value: number(name, value, above=0, high=3600),
    "policy_host": _policy_host,
    "policy_port": port,
    "pretrained_name_or_path": _repository,
    "robot_name": identifier,
    "source_peer_id": identifier,
    "device_name": identifier,
    "target_pose": _vector(7, exactly=True),
    "target_joints": _vector(256),
    "target_velocity": _vector(16),
    "control_frequency": lambda name, value: number(name, value, low=0.1, high=2000),
    "action_horizon": lambda name, value: whole(name, value, low=1, high=10_000),
    "n_steps": lambda name, value: whole(name, value, low=1, high=10_000_000),
    "steps": lambda name, value: whole(name, value, low=1, high=10_000),
}
