"""The receiving end of a Zenoh subscription: what runs on Zenoh's own threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from device_connect_edge.messaging.base import Subscription

from . import jsonrpc
from .dispatch import CommandDesk, OrderedFeed


class Client(Protocol):
    """What the receiving end needs of its client."""

    def hand_over(self, function: Callable[..., None], *args: Any) -> None:
        """Call ``function(*args)`` on the client's loop; from any thread."""

    def keep(self, query: Any, *, until_answered: bool) -> str:
        """Remember a query until its reply is published; the subject to publish it to. On the loop."""


class Intake:
    """What runs on Zenoh's threads for one subscription: bounds the size, copies, hands over."""

    __slots__ = ("_client", "_desk", "_feed", "_with_subject")

    def __init__(self, client: Client, desk: CommandDesk | None, feed: OrderedFeed | None, with_subject: bool) -> None:
        self._client = client
        self._desk = desk
        self._feed = feed
        self._with_subject = with_subject

    def on_sample(self, sample: Any) -> None:
        """A put on the key."""
        payload = sample.payload
        if self._desk is not None:
            self._client.hand_over(self._command, _bounded(payload), None)
        elif self._feed is not None:
            key = (str(sample.key_expr),) if self._with_subject else ()
            self._client.hand_over(self._feed.accept, payload.to_bytes(), *key, None)

    def on_query(self, query: Any) -> None:
        """A query on the key."""
        payload = query.payload
        if self._desk is not None:
            self._client.hand_over(self._command, b"" if payload is None else _bounded(payload), query)
        else:
            self._client.hand_over(self._question, b"" if payload is None else payload.to_bytes(), query)

    def _command(self, data: bytes | int, query: Any) -> None:
        assert self._desk is not None
        reply = None if query is None else self._client.keep(query, until_answered=True)
        if isinstance(data, int):
            self._desk.refuse(jsonrpc.too_large(data), reply)
        else:
            self._desk.accept(data, reply)

    def _question(self, data: bytes, query: Any) -> None:
        assert self._feed is not None
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


def _bounded(payload: Any) -> bytes | int:
    """The bytes, or how many there are where a command may not have so many."""
    size = len(payload)
    data: bytes | int = payload.to_bytes() if size <= jsonrpc.MAX_COMMAND_BYTES else size
    return data
