"""From a transport's thread to handlers on an event loop: commands side by side, events in order.

Nothing here knows a transport. All queues are bounded, and a flood costs one log line a second.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

from . import eager, jsonrpc

logger = logging.getLogger(__name__)

MAX_COMMANDS = 256
"""Commands of one device that run at once; the next is answered 'busy'."""

RESERVED_COMMANDS = 64
"""Room besides, for ``stop`` and reads alone, so that they are never behind motion."""

MAX_EVENTS = 65_536
"""Messages of one subscription that wait for its handler; the oldest is dropped for the next."""

MAX_WAITING_BYTES = 64 * 2**20
"""The same in bytes, for commands, too, that arrive while the loop is held up."""

MAX_ARRIVED = 4_096
"""Commands that arrive while the loop is held up; the next is answered 'busy' by the thread that received it."""

# One turn of the loop serves this many messages, then timers and sockets have their turn.
DRAIN_AT_ONCE = 256

Handler = Callable[[bytes, str | None], Awaitable[None]]
"""The framework's: gets a message, and the subject to publish its reply to."""

Serve = Callable[[jsonrpc.Command], Awaitable[bytes]]
"""Carries a command out and gives the encoded reply."""

Relay = Callable[[bytes, Any, jsonrpc.Command], Awaitable[bytes | None]]
"""Hands a command on, as it came, to somebody who replies; the reply that is still owed afterwards, if any."""


def never_behind_motion(method: str) -> bool:
    """True for stops and reads, which find room when motion has filled the rest."""
    return method.startswith(("stop", "get", "list", "describe")) or method in ("emergencyStop", "requestRegistration")


class Throttled:
    """A logger of one line a second; the next line says how many it stands for."""

    def __init__(self, log: logging.Logger, every_s: float = 1.0) -> None:
        self._log = log
        self._every_s = every_s
        self._next = 0.0
        self._left_out = 0

    def warning(self, message: str, *args: object) -> None:
        """One warning, or a count until one is due."""
        now = time.monotonic()
        if now < self._next:
            self._left_out += 1
            return
        more = f" ({self._left_out} more like it were left out)" if self._left_out else ""
        self._next, self._left_out = now + self._every_s, 0
        self._log.warning(message + "%s", *args, more)


