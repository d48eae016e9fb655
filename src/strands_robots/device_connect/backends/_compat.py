"""All uses of private members of ``nats-py`` 2.16.

``tests/device_connect/backends/test_compat.py`` lists these members and fails when one of them changes.
"""

from __future__ import annotations

import nats.errors
from nats.aio.client import Client
from nats.aio.transport import TcpTransport


class EncryptedClient(Client):
    """A NATS client that sends nothing to a server that does not speak TLS.

    nats-py itself encrypts a connection only where the server's INFO asks for it, whatever URL and certificates say.
    """

    def _connect_command(self) -> bytes:
        # The first line that a client sends on each connection, after the handshake where there is one.
        if not self._encrypted:
            if self._transport is not None:
                self._transport.close()  # type: ignore[no-untyped-call]  # nats-py is typed in part
            raise nats.errors.Error("the server does not speak TLS; nothing was sent to it")
        return super()._connect_command()

    @property
    def _encrypted(self) -> bool:
        if isinstance(self._transport, TcpTransport):
            writer = self._transport._io_writer
            return writer is not None and writer.get_extra_info("ssl_object") is not None
        # A WebSocket has its TLS, or none, before the first byte of NATS.
        return self._current_server is not None and self._current_server.uri.scheme == "wss"
