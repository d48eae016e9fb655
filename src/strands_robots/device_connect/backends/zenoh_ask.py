"""One Zenoh query, awaited on an event loop without a thread."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import zenoh
from device_connect_edge.messaging.exceptions import PublishError, RequestTimeoutError

from .dispatch import Inbox
from .sessions import direct
from .threads import on_a_thread

LARGE_BYTES = 2**16
"""From here on, which is more than one batch, a message goes out on a thread: it may wait for room."""

# Zenoh keeps the deadline itself; this many seconds later we stop believing that it will.
_GRACE_S = 0.05

# A queue of its own beside telemetry. Not express: each express message takes a whole batch of that queue.
_OPTIONS = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "consolidation": zenoh.ConsolidationMode.NONE,
}
# A peer's routes may be a moment old: asking all that match, not the best, costs nothing where one matches.
_OPTIONS_OF_A_PEER = {**_OPTIONS, "target": zenoh.QueryTarget.ALL}


class Question:
    """A query on its way: collects replies on Zenoh's thread and tells the loop what it needs to know, once."""

    __slots__ = ("_answered", "_future", "_inbox", "_token", "failure")

    def __init__(self, loop: asyncio.AbstractEventLoop, inbox: Inbox) -> None:
        self.failure = ""
        self._inbox = inbox
        self._future: asyncio.Future[bytes | None] = loop.create_future()
        self._answered = False
        self._token: Any = zenoh.CancellationToken()

    async def ask(self, session: Any, key: str, data: bytes, wait_s: float, *, of_peers: bool) -> bytes | None:
        """The first reply; None when there is none, and then ``failure`` says why unless nobody was asked."""
        deadline = self._future.get_loop().call_later(wait_s + _GRACE_S, self._on_deadline)
        get = partial(
            session.get,
            key,
            direct(self._on_reply, self._on_end),
            payload=data,
            timeout=wait_s,
            cancellation_token=self._token,
            **(_OPTIONS_OF_A_PEER if of_peers else _OPTIONS),
        )
        try:
            if len(data) < LARGE_BYTES:
                get()
            else:
                await on_a_thread(get)
            return await self._future
        finally:
            deadline.cancel()
            if not self._answered:
                self._token.cancel()

    def _on_reply(self, reply: Any) -> None:
        if reply.ok is None:
            self.failure = reply.err.payload.to_bytes()[:200].decode(errors="replace")
        elif not self._answered:
            self._answered = True
            self._inbox.put(self._settle, reply.ok.payload.to_bytes())

    def _on_end(self) -> None:
        # An answered question has woken the loop already.
        if not self._answered:
            self._inbox.put(self._settle, None)

    def _on_deadline(self) -> None:
        self.failure = "Timeout"
        self._settle(None)

    def _settle(self, value: bytes | None) -> None:
        if not self._future.done():
            self._future.set_result(value)


async def ask(session: Any, inbox: Inbox, key: str, data: bytes, wait_s: float, *, of_peers: bool) -> bytes | None:
    """The first reply on ``key`` to ``data``; None when nobody was there to ask.

    Raises:
        RequestTimeoutError: somebody was asked and gave no reply within ``wait_s`` seconds.
        PublishError: the key is none, or the other side refused.
    """
    question = Question(asyncio.get_running_loop(), inbox)
    try:
        answer = await question.ask(session, key, data, wait_s, of_peers=of_peers)
    except zenoh.ZError as error:
        raise PublishError(f"cannot ask {key}: {error}") from error
    if answer is None and question.failure == "Timeout":
        raise RequestTimeoutError(f"no reply on {key} in time")
    if answer is None and question.failure:
        raise PublishError(f"{key} refused: {question.failure}")
    return answer