class Inbox:
    """Calls from any thread, made on the loop in their order. One wake-up serves all that came meanwhile."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._calls: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._awake = False

    def put(self, function: Callable[..., None], *args: Any) -> None:
        """Have ``function(*args)`` called on the loop soon."""
        self._calls.append((function, args))
        if not self._awake:
            self._awake = True
            # A loop that is closed has nobody left to tell.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        # Lowered before the first call is taken: whoever comes from here on wakes the loop again.
        self._awake = False
        for _ in range(DRAIN_AT_ONCE):
            try:
                function, args = self._calls.popleft()
            except IndexError:
                return
            function(*args)
        if self._calls and not self._awake:
            self._awake = True
            self._loop.call_soon(self._drain)


class CommandDesk:
    """Serves one device's commands, each in a task of its own, so that none waits for another.

    Args:
        subject: for the log.
        relay: carries a command out.
        answer: sends an encoded reply to whoever waits for it; what it returns, if anything, is awaited.
    """

    def __init__(self, subject: str, relay: Relay, answer: Callable[[Any, bytes], Awaitable[None] | None]) -> None:
        self._subject = subject
        self._relay = relay
        self._answer = answer
        self._tasks: set[asyncio.Future[None]] = set()
        self._refusals: set[asyncio.Future[None]] = set()
        self._log = Throttled(logger)

    def accept(self, data: bytes, reply: Any) -> None:
        """Start a command or refuse it at once. On the loop's thread.

        Args:
            data: the command as it came.
            reply: where the answer goes; None where nobody waits for one.
        """
        found = jsonrpc.check(data)
        if isinstance(found, jsonrpc.Command):
            running = len(self._tasks)
            if running < MAX_COMMANDS or (
                running < MAX_COMMANDS + RESERVED_COMMANDS and never_behind_motion(found.method)
            ):
                _track(eager.start(self._serve(data, reply, found)), self._tasks)
                return
            found = jsonrpc.Refusal(jsonrpc.BUSY, f"busy: {running} commands are running", found.id)
        self.refuse(found, reply)

    def refuse(self, refusal: jsonrpc.Refusal, reply: Any) -> None:
        """Answer a message that is no command, when somebody waits for an answer, and log it."""
        self._log.warning("refused a message on %s: %d %s", self._subject, refusal.code, refusal.reason)
        if reply is not None:
            sending = self._answer(reply, refusal.encoded())
            if sending is not None:
                _track(asyncio.ensure_future(sending), self._refusals)

    async def close(self) -> None:
        """Cancel what runs and wait for it."""
        tasks = [task for task in self._tasks | self._refusals if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, data: bytes, reply: Any, command: jsonrpc.Command) -> None:
        try:
            answer = await self._relay(data, reply, command)
        except Exception as problem:
            # Whoever serves catches what is its own; what comes here must still not leave a caller waiting.
            logger.exception("the handler of %s failed", self._subject)
            answer = jsonrpc.error(command.id, jsonrpc.INTERNAL_ERROR, f"{type(problem).__name__} in the device")
        if reply is not None and answer is not None:
            sending = self._answer(reply, answer)
            if sending is not None:
                await sending


def serving(serve: Serve) -> Relay:
    """A relay to somebody who gives the reply."""

    return lambda _data, _reply, command: serve(command)


def relaying(handler: Handler, keep: Callable[[Any], str], owed: Callable[[str], bool]) -> Relay:
    """A relay to a handler that publishes its reply.

    Args:
        handler: gets the command as it came, and the subject to reply to.
        keep: the subject for a caller who waits.
        owed: forgets a subject; True when nothing was published on it.
    """

    async def relay(data: bytes, reply: Any, command: jsonrpc.Command) -> bytes | None:
        if reply is None:
            await handler(data, None)
            return None
        subject, reason, unanswered = keep(reply), "the device gave no answer", False
        try:
            await handler(data, subject)
        except Exception as problem:
            logger.exception("a handler of commands failed")
            reason = f"{type(problem).__name__} in the device"
        finally:
            unanswered = owed(subject)
        return jsonrpc.error(command.id, jsonrpc.INTERNAL_ERROR, reason) if unanswered else None

    return relay


def _track(task: asyncio.Future[None], among: set[asyncio.Future[None]]) -> None:
    among.add(task)
    task.add_done_callback(among.discard)


class Room:
    """How many messages, and how many bytes, may be on their way from a transport's thread to the loop."""

    def __init__(self, messages: int = MAX_ARRIVED, size: int = MAX_WAITING_BYTES) -> None:
        self._messages, self._size = messages, size
        self._lock = threading.Lock()

    def take(self, size: int) -> bool:
        """Room for a message of ``size`` bytes, if there is any; from any thread."""
        with self._lock:
            if self._messages < 1 or self._size < size:
                return False
            self._messages, self._size = self._messages - 1, self._size - size
            return True

    def give_back(self, size: int) -> None:
        """The message has arrived."""
        with self._lock:
            self._messages, self._size = self._messages + 1, self._size + size


class OrderedFeed:
    """Serves one subscription's messages one after another, in the order of their arrival.

    Args:
        subject: for the log.
        handler: called with what ``accept`` was given.
        hand_over: calls a function on the feed's loop; ``accept`` may then be called from any thread.
    """

    def __init__(
        self,
        subject: str,
        handler: Callable[..., Awaitable[None]],
        hand_over: Callable[[Callable[[], None]], None] | None = None,
    ) -> None:
        self._subject = subject
        self._handler = handler
        self._hand_over = hand_over
        self._waiting: deque[tuple[Any, ...]] = deque()
        self._bytes = 0
        self._lock = threading.Lock()
        self._told = False
        self._arrived = asyncio.Event()
        self._log = Throttled(logger)
        self._task = asyncio.ensure_future(self._work())

    def accept(self, *message: Any) -> None:
        """Take a message, whose bytes come first, for the handler."""
        with self._lock:
            self._waiting.append(message)
            self._bytes += len(message[0])
            late = 0
            while len(self._waiting) > MAX_EVENTS or (self._bytes > MAX_WAITING_BYTES and len(self._waiting) > 1):
                self._bytes -= len(self._waiting.popleft()[0])
                late += 1
            told, self._told = self._told, True
        if late:
            self._log.warning("the handler of %s does not keep up; dropped the oldest messages", self._subject)
        if told:
            return
        if self._hand_over is None:
            self._arrived.set()
        else:
            self._hand_over(self._arrived.set)

    async def close(self) -> None:
        """Stop serving; what still waits is dropped."""
        self._task.cancel()
        if self._task is not asyncio.current_task():
            await asyncio.gather(self._task, return_exceptions=True)

    def _next(self) -> tuple[Any, ...] | None:
        with self._lock:
            if not self._waiting:
                self._told = False
                return None
            message = self._waiting.popleft()
            self._bytes -= len(message[0])
            return message

    async def _work(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            served = 0
            while (message := self._next()) is not None:
                try:
                    await self._handler(*message)
                except Exception:
                    logger.exception("the handler of %s failed", self._subject)
                served += 1
                if served % DRAIN_AT_ONCE == 0:
                    await asyncio.sleep(0)
