"""Device Connect over NATS, on the framework's wire.

A ``nats-py`` client belongs to one event loop and a device's credentials to one device, so each client has a connection
of its own: one descriptor, no thread, some 0.3 MB.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import ssl
import tempfile
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import nats.errors
from device_connect_edge.messaging.exceptions import (
    AuthenticationError,
    MessagingConnectionError,
    NotConnectedError,
    PublishError,
    RequestTimeoutError,
    SubscribeError,
)
from nats.aio.client import Client
from nats.aio.msg import Msg

from . import jsonrpc
from ._compat import EncryptedClient
from .base import Backend, NoResponderError, Undo
from .config import LinkConfig
from .dispatch import REPLY_SUBJECT, CommandServer, OrderedFeed, Throttled

logger = logging.getLogger(__name__)

RECONNECT_WAIT_S = 0.5
"""Seconds between attempts to reach a server that went away."""

DEFAULT_URL = "nats://127.0.0.1:4222"


class NatsBackend(Backend):
    """A messaging client on a NATS connection."""

    def __init__(self, link: LinkConfig, *, open_ended: bool = False) -> None:
        super().__init__(link, open_ended=open_ended)
        self._client = Client()
        self._closing = False
        self._log = Throttled(logger)

    async def connect(
        self,
        servers: list[str],
        credentials: dict[str, Any] | None = None,
        tls_config: dict[str, Any] | None = None,
        reconnect_cb: Callable[[], Awaitable[None]] | None = None,
        disconnect_cb: Callable[[], Awaitable[None]] | None = None,
        **_options: Any,
    ) -> None:
        """Connect, and stay connected: a lost server is tried again for ever.

        Raises:
            AuthenticationError: the server refuses the credentials.
            MessagingConnectionError: no server answered within the link's ``connect_timeout_s``.
        """
        link = self._fill_link(servers, credentials, tls_config)
        options: dict[str, Any] = {}
        if link.jwt:
            options["user_jwt_cb"] = lambda: bytearray(link.jwt.encode())
            options["signature_cb"] = (credentials or {}).get("signature_cb") or partial(_signed, link.nkey_seed)
        if link.encrypted:
            self._client = EncryptedClient()
            options["tls"] = _tls_context(link)
        refused: list[str] = []
        failed: list[str] = []

        async def on_error(error: Exception) -> None:
            (refused if "authorization" in str(error).lower() else failed).append(str(error))
            self._log.warning("NATS: %s", error)

        options |= {
            "servers": list(link.connect) or [DEFAULT_URL],
            "connect_timeout": link.connect_timeout_s,
            "reconnect_time_wait": RECONNECT_WAIT_S,
            "max_reconnect_attempts": -1,
            "disconnected_cb": partial(self._report_link, "lost", disconnect_cb),
            "reconnected_cb": partial(self._report_link, "is back", reconnect_cb),
            "error_cb": on_error,
        }
        where = ", ".join(link.connect) or DEFAULT_URL
        try:
            async with asyncio.timeout(link.connect_timeout_s):
                await self._client.connect(**options)
        except (TimeoutError, OSError, nats.errors.Error) as error:
            await self._abandon()
            reasons = [*failed, *refused]
            reason = reasons[-1] if reasons else str(error) or f"no answer within {link.connect_timeout_s:g} s"
            kind = AuthenticationError if "authorization" in reason.lower() else MessagingConnectionError
            raise kind(f"no NATS connection to {where}: {reason}") from error
        except asyncio.CancelledError:
            await self._abandon()
            raise

    async def publish(self, subject: str, data: bytes) -> None:
        """Send ``data``.

        Raises:
            NotConnectedError: no server at this moment; nothing is kept for later, when it would be stale.
            PublishError: the server would refuse it: too large, or a bad subject; or the caller no longer waits for
                this reply.
        """
        if subject.startswith(REPLY_SUBJECT):
            await self._publish_reply(subject, data)
            return
        if not self._client.is_connected:
            raise NotConnectedError("not connected to NATS")
        if len(data) > self._client.max_payload:
            raise PublishError(
                f"{len(data)} bytes for {subject}: the NATS server takes at most {self._client.max_payload}"
            )
        try:
            await self._client.publish(subject, data)
        except nats.errors.Error as error:
            raise PublishError(f"cannot publish on {subject}: {error}") from error

    async def request(self, subject: str, data: bytes, timeout: float = 5.0) -> bytes:  # noqa: ASYNC109 - the framework's signature
        """Return the first reply to ``data``.

        Raises:
            NoResponderError: no device serves ``subject``.
            RequestTimeoutError: a device does, but gave no reply within ``timeout`` seconds.
            PublishError: the server would refuse the request.
            NotConnectedError: no server at this moment.
        """
        if not self._client.is_connected:
            raise NotConnectedError("not connected to NATS")
        try:
            answer = await self._client.request(subject, data, timeout=timeout)
        except nats.errors.NoRespondersError as error:
            raise NoResponderError(f"no device answers on {subject}") from error
        except (nats.errors.TimeoutError, TimeoutError) as error:
            raise RequestTimeoutError(f"no reply on {subject} within {timeout:g} s") from error
        except nats.errors.Error as error:
            raise PublishError(f"cannot ask {subject}: {error}") from error
        payload: bytes = answer.data
        return payload

    async def flush(self) -> None:
        """Wait until the server has everything published so far."""
        with contextlib.suppress(nats.errors.Error):  # a connection that is lost has nothing to flush
            await self._client.flush(timeout=2)

    async def close(self) -> None:
        """Unsubscribe, send what is pending, and close."""
        self._closing = True
        await self._unsubscribe_all()
        if self._client.is_connected:
            await self.flush()
        # A client that was never connected has nothing to close, and nats-py trips over it.
        if self._client.is_connected or self._client.is_reconnecting:
            await self._client.close()

    @property
    def is_connected(self) -> bool:
        """True while a server is there."""
        return bool(self._client.is_connected)

    @property
    def is_closed(self) -> bool:
        """True after ``close``."""
        return self._closing or bool(self._client.is_closed)

    async def _declare(
        self,
        subject: str,
        queue: str | None,
        consumer: CommandServer | OrderedFeed,
        *,
        answers: bool = True,
        with_subject: bool = False,
    ) -> Undo:
        async def on_message(message: Msg) -> None:
            if isinstance(consumer, CommandServer):
                consumer.receive(message)
            else:
                matched = (message.subject,) if with_subject else ()
                consumer.accept(message.data, *matched, message.reply or None)

        if not self._client.is_connected:
            raise NotConnectedError("not connected to NATS")
        try:
            subscription = await self._client.subscribe(subject, queue=queue or "", cb=on_message)
        except nats.errors.Error as error:
            raise SubscribeError(f"cannot subscribe to {subject}: {error}") from error

        async def unsubscribe() -> None:
            # A closed connection has dropped its subscriptions already.
            with contextlib.suppress(nats.errors.Error):
                await subscription.unsubscribe()

        return unsubscribe

    @staticmethod
    def _read(message: Msg) -> tuple[bytes | int, str | None]:
        return message.data, message.reply or None

    async def _answer(self, reply: str, data: bytes) -> None:
        with contextlib.suppress(PublishError, NotConnectedError):  # the caller is out of reach
            await self.publish(reply, jsonrpc.sendable(data, self._client.max_payload))

    def _call_soon(self, function: Callable[[], None]) -> None:
        asyncio.get_running_loop().call_soon(function)

    async def _report_link(self, what: str, callback: Callable[[], Awaitable[None]] | None) -> None:
        if self._closing:
            return
        logger.log(logging.INFO if what == "is back" else logging.WARNING, "NATS connection %s", what)
        if callback is not None:
            await callback()

    async def _abandon(self) -> None:
        self._closing = True
        await self._client.close()
        # The framework asks this very object again when its connect failed.
        self._client = Client()
        self._closing = False


def _signed(seed: str, nonce: str | bytes) -> bytes:
    """Sign the server's nonce with the seed's key; in base64."""
    import nkeys  # type: ignore[import-untyped]  # noqa: PLC0415 - only credentials need it

    challenge = nonce.encode() if isinstance(nonce, str) else nonce
    return base64.b64encode(nkeys.from_seed(seed.encode()).sign(challenge))


def _tls_context(link: LinkConfig) -> ssl.SSLContext:
    """Return a context that trusts the stated authority alone, else the system's."""
    stated = {"cadata" if link.ca.lstrip().startswith("-----BEGIN") else "cafile": link.ca} if link.ca else {}
    context = ssl.create_default_context(**stated)  # type: ignore[arg-type]  # both keys take text
    context.check_hostname = link.verify_hostname
    if link.cert:
        _load_identity(context, link.cert, link.key)
    return context


def _load_identity(context: ssl.SSLContext, cert: str, key: str) -> None:
    """Load certificate and key, which the standard library reads from files only."""
    if not cert.lstrip().startswith("-----BEGIN"):
        context.load_cert_chain(cert, key)
        return
    with tempfile.TemporaryDirectory(prefix="strands-") as folder:
        both = Path(folder, "identity.pem")
        both.touch(mode=0o600)
        both.write_text(f"{cert}\n{key}\n")
        context.load_cert_chain(both)
