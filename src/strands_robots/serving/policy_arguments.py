"""Bounds of policy options from a network: provider, host, checkpoint, targets."""

from __future__ import annotations

import re
from functools import lru_cache

from strands_robots import settings
from strands_robots.policies import provider_names
from strands_robots.policies.profiles import profiles
from strands_robots.safety.authorization import provider_refusal
from strands_robots.serving.policy_hosts import policy_hosts
from strands_robots.serving.verbs import Check
from strands_robots.utils import ValidationError, identifier, number, shown, text

HF_REPO_NOT_ALLOWED = "HF_REPO_NOT_ALLOWED"
POLICY_TYPE_NOT_ALLOWED = "POLICY_TYPE_NOT_ALLOWED"

BUILT_IN_ORGS = frozenset({"nvidia", "huggingface", "lerobot"})
MOCK = "mock"
PROVIDERS = frozenset({MOCK, "remote", "openpi", "groot", "lerobot_async", "lerobot_local", "lerobot"})
FOREIGN_PROVIDERS = frozenset(
    {"act", "cosmos", "cosmos3", "diffusion", "dreamgen", "dreamzero", "gr00t"}
    | {"openvla", "pi0", "pi05", "pi0_fast", "pi0fast", "rdt", "sac", "smolvla", "sonic", "tdmpc", "vqbet", "wbc"}
)
"""Providers of peers of other builds: they validate, and the robot answers that it has none of the name.

An operator adds a name to the table by ``STRANDS_MESH_POLICY_TYPE_ALLOW``, a plug-in by its entry point.
"""

_REPO = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]{0,95})/([A-Za-z0-9][A-Za-z0-9._-]{0,95})\Z")


def mock_refusal() -> str | None:
    """Return why the policy ``mock`` may not move real hardware, or None."""
    if settings.boolean("STRANDS_ALLOW_MOCK"):
        return None
    return (
        "the policy mock plays slow waves and follows no instruction. Name a profile of --policies FILE "
        "as policy_provider; to let "
        "mock move real hardware, serve the robot with --allow-mock (STRANDS_ALLOW_MOCK=true)."
    )


def profile_list() -> str:
    """Return the operator's profiles for a device's description; empty without any."""
    names = profiles()
    return f"; policies: {', '.join(names)}" if names else ""


@lru_cache(maxsize=1)
def registered_providers() -> tuple[str, ...]:
    """Return this machine's policy providers, read from the disk once."""
    return provider_names()


def known_provider(name: str, value: object) -> str:
    """Check that a provider is known here or listed, and allowed."""
    provider = identifier(name, value)
    allow = settings.items("STRANDS_MESH_POLICY_TYPE_ALLOW")
    if provider not in PROVIDERS and provider not in FOREIGN_PROVIDERS and provider not in allow:
        registered = {*registered_providers(), *profiles()}
        if provider not in registered:
            known = ", ".join(sorted(PROVIDERS | registered))
            raise ValidationError(f"{name} must be one of {known}, not {shown(value)}.", POLICY_TYPE_NOT_ALLOWED)
    refusal = provider_refusal(provider, allow)
    if refusal is not None:
        raise ValidationError(refusal, POLICY_TYPE_NOT_ALLOWED)
    return provider


def policy_host(name: str, value: object) -> str:
    """Return the address of a policy server that callers may name."""
    return policy_hosts().address(text(name, value, longest=253))


def repository(name: str, value: object) -> str:
    """Check a Hub id, ``org/name``, of an allowed organisation; a local path is none."""
    orgs = BUILT_IN_ORGS | set(settings.items("STRANDS_MESH_HF_REPO_ALLOW"))
    found = _REPO.match(value) if isinstance(value, str) else None
    if found is None or ".." in found[0] or found[1] not in orgs:
        raise ValidationError(
            f"{name} must be org/name with an org of {', '.join(sorted(orgs))}, not {shown(value)}.",
            HF_REPO_NOT_ALLOWED,
        )
    return found[0]


def vector(longest: int, *, exactly: bool = False) -> Check:
    """Make a check of at most (or exactly) so many numbers within 1e6."""
    domain = f"{'' if exactly else 'at most '}{longest} numbers within 1e6"

    def check(name: str, value: object) -> list[float] | dict[str, float]:
        if isinstance(value, dict) and not exactly and len(value) <= longest:
            return {identifier(name, key): number(name, entry, low=-1e6, high=1e6) for key, entry in value.items()}
        if not isinstance(value, list) or len(value) > longest or (exactly and len(value) != longest):
            raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
        return [number(name, entry, low=-1e6, high=1e6) for entry in value]

    return check
