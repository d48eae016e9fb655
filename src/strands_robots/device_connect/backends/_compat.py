"""All uses of private members of ``nats-py`` 2.16.

``tests/device_connect/backends/test_compat.py`` lists these members and fails when one of them changes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import nats.errors
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.aio.transport import TcpTransport
from nats.protocol.parser import Parser

from ...bounded_json import LONG_MAX, MESSAGE_MAX

logger = logging.getLogger(__name__)

HEADERS_MAX = 4096
"""Longest headers that nats-py reads, in bytes: what it puts into them itself is far shorter."""

CRLF = b"\r\n"


@dataclass
class UnreadMsg(Msg):
    """A message without its bytes: there are too many, ``length`` of them."""

    length: int = 0


def payload_of(message: Msg) -> bytes | int:
    """Return the bytes of a message, or their number where they were not read."""
    return message.length if isinstance(message, UnreadMsg) else message.data


class DirectParser(Parser):
    """A parser that hands the messages of some subscriptions over at once.

    nats-py puts each message into a queue and wakes a task for it, which takes a tenth of a millisecond under load: a
    flood fills that queue faster than it empties, and a stop waits behind it. All other frames go nats-py's way, one
    at a time. Headers of messages that are handed over are not read.

    A message that is too long is dropped as it arrives: a sink gets an :class:`UnreadMsg` in its place.

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
        self._skip = 0

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
        skipped = min(self._skip, len(data))
        self._skip -= skipped
        unread += data[skipped:] if skipped else data
        at = 0
        while (end := unread.find(CRLF, at)) >= 0:
            line = bytes(unread[at:end])
            words = line.split(b" ") if line.startswith((b"MSG ", b"HMSG ")) else line.split()
            body = after = end + len(CRLF)
            if words and words[0] in (b"MSG", b"HMSG"):
                size, headers = _lengths(words)
                after += size + len(CRLF)
                sink = self._sinks.get(words[2])
                if too_long := size > MESSAGE_MAX if sink else size > LONG_MAX or headers > HEADERS_MAX:
                    self._skip = max(after - len(unread), 0)
                    after = min(after, len(unread))
                elif len(unread) < after:
                    break
                if too_long or sink or not _is_text(line):
                    self._take(sink, line, words, size if too_long else bytes(unread[body + headers : body + size]))
                else:
                    await super().parse(bytes(unread[at:after]))
            else:
                await super().parse(bytes(unread[at:after]))
            at = after
            if self._unread is not unread:
                return
        del unread[:at]

    def _take(self, sink: Callable[[Msg], None] | None, line: bytes, words: list[bytes], payload: bytes | int) -> None:
        """Hand a message over, unless its subject is no text or it has no sink."""
        if sink is None or not _is_text(line):
            logger.debug("a message was dropped, it is too long or its subject is no text: %r", line[:200])
            return
        reply = words[3].decode() if len(words) == (5 if words[0] == b"MSG" else 6) else ""
        if isinstance(payload, int):
            message: Msg = UnreadMsg(self._client, words[1].decode(), reply, length=payload)
        else:
            message = Msg(self._client, words[1].decode(), reply, payload)
        try:
            sink(message)
        except Exception:
            # The messages behind this one must still be read.
            logger.exception("a message on %s was lost", message.subject)


def _lengths(words: list[bytes]) -> tuple[int, int]:
    """Return the bytes of a message, headers included, and those of its headers.

    Raises:
        nats.errors.ProtocolError: the line does not state them.
    """
    headed = words[0] == b"HMSG"
    if len(words) - headed not in (4, 5) or not words[-1].isdigit():
        raise nats.errors.ProtocolError
    size = int(words[-1])
    if not headed:
        return size, 0
    if not words[-2].isdigit() or int(words[-2]) > size:
        raise nats.errors.ProtocolError
    return size, int(words[-2])


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
