"""Policies by name: built-in ones, and those registered under an entry point."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from strands_robots.moved import getter
from strands_robots.plug_ins import PlugIns, takes
from strands_robots.policies.base import Action, Policy, Ranges
from strands_robots.policies.profiles import Profile, profiles
from strands_robots.utils import ValidationError, alike, shown

__all__ = ["ALIASES", "Action", "Policy", "Ranges", "create_policy", "policy_names", "resolve_provider"]

if not TYPE_CHECKING:  # a package with a __getattr__ has every name for a type checker
    __getattr__ = getter(__name__)

ALIASES = {"lerobot": "lerobot_local"}

_BUILT_IN = {
    "mock": ("strands_robots.policies.base", "MockPolicy"),
    "remote": ("strands_robots.policies.remote", "RemotePolicy"),
    "openpi": ("strands_robots.policies.openpi", "OpenPiPolicy"),
    "groot": ("strands_robots.policies.groot", "GrootPolicy"),
    "lerobot_async": ("strands_robots.policies.lerobot_async", "LeRobotAsyncPolicy"),
    "lerobot_local": ("strands_robots.policies.lerobot_local", "LeRobotPolicy"),
}

PLUG_INS = PlugIns("policy", {*_BUILT_IN, *ALIASES})
"""Each is a callable that takes keyword options and returns a :class:`Policy`."""


def policy_names() -> tuple[str, ...]:
    """Return the names of all providers, then those of the operator's profiles."""
    return (*provider_names(), *profiles())


def provider_names() -> tuple[str, ...]:
    """Return the names of all providers: built-in ones first, then plug-ins."""
    return (*_BUILT_IN, *PLUG_INS.names())


def resolve_provider(provider: object) -> str:
    """Return the registered name of ``provider``, with its alias resolved.

    Raises:
        ValidationError: no such provider; the message names similar ones.
    """
    name = ALIASES.get(provider, provider) if isinstance(provider, str) else ""
    if name in _BUILT_IN or name in (names := policy_names()):
        return name
    similar = alike(str(name), names)
    hint = f" Did you mean {' or '.join(similar)}?" if similar else ""
    raise ValidationError(f"policy_provider must be one of {', '.join(names)}, not {shown(provider)}.{hint}")


def create_policy(provider: str, **options: Any) -> Policy:
    """Make a policy; cheap, because its ``reset`` loads and connects.

    ``policy_port=0`` is the provider's own default.

    Raises:
        ValidationError: no such provider, a port for a provider that takes none, or an option outside its domain.
        MissingExtraError: the provider needs an extra that is not installed.
    """
    name = resolve_provider(provider)
    profile = profiles().get(name)
    if profile is not None:
        return _profiled(profile)
    factory = policy_factory(name)
    if not options.get("policy_port"):
        options.pop("policy_port", None)
    elif not takes(factory, "policy_port"):
        wanted = shown(options["policy_port"])
        raise ValidationError(f"policy_port must be 0 for policy_provider {name}, which asks no server, not {wanted}.")
    try:
        policy = factory(**options)
    except TypeError as exc:
        raise ValidationError(f"policy_provider {name} cannot be made with {shown(sorted(options))}: {exc}.") from exc
    if not isinstance(policy, Policy):
        raise ValidationError(
            f"policy_provider {name} made {shown(policy)}, which lacks uses_cameras, reset, act, interrupt or close."
        )
    return policy


def warm_profiles() -> list[str]:
    """Begin to load the policy of every profile; raise as :func:`create_policy`.

    Returns:
        The profiles that are not loaded yet.
    """
    made = {name: create_policy(name) for name in profiles()}
    return [name for name, policy in made.items() if hasattr(policy, "warm") and policy.warm() is not None]


def _profiled(profile: Profile) -> Policy:
    """Make the policy of a profile, with the options that its provider takes."""
    from strands_robots.policies.profiled import ProfiledPolicy  # noqa: PLC0415 - loaded where profiles are used

    provider = ALIASES.get(profile.provider, profile.provider)
    if provider not in provider_names():
        known = ", ".join(provider_names())
        raise ValidationError(
            f"profile {profile.name}: provider must be one of {known}, not {shown(profile.provider)}."
        )
    factory, address = policy_factory(provider), urlsplit(profile.url)
    offered: dict[str, Any] = {
        "profile": profile,
        "pretrained_name_or_path": profile.checkpoint,
        "device": profile.device,
        "policy_host": address.hostname,
        "policy_port": address.port or 0,
        "deadline_s": profile.deadline_s,
        "reset_deadline_s": profile.first_deadline_s,
        "uses_cameras": bool(profile.cameras),
        "frames": "msgpack" if profile.cameras else "json",
    }
    taken = inspect.signature(factory).parameters
    return ProfiledPolicy(profile, factory(**{key: each for key, each in offered.items() if key in taken and each}))


def policy_factory(name: str) -> Callable[..., Any]:
    """Load the callable that makes policies of a registered name."""
    if name in _BUILT_IN:
        module, attribute = _BUILT_IN[name]
        built_in: Callable[..., Any] = getattr(import_module(module), attribute)
        return built_in
    plug_in = PLUG_INS.get(name)
    if plug_in is None:
        raise ValidationError(f"policy_provider must be one of {', '.join(provider_names())}, not {shown(name)}.")
    return plug_in.load()
