"""Bounds of policy options from a network: provider, host, checkpoint, targets.

The name of a policy server is resolved once in the life of a process, and the robot connects to the address that was
checked: what the name resolves to later, by rebinding or by a poisoned answer, changes nothing.
"""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

from strands_robots import settings
from strands_robots.policies import provider_names
from strands_robots.policies.profiles import profiles
from strands_robots.safety.authorization import provider_refusal
from strands_robots.serving.workers import UNBOUNDED
from strands_robots.utils import ValidationError, identifier, number, plain_value, shown, text
from strands_robots.verb_parameters import Check

POLICY_HOST_NOT_ALLOWED = "POLICY_HOST_NOT_ALLOWED"
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
ALLOW = "STRANDS_MESH_POLICY_HOST_ALLOW"
RESOLVE_S = 2.0
"""Seconds that a resolver has; a caller waits for no longer."""

FAILED_S = 5.0
"""Seconds in which a name that was not resolved is not asked for again."""

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Resolve = Callable[[str], Sequence[str]]


def _look_up(name: str) -> list[str]:
    found = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(address[0]).partition("%")[0] for *_, address in found))


class PolicyHosts:
    """Checked addresses of the hosts that callers name. Thread-safe.

    Args:
        resolve: returns the addresses of a name. Raises OSError.
        clock: monotonic seconds.
    """

    def __init__(self, resolve: Resolve = _look_up, clock: Callable[[], float] = time.monotonic) -> None:
        self._resolve = resolve
        self._clock = clock
        self._lock = threading.Lock()
        self._resolved: dict[str, tuple[str, ...]] = {}
        self._failed: dict[str, tuple[float, str]] = {}

    def address(self, host: str) -> str:
        """Return the address to connect to for ``host``; ``localhost`` as it is.

        Raises:
            ValidationError: it is not listed, or resolves to nothing or to an address that is not allowed.
        """
        name = host.strip("[]").lower()
        allow = [entry.lower() for entry in settings.items(ALLOW)]
        if name in LOOPBACK_NAMES:
            return host
        try:
            stated = ipaddress.ip_address(name)
        except ValueError:
            stated = None
        if stated is not None and (name in allow or _allowed(stated, allow)):
            return host
        if stated is not None or name not in allow:
            raise _refused(f"must be loopback or listed in {ALLOW}, not {shown(host)}.")
        found = [ipaddress.ip_address(each) for each in self._once(name)]
        bounds = [entry for entry in allow if _is_network(entry)]
        outside = [each for each in found if _reserved(each, bounds) or (bounds and not _allowed(each, bounds))]
        if outside:
            where = f"outside the addresses in {ALLOW}" if bounds else "not the address of a server"
            raise _refused(f"{shown(host)} resolves to {outside[0]}, which is {where}.")
        return str(found[0])

    def _once(self, name: str) -> tuple[str, ...]:
        with self._lock:
            known, now = self._resolved.get(name), self._clock()
            if known is not None:
                return known
            at, why = self._failed.get(name, (float("-inf"), ""))
            if now - at >= FAILED_S:
                # Only names of the operator's list are asked for, so both tables are as short as the list.
                found, why = self._within(name)
                if found:
                    self._resolved[name] = found
                    return found
                self._failed[name] = (self._clock(), why)
        raise _refused(f"{shown(name)} cannot be resolved: {why}.")

    def _within(self, name: str) -> tuple[tuple[str, ...], str]:
        """Resolve on a thread: a resolver may take half a minute, and takes no deadline."""
        try:
            found = tuple(UNBOUNDED.call(partial(self._resolve, name)).result(RESOLVE_S))
        except TimeoutError:
            return (), f"no answer in {RESOLVE_S:g} s"
        except (OSError, UnicodeError) as exc:
            return (), str(exc)
        return found, "it has no address"


def _refused(why: str) -> ValidationError:
    return ValidationError(f"policy_host {why}", POLICY_HOST_NOT_ALLOWED)


def _allowed(address: Address, entries: Sequence[str]) -> bool:
    return address.is_loopback or any(_in_network(address, entry) for entry in entries)


def _reserved(address: Address, bounds: Sequence[str]) -> bool:
    """True for link-local, multicast and the like: no name leads there by chance."""
    strange = address.is_link_local or address.is_multicast or address.is_unspecified or address.is_reserved
    return strange and not any(_in_network(address, entry) for entry in bounds)


def _is_network(entry: str) -> bool:
    try:
        ipaddress.ip_network(entry, strict=False)
    except ValueError:
        return False
    return True


def _in_network(address: Address, entry: str) -> bool:
    if not _is_network(entry):
        return False
    network = ipaddress.ip_network(entry, strict=False)
    return address.version == network.version and address in network


_HOSTS = PolicyHosts()


def policy_hosts() -> PolicyHosts:
    """Return the hosts of this process."""
    return _HOSTS


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

MOCK_REFUSED = (
    "the policy mock plays slow waves and follows no instruction. Name a profile of --policies FILE as "
    "policy_provider; to let mock move real hardware, serve the robot with --allow-mock (STRANDS_ALLOW_MOCK=true)."
)
"""Why the policy ``mock`` may not move real hardware."""


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
    """Make a check of 1 to so many numbers within 1e6, or of exactly so many."""
    domain = f"{'' if exactly else '1 to '}{longest} numbers within 1e6"

    def check(name: str, value: object) -> list[float] | dict[str, float]:
        plain = plain_value(value)
        if isinstance(plain, dict) and not exactly and 0 < len(plain) <= longest:
            return {identifier(name, key): number(name, entry, low=-1e6, high=1e6) for key, entry in plain.items()}
        fits = isinstance(plain, list | tuple) and (longest if exactly else 1) <= len(plain) <= longest
        if not fits:
            raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
        return [number(name, entry, low=-1e6, high=1e6) for entry in plain]

    return check
