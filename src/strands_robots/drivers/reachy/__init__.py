"""Driver of Pollen's Reachy Mini through its daemon, which may announce itself.

Third parties are loaded on use.
"""

from __future__ import annotations

import ipaddress
import re
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from strands_robots import settings
from strands_robots.moved import moved_name
from strands_robots.utils import ValidationError, missing_extra, number

if TYPE_CHECKING:
    from strands_robots.drivers.reachy.driver import ReachyDriver

__all__ = ["DiscoveredDaemon", "ReachyDriver", "discover", "make_reachy"]

SERVICE = "_reachy-mini._tcp.local."
"""The daemon's mDNS service."""


def __getattr__(name: str) -> Any:
    if name == "ReachyDriver":
        from strands_robots.drivers.reachy.driver import ReachyDriver  # noqa: PLC0415 - loaded on use

        return ReachyDriver
    return moved_name(__name__, name)


@dataclass(frozen=True, slots=True)
class DiscoveredDaemon:
    """One announced daemon: its name, an address to dial and the port."""

    name: str
    host: str
    port: int


def discover(within_s: float = 3.0, *, interfaces: Any = None) -> list[DiscoveredDaemon]:
    """Return every Reachy Mini that answers in that time, by name.

    Args:
        within_s: seconds to listen, above 0 and at most 60.
        interfaces: addresses to ask on, all of this machine by default.

    Raises:
        MissingExtraError: the [reachy] extra is not installed.
    """
    try:
        from zeroconf import InterfaceChoice, ServiceBrowser, ServiceStateChange, Zeroconf  # noqa: PLC0415 - optional
    except ImportError as exc:
        raise missing_extra("Finding a Reachy Mini", "reachy") from exc
    wait = number("within_s", within_s, above=0, high=60)
    names: set[str] = set()

    def on_change(zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        del zeroconf, service_type
        if state_change is ServiceStateChange.Added:
            names.add(name)

    with Zeroconf(interfaces=interfaces if interfaces is not None else InterfaceChoice.All) as network:
        browser = ServiceBrowser(network, SERVICE, handlers=[on_change])
        threading.Event().wait(wait)
        browser.cancel()
        infos = [(name, network.get_service_info(SERVICE, name, timeout=500)) for name in sorted(names)]
    return [_discovered(name, info) for name, info in infos if info is not None and info.parsed_addresses()]


def _discovered(name: str, info: Any) -> DiscoveredDaemon:
    # IPv4 before IPv6: a link-local IPv6 address needs a scope that a URL does not carry.
    addresses = sorted(info.parsed_addresses(), key=lambda text: ipaddress.ip_address(text).version)
    return DiscoveredDaemon(name.removesuffix("." + SERVICE), addresses[0], int(info.port))


def _stated(api_port: int) -> tuple[str, int]:
    """Return host and port of the environment; an empty host where it has none."""
    stated = settings.raw("REACHY_HOST")
    if settings.is_set("REACHY_PORT"):
        api_port = settings.integer("REACHY_PORT")
    with_port = re.fullmatch(r"([^:]+|\[.+\]):(\d+)", stated)
    return (with_port[1], int(with_port[2])) if with_port else (stated, api_port)


def make_reachy(
    host: str = "",
    *,
    api_port: int = 8000,
    within_s: float = 3.0,
    driver: type[ReachyDriver] | None = None,
    **options: Any,
) -> ReachyDriver:
    """Return a driver for ``host``, or for the one Reachy Mini that announces itself.

    Args:
        host: bare hostname or IP literal; empty for that of ``REACHY_HOST``, and where that is unset to discover it.
        api_port: TCP port of the daemon, when ``host`` is given.
        within_s: seconds to listen.
        driver: the class to make; :class:`ReachyDriver` by default.
        options: further arguments of :class:`ReachyDriver`.

    Raises:
        ValidationError: none or several were found, or an argument is out of its domain.
    """
    make = driver or __getattr__("ReachyDriver")
    if not host:
        host, api_port = _stated(api_port)
    if host:
        return cast("ReachyDriver", make(host, api_port=api_port, **options))
    daemons = discover(within_s)
    if not daemons:
        raise ValidationError(f"host must name a Reachy Mini: none announced itself within {within_s:g} s.")
    if len(daemons) > 1:
        names = ", ".join(f"{each.name} at {each.host}:{each.port}" for each in daemons)
        raise ValidationError(f"host must name one Reachy Mini; {len(daemons)} were found: {names}.")
    return cast("ReachyDriver", make(daemons[0].host, api_port=daemons[0].port, **options))
