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


class _Question:
    """A query on its way: collects replies on Zenoh's thread and tells the loop what it needs to know, once."""

    __slots__ = ("answered", "failure", "future", "inbox")

    def __init__(self, loop: asyncio.AbstractEventLoop, inbox: Inbox) -> None:
        self.failure = ""
        self.inbox = inbox
        self.future: asyncio.Future[bytes | None] = loop.create_future()
        self.answered = False

    def on_reply(self, reply: Any) -> None:
        """On Zenoh's thread."""
        ok = reply.ok
        if ok is None:
            self.failure = reply.err.payload.to_bytes()[:200].decode(errors="replace")
        elif not self.answered:
            self.answered = True
            self.inbox.put(self.settle, ok.payload.to_bytes())

    def on_end(self) -> None:
        """On Zenoh's thread."""
        # An answered question has woken the loop already.
        if not self.answered:
            self.inbox.put(self.settle, None)

    def on_deadline(self) -> None:
        """On the loop."""
        self.failure = "Timeout"
        self.settle(None)

    def settle(self, value: bytes | None) -> None:
        """On the loop."""
        if not self.future.done():
            self.future.set_result(value)


async def ask(session: Any, inbox: Inbox, key: str, data: bytes, wait_s: float, *, of_peers: bool) -> bytes | None:
    """The first reply on ``key`` to ``data``; None when nobody was there to ask.

    Raises:
        RequestTimeoutError: somebody was asked and gave no reply within ``wait_s`` seconds.
        PublishError: the key is none, or the other side refused.
    """
    loop = asyncio.get_running_loop()
    question = _Question(loop, inbox)
    token: Any = zenoh.CancellationToken()
    handler = direct(question.on_reply, question.on_end)
    options = _OPTIONS_OF_A_PEER if of_peers else _OPTIONS
    deadline = loop.call_later(wait_s + _GRACE_S, question.on_deadline)
    try:
        if len(data) < LARGE_BYTES:
            session.get(key, handler, payload=data, timeout=wait_s, cancellation_token=token, **options)
        else:
            get = partial(session.get, key, handler, payload=data, timeout=wait_s, cancellation_token=token, **options)
            await on_a_thread(get)
        answer = await question.future
    except zenoh.ZError as error:
        raise PublishError(f"cannot ask {key}: {error}") from error
    finally:
        deadline.cancel()
        if not question.answered:
            token.cancel()
    if answer is None and question.failure == "Timeout":
        raise RequestTimeoutError(f"no reply on {key} in time")
    if answer is None and question.failure:
        raise PublishError(f"{key} refused: {question.failure}")
    return answer
