"""Messaging backends for ``device_connect_edge`` over Zenoh and over NATS.

They are wire-compatible with every bare peer and agent. Unlike the framework's own they serve commands concurrently and
bounded, ``stop`` and reads never wait for motion, malformed commands are answered at once, peers may use mutual TLS or
meet without multicast, and all runtimes of a process share one Zenoh session.

A device is served by :class:`strands_robots.device_connect._compat.Runtime`, the framework's runtime on our backend. A
client without a device::

    client = await open_client(loopback_config())
    reply = await client.request("device-connect.default.arm-1.cmd", payload, timeout=5.0)
    await client.close()

A client serves commands by ``await client.serve(subject, serve)``, where ``serve(command, answer)`` gives the encoded
reply (``jsonrpc.result`` or ``jsonrpc.error``) to ``dispatch.send(answer, reply)``.

Links: ``loopback_config()`` needs nothing and stays on this machine; ``link_from_environment()`` reads the framework's
own variables (``ZENOH_CONNECT``, ``NATS_URL``, ``MESSAGING_TLS_*`` ...); ``LinkConfig(...)`` states everything.

A stock ``DeviceRuntime`` may use the backends as well: after ``register()``, ``messaging_backend="strands-zenoh"`` or
``"strands-nats"``; ``register(link)`` returns the name for one particular link.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from .config import LinkConfig, link_from_environment, loopback_config

if TYPE_CHECKING:
    from .base import Backend

__all__ = [
    "LinkConfig",
    "backend_for",
    "link_from_environment",
    "loopback_config",
    "open_client",
    "register",
]


def backend_for(link: LinkConfig, *, open_ended: bool = False) -> Backend:
    """Return an unconnected messaging client for ``link``.

    Args:
        link: what to connect to.
        open_ended: take what the link leaves open from the arguments of ``connect``, as the framework's own do.
    """
    if link.transport == "nats":
        from .nats import NatsBackend  # noqa: PLC0415 - only the transport in use is loaded

        return NatsBackend(link, open_ended=open_ended)
    from .zenoh import ZenohBackend  # noqa: PLC0415 - only the transport in use is loaded

    return ZenohBackend(link, open_ended=open_ended)


def register(link: LinkConfig | None = None) -> str:
    """Register the backends; return the name to give as ``messaging_backend``.

    Args:
        link: with it, the returned name stands for exactly this link. Without it, ``strands-zenoh`` and
            ``strands-nats`` are registered, which take their link from the URLs that ``connect`` gets, and
            ``strands-zenoh`` is returned.
    """
    from device_connect_edge.messaging import register_backend  # noqa: PLC0415 - importing this package stays light

    if link is None:
        for transport in ("zenoh", "nats"):
            register_backend(
                f"strands-{transport}", partial(backend_for, LinkConfig(transport=transport), open_ended=True)
            )
        return "strands-zenoh"
    name = f"strands-{link.transport}-{link.fingerprint}"
    register_backend(name, partial(backend_for, link))
    return name


async def open_client(link: LinkConfig) -> Backend:
    """Return a connected client without a device.

    Raises:
        MessagingConnectionError: the other side did not answer within ``link.connect_timeout_s``.
    """
    client = backend_for(link)
    await client.connect(servers=[])
    return client
