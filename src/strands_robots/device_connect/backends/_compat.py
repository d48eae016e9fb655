"""All uses of private members of ``nats-py`` 2.16.

``tests/device_connect/backends/test_compat.py`` lists these members and fails when one of them changes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import nats.errors
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.aio.transport import TcpTransport
from nats.protocol.parser import Parser

logger = logging.getLogger(__name__)

CRLF = b"\r\n"


class DirectParser(Parser):
    """A parser that hands the messages of some subscriptions over at once.

    nats-py puts each message into a queue and wakes a task for it, which takes a tenth of a millisecond under load: a
    flood fills that queue faster than it empties, and a stop waits behind it. All other frames, and messages with
    headers, go nats-py's way, one at a time.

    The server forwards a subject of any bytes but space, tab and line ends. nats-py ends its reading at one that is no
    text, so whoever may publish could silence a connection; such a message is dropped here.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._sinks: dict[bytes, Callable[[Msg], None]] = {}
        super().__init__(client)

    def reset(self) -> None:
        """Forget what was read of a connection that is gone."""
        super().reset()
        self._unread = bytearray()

    def hand_over(self, subscription: Subscription, sink: Callable[[Msg], None]) -> None:
        """Have ``sink`` called on the loop for each message; it returns at once."""
        self._sinks[b"%d" % subscription._id] = sink

    def forget(self, subscription: Subscription) -> None:
        """Hand nothing over any more."""
        self._sinks.pop(b"%d" % subscription._id, None)

    async def parse(self, data: bytes = b"") -> None:
        """Take the frames that are complete; keep the rest for the next read.

        Raises:
            nats.errors.ProtocolError: the server speaks another protocol.
        """
        unread = self._unread
        unread += data
        at = 0
        while (end := unread.find(CRLF, at)) >= 0:
            line = bytes(unread[at:end])
            words = line.split(b" ") if line.startswith((b"MSG ", b"HMSG ")) else line.split()
            body = end + len(CRLF)
            after = body
            if words and words[0] in (b"MSG", b"HMSG"):
                if len(words) not in (4, 5, 6) or not words[-1].isdigit():
                    raise nats.errors.ProtocolError
                after = body + int(words[-1]) + len(CRLF)
                if len(unread) < after:
                    break
            sink = self._sinks.get(words[2]) if words and words[0] == b"MSG" else None
            if after > body and not _is_text(line):
                logger.debug("a message was dropped, its subject is no text: %r", line[:200])
            elif sink is not None:
                reply = words[3].decode() if len(words) == 5 else ""
                message = Msg(self._client, words[1].decode(), reply, bytes(unread[body : after - len(CRLF)]))
                try:
                    sink(message)
                except Exception:
                    # The messages behind this one must still be read.
                    logger.exception("a message on %s was lost", message.subject)
            else:
                await super().parse(bytes(unread[at:after]))
            at = after
            if self._unread is not unread:
                return
        del unread[:at]


def _is_text(line: bytes) -> bool:
    """Return True when nats-py can read the words of a message's line."""
    try:
        line.decode()
    except UnicodeDecodeError:
        return False
    return len(line.split()) == line.count(b" ") + 1


def direct_parser(client: Client) -> DirectParser:
    """Have ``client`` read by a :class:`DirectParser`; before it connects."""
    client._ps = parser = DirectParser(client)
    return parser


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
