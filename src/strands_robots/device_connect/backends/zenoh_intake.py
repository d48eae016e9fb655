"""The receiving end of a Zenoh subscription: what runs on Zenoh's own threads."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Protocol

import zenoh
from device_connect_edge.messaging.base import Subscription

from . import jsonrpc
from .dispatch import CommandDesk, OrderedFeed, Room


class Client(Protocol):
    """What the receiving end needs of its client."""

    def hand_over(self, function: Callable[..., None], *args: Any) -> None:
        """Call ``function(*args)`` on the client's loop; from any thread."""

    def keep(self, query: Any, *, until_answered: bool) -> str:
        """Remember a query until its reply is published; the subject to publish it to. On the loop."""


class Intake:
    """What runs on Zenoh's threads for one subscription: bounds the size, copies, hands over."""

    __slots__ = ("_client", "_desk", "_feed", "_room", "_with_subject")

    def __init__(self, client: Client, desk: CommandDesk | None, feed: OrderedFeed | None, with_subject: bool) -> None:
        self._client = client
        self._desk = desk
        self._feed = feed
        self._with_subject = with_subject
        self._room = Room()

    def on_sample(self, sample: Any) -> None:
        """A put on the key."""
        if self._desk is not None:
            self._hand_over_command(sample.payload, None)
        elif self._feed is not None:
            key = (str(sample.key_expr),) if self._with_subject else ()
            self._feed.accept(sample.payload.to_bytes(), *key, None)

    def on_query(self, query: Any) -> None:
        """A query on the key."""
        if self._desk is not None:
            self._hand_over_command(query.payload, query)
            return
        data = b"" if query.payload is None else query.payload.to_bytes()
        if self._room.take(len(data)):
            self._client.hand_over(self._question, data, query)
        else:
            query.drop()

    def _hand_over_command(self, payload: Any, query: Any) -> None:
        data = b"" if payload is None else _bounded(payload)
        size = 0 if isinstance(data, int) else len(data)
        if self._room.take(size):
            self._client.hand_over(self._command, data, size, query)
        elif query is not None:
            answer_query(query, jsonrpc.error(None, jsonrpc.BUSY, "busy: the device's loop is held up"))

    def _command(self, data: bytes | int, size: int, query: Any) -> None:
        assert self._desk is not None
        self._room.give_back(size)
        if isinstance(data, int):
            self._desk.refuse(jsonrpc.too_large(data), query)
        else:
            self._desk.accept(data, query)

    def _question(self, data: bytes, query: Any) -> None:
        assert self._feed is not None
        self._room.give_back(len(data))
        key = (str(query.key_expr),) if self._with_subject else ()
        self._feed.accept(data, *key, self._client.keep(query, until_answered=False))


class Handle(Subscription):  # type: ignore[misc]  # the framework has no type information
    """A handle that undeclares once."""

    def __init__(
        self,
        undo: list[Callable[[], None]],
        served_by: CommandDesk | OrderedFeed | None,
        forget: Callable[[Handle], None],
    ) -> None:
        self._undo = undo
        self._served_by = served_by
        self._forget = forget

    async def unsubscribe(self) -> None:
        """Stop receiving; cancels what is being served."""
        undo, self._undo = self._undo, []
        for each in undo:
            each()
        served_by, self._served_by = self._served_by, None
        if served_by is not None:
            await served_by.close()
        self._forget(self)


def answer_query(query: Any, data: bytes) -> None:
    """Reply with the caller's own priority and let go of the query, which tells the caller that no more comes."""
    with contextlib.suppress(zenoh.ZError):  # the caller's link is gone; nobody is left to tell
        query.reply(query.key_expr, data)
    query.drop()


def _bounded(payload: Any) -> bytes | int:
    """The bytes, or how many there are where a command may not have so many."""
    size = len(payload)
    data: bytes | int = payload.to_bytes() if size <= jsonrpc.MAX_COMMAND_BYTES else size
    return data
