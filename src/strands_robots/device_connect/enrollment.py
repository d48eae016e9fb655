"""Enrolled robots of a tenant, and the key of the network that a link reaches."""

from __future__ import annotations

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.config import DEFAULT_URL
from strands_robots.safety.identity import EnrolledKeys, of_tenant
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey


def enrolled_robots(link: LinkConfig) -> dict[str, bytes]:
    """Return the enrolled public keys of the link's tenant, by device id.

    Raises:
        KeyFileError, OSError: the enrolled keys cannot be used.
    """
    return of_tenant(EnrolledKeys().load(), link.tenant)


def network_of(link: LinkConfig) -> NetworkKey:
    """Return the key of the network that a link reaches."""
    met = (link.meeting_point,) if link.meeting_point else ()
    listened = [each for each in link.listen if not each.endswith(":0")]
    scouted = ("multicast",) if link.uses_multicast else ()
    default = DEFAULT_URL if link.transport == "nats" else "nowhere"
    stated = [*link.connect, *listened, *met, *scouted] or [default]
    return NetworkKey.of(DEVICE_CONNECT, stated, link.tenant)
