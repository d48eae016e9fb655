"""The parser of NATS frames that hands messages over without a queue."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nats.aio.client import Client
from nats.errors import ProtocolError

from strands_robots.bounded_json import LONG_MAX, MESSAGE_MAX
from strands_robots.device_connect.backends._compat import HEADERS_MAX, DirectParser, payload_of

OWN, OTHER = 1, 2


class RecordingClient(Client):
    """A client that records what nats-py's own parser gives it."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: list[Any] = []
        self.parser: DirectParser

    async def _process_msg(self, sid: int, subject: bytes, reply: bytes, data: bytes, headers: Any) -> None:
        self.taken.append((sid, subject.decode(), reply.decode(), data, headers))

    async def _process_ping(self) -> None:
        self.taken.append("ping")

    async def _process_pong(self) -> None:
        self.taken.append("pong")

    async def _process_err(self, err_msg: str) -> None:
        self.taken.append(err_msg)
        self.parser.reset()


class FakeSubscription:
    """The number of a subscription."""

    def __init__(self, number: int) -> None:
        self._id = number


def parser() -> tuple[DirectParser, RecordingClient, list[Any]]:
    client, received = RecordingClient(), list[Any]()
    made = client.parser = DirectParser(client)
    subscription: Any = FakeSubscription(OWN)
    made.hand_over(subscription, lambda message: received.append((message.subject, message.reply, payload_of(message))))
    return made, client, received


def framed(sid: int, subject: str, data: bytes, reply: str = "") -> bytes:
    return b"MSG %s %d %s%d\r\n%s\r\n" % (
        subject.encode(),
        sid,
        f"{reply} ".encode() if reply else b"",
        len(data),
        data,
    )


FRAMES = (
    framed(OWN, "a.b", b"one")
    + b"PING\r\n"
    + framed(OWN, "a.c", b"MSG x 1 3\r\nabc\r\n", "_INBOX.1")
    + framed(OTHER, "_INBOX.2", b"answer")
    + b"HMSG a.b 1 _INBOX.3 12 17\r\nNATS/1.0\r\n\r\nhello\r\n"
    + b"HMSG _INBOX.2 2 12 17\r\nNATS/1.0\r\n\r\nhello\r\n"
    + framed(OWN, "a.b", b"")
    + b"+OK\r\nPONG\r\n"
    + framed(OWN, "a.b", bytes(70_000))
)


@given(cuts=st.lists(st.integers(1, len(FRAMES) - 1), max_size=12))
async def test_frames_cut_anywhere_are_handed_over_whole_and_in_order(cuts: list[int]) -> None:
    made, client, received = parser()
    ends = [*sorted(set(cuts)), len(FRAMES)]
    for begin, end in zip([0, *ends], ends, strict=False):
        await made.parse(FRAMES[begin:end])
    texts = [("a.b", "", b"one"), ("a.c", "_INBOX.1", b"MSG x 1 3\r\nabc\r\n"), ("a.b", "_INBOX.3", b"hello")]
    assert received == [*texts, ("a.b", "", b""), ("a.b", "", bytes(70_000))]
    answer = (OTHER, "_INBOX.2", "", b"answer", None)
    assert client.taken == ["ping", answer, (OTHER, "_INBOX.2", "", b"hello", b"NATS/1.0\r\n\r\n"), "pong"]


@pytest.mark.parametrize("chunk", [1000, 32_768, 10_000_000])
async def test_message_that_is_too_long_is_dropped_as_it_arrives_and_its_length_is_told(chunk: int) -> None:
    made, client, received = parser()
    long = bytes(MESSAGE_MAX + 1)
    headers = b"NATS/1.0\r\n" + b"a:b\r\n" * HEADERS_MAX + b"\r\n"
    frames = framed(OWN, "a.b", long, "_INBOX.1") + framed(OWN, "a.b", b"next")
    frames += framed(OTHER, "_INBOX.2", bytes(LONG_MAX + 1)) + framed(OTHER, "_INBOX.2", long)
    frames += b"HMSG _INBOX.2 2 %d %d\r\n%sx\r\n" % (len(headers), len(headers) + 1, headers)
    frames += b"HMSG a.b 1 %d %d\r\n%sx\r\nPING\r\n" % (len(headers), len(headers) + 1, headers)
    most = 0
    for at in range(0, len(frames), chunk):
        await made.parse(frames[at : at + chunk])
        most = max(most, len(made._unread))
    assert received == [("a.b", "_INBOX.1", MESSAGE_MAX + 1), ("a.b", "", b"next"), ("a.b", "", b"x")]
    assert client.taken == [(OTHER, "_INBOX.2", "", long, None), "ping"]
    assert most < MESSAGE_MAX + 2 * chunk


async def test_sink_that_raises_loses_no_message_behind_it(caplog: pytest.LogCaptureFixture) -> None:
    made, _, received = parser()
    subscription: Any = FakeSubscription(3)

    def fail(message: object) -> None:
        raise RuntimeError("a fault")

    made.hand_over(subscription, fail)
    await made.parse(framed(3, "x", b"") + framed(OWN, "a.b", b"next"))
    assert [data for *_, data in received] == [b"next"]
    assert "a message on x was lost" in caplog.text


async def test_what_a_lost_connection_left_is_forgotten() -> None:
    made, _, received = parser()
    await made.parse(framed(OWN, "a.b", b"half")[:-3])
    made.reset()
    await made.parse(b"-ERR 'stale connection'\r\n" + framed(OWN, "a.b", b"of the old one"))
    await made.parse(framed(OWN, "a.b", b"new"))
    assert [data for *_, data in received] == [b"new"]


async def test_subscription_that_ended_is_handed_over_no_more() -> None:
    made, client, received = parser()
    subscription: Any = FakeSubscription(OWN)
    made.forget(subscription)
    await made.parse(framed(OWN, "a.b", b"late"))
    assert not received
    assert client.taken == [(OWN, "a.b", "", b"late", None)]


@pytest.mark.parametrize("subject", [b"a.\xff", b"a.\x0b7", b"a.\x0b\x0b1\x0c", b"\x0b", b"a\x0c1\x0c2\x0c3"])
@pytest.mark.parametrize("number", [OWN, OTHER])
@pytest.mark.parametrize("head", [b"", b"NATS/1.0\r\n\r\n"])
async def test_subject_that_is_no_text_loses_no_message_behind_it(subject: bytes, number: int, head: bytes) -> None:
    made, client, received = parser()
    verb, sizes = (b"HMSG", b"%d %d" % (len(head), len(head) + 3)) if head else (b"MSG", b"3")
    await made.parse(b"%s %s %d %s\r\n%sabc\r\n" % (verb, subject, number, sizes, head) + framed(OWN, "a.b", b"next"))
    assert received == [("a.b", "", b"next")]
    assert client.taken == []


@pytest.mark.parametrize("line", [b"MSG a 1 -3\r\n", b"MSG a\r\n", b"HMSG a 1 b 2 3 x\r\n", b"\r\n", b"NOISE\r\n"])
async def test_another_protocol_is_an_error(line: bytes) -> None:
    made, _, _ = parser()
    with pytest.raises(ProtocolError):
        await made.parse(line)
