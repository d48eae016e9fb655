"""One id, one device: whoever comes second stays off the network."""

from __future__ import annotations

import asyncio
import json
import logging
from typing import Any

from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.errors import NoResponderError
from strands_robots.device_connect.limits import PRESENCE_WAIT_S, PROBE_EVERY_S, PROBE_TIMEOUT_S, PROBES

logger = logging.getLogger(__name__)


class DuplicateDeviceError(RuntimeError):
    """A device with the wanted id is live on this network and answered."""


async def refuse_duplicate(name: str, link: LinkConfig, messaging: Any) -> None:
    """Raise :class:`DuplicateDeviceError` when a device with this id answers a probe. A ghost does not."""
    taken = await (_announced(name, link, messaging) if link.authenticated else _answers(name, link, messaging))
    if taken:
        raise DuplicateDeviceError(
            f"A device {name!r} is live in tenant {link.tenant!r} and answered; give this one another peer_id."
        )


async def _announced(name: str, link: LinkConfig, messaging: Any) -> bool:
    """Whether a presence of this id comes on a probe: access rules let no device call another one, or itself."""
    heard = asyncio.Event()

    async def on_presence(data: bytes, reply: str | None) -> None:
        if b'"departing"' not in data:
            heard.set()

    root = f"device-connect.{link.tenant}"
    subscription = await messaging.subscribe(f"{root}.{name}.presence", on_presence, subscribe_only=True)
    try:
        await messaging.publish(f"{root}.discovery.probe", b'{"probe": true}')
        async with asyncio.timeout(PRESENCE_WAIT_S):
            return await heard.wait()
    except TimeoutError:
        return False
    finally:
        await subscription.unsubscribe()


async def _answers(name: str, link: LinkConfig, messaging: Any) -> bool:
    """Whether a device of this id answers a call; where nobody serves it, that is known at once."""
    request = {"jsonrpc": "2.0", "id": "probe", "method": "requestRegistration", "params": {}}
    if link.is_peer:
        # At a meeting point peers learn of one another one by one; elsewhere an open link knows who is there.
        messaging.configure_d2d_retry(retries=PROBES if link.meet_port else 1, delay=PROBE_EVERY_S)
    try:
        await messaging.request(
            f"device-connect.{link.tenant}.{name}.cmd", json.dumps(request).encode(), timeout=PROBE_TIMEOUT_S
        )
    except NoResponderError:
        return False
    except MessagingError as exc:
        logger.warning("A device %r is known on this network and does not answer (%s); taking its place.", name, exc)
        return False
    return True
