"""Hand-over from a transport's thread to handlers on an event loop.

This module knows no transport. All queues are bounded, and a flood costs one log line a second.
"""

from __future__ import annotations

import asyncio
import contextvars
import itertools
import logging
import math
import sys
import threading
import time

# Documented under "Extending asyncio": how a task says that it is the one that runs.
from asyncio.tasks import _enter_task, _leave_task
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Generator
from functools import partial
from typing import Any

from ... import bounded_json
from ...rate_limits import RateLimiter
from . import jsonrpc

logger = logging.getLogger(__name__)

MAX_COMMANDS = 256
"""Commands of one device that run at once; the next is answered 'busy'."""

RESERVED_COMMANDS = 64
"""Capacity besides, for ``stop`` and reads alone, so that they never wait for motion."""

MAX_EVENTS = 65_536
"""Messages of one subscription that wait for its handler; the oldest is dropped for the next."""

MAX_WAITING_BYTES = 64 * 2**20
"""The same in bytes, for commands, too, that arrive while the loop is held up."""

MAX_ARRIVED = 4_096
"""Commands that arrive while the loop is held up; the next is answered 'busy' by the thread that received it."""

# One turn of the loop serves this many messages, then timers and sockets have their turn.
DRAIN_AT_ONCE = 256

REPLY_SUBJECT = "_strands_reply/"
"""Start of the subjects on which handlers publish their replies."""

Handler = Callable[[bytes, str | None], Awaitable[None]]
"""The framework's: gets a message, and the subject to publish its reply to."""

Answer = Callable[[bytes], Awaitable[None] | None]
"""Sends an encoded reply to one caller; what it returns, if anything, is awaited."""

Serve = Callable[[jsonrpc.RpcRequest, Answer | None], Coroutine[Any, Any, None]]
"""Carries a command out and answers it; there is no answer where no caller waits for one."""

CallSoon = Callable[[Callable[[], None]], object]
"""Has a function called on the loop soon."""


class Throttled:
    """A logger of one line a second; the next line says how many it stands for."""

    def __init__(self, log: logging.Logger, every_s: float = 1.0) -> None:
        self._log = log
        self._every_s = every_s
        self._next = 0.0
        self._left_out = 0

    def warning(self, message: str, *args: object) -> None:
        """Log one warning, or count it until one is due."""
        now = time.monotonic()
        if now < self._next:
            self._left_out += 1
            return
        more = f" ({self._left_out} more like it were left out)" if self._left_out else ""
        self._next, self._left_out = now + self._every_s, 0
        self._log.warning(message + "%s", *args, more)


class Backlog:
    """A bounded queue from any thread to one loop, with one wake-up for a batch.

    Args:
        wake: called by the thread that puts the first message of a batch.
        messages, size: how many messages, and how many bytes of them, may wait.
    """

    def __init__(self, wake: Callable[[], object], messages: float = math.inf, size: float = math.inf) -> None:
        self._wake = wake
        self._messages, self._size = messages, size
        self._waiting: deque[tuple[Any, int]] = deque()
        self._bytes = 0
        self._awake = False
        self._lock = threading.Lock()

    def offer(self, message: Any, size: int = 0) -> bool:
        """Add a message of ``size`` bytes; False at capacity."""
        with self._lock:
            if len(self._waiting) >= self._messages or self._bytes + size > self._size:
                return False
            asleep = self._add(message, size)
        if asleep:
            self._wake()
        return True

    def push(self, message: Any, size: int = 0) -> int:
        """Add a message; return the number of oldest ones dropped for it."""
        dropped = 0
        with self._lock:
            asleep = self._add(message, size)
            while len(self._waiting) > self._messages or (self._bytes > self._size and len(self._waiting) > 1):
                self._bytes -= self._waiting.popleft()[1]
                dropped += 1
        if asleep:
            self._wake()
        return dropped

    def take(self) -> Any:
        """Remove and return the oldest message; without one, None, and wake up again."""
        with self._lock:
            if not self._waiting:
                self._awake = False
                return None
            message, size = self._waiting.popleft()
            self._bytes -= size
            return message

    def _add(self, message: Any, size: int) -> bool:
        self._waiting.append((message, size))
        self._bytes += size
        asleep, self._awake = not self._awake, True
        return asleep


class Fanout:
    """One subscription on the network and the sinks that share it."""

    __slots__ = ("sinks", "subscription")

    def __init__(self) -> None:
        self.sinks: tuple[Callable[[Any], None], ...] = ()
        self.subscription: Any = None

    def deliver(self, message: Any) -> None:
        """Hand a message to every sink."""
        for sink in self.sinks:
            sink(message)


class CommandServer:
    """Serves one device's commands, each in a task of its own.

    Args:
        subject: for the log.
        serve: carries a command out and answers it.
        read: splits a transport's message into its bytes (or their number, where a command may not have so many) and
            the place its reply goes to, None where no caller waits.
        answer: sends an encoded reply there. What it returns has to be awaited on the loop; a short reply that is
            sent from another thread returns nothing.
        call_soon: has a function called on the loop; from any thread.
    """

    def __init__(
        self,
        subject: str,
        serve: Serve,
        read: Callable[[Any], tuple[bytes | int, Any]],
        answer: Callable[[Any, bytes], Awaitable[None] | None],
        call_soon: CallSoon,
    ) -> None:
        self._subject = subject
        self._serve = serve
        self._read = read
        self._answer = answer
        self._wake = partial(call_soon, self._drain)
        self._backlog = Backlog(self._wake, MAX_ARRIVED, MAX_WAITING_BYTES)
        self._running: set[asyncio.Future[None]] = set()
        self._sending: set[asyncio.Future[None]] = set()
        self._log = Throttled(logger)
        self._closed = False

    def receive(self, message: Any) -> None:
        """Queue a message, or answer 'busy' at capacity. On the receiving thread."""
        data, reply = self._read(message)
        size = 0 if isinstance(data, int) else len(data)
        if not self._backlog.offer((data, reply), size) and reply is not None:
            self._send(reply, jsonrpc.error(None, jsonrpc.BUSY, "busy: the device's loop is held up"))

    def _drain(self) -> None:
        """Start the commands that arrived, or refuse them. On the loop."""
        for _ in range(DRAIN_AT_ONCE):
            arrived = self._backlog.take()
            if arrived is None or self._closed:
                return
            data, reply = arrived
            try:
                command = self._admitted(data)
                if isinstance(command, jsonrpc.Refusal):
                    self._log.warning("refused a message on %s: %d %s", self._subject, command.code, command.reason)
                    if reply is not None:
                        self._send(reply, command.encoded())
                    continue
                task = start_now(self._serve(command, None if reply is None else partial(self._answer, reply)))
                self._running.add(task)
                task.add_done_callback(partial(self._finished, command, reply))
            except Exception:
                # The commands behind this one must still be served.
                logger.exception("a message on %s was lost", self._subject)
        self._wake()

    async def close(self) -> None:
        """Cancel what runs and wait for it; commands that still wait are dropped."""
        self._closed = True
        tasks = [task for task in self._running | self._sending if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.gather(*tasks, return_exceptions=True)

    def _admitted(self, data: bytes | int) -> jsonrpc.RpcRequest | jsonrpc.Refusal:
        command = jsonrpc.too_large(data) if isinstance(data, int) else jsonrpc.check(data)
        running = len(self._running)
        if running < MAX_COMMANDS or isinstance(command, jsonrpc.Refusal):
            return command
        if running < MAX_COMMANDS + RESERVED_COMMANDS and reserved(command.method):
            return command
        return jsonrpc.Refusal(jsonrpc.BUSY, f"busy: {running} commands are running", command.id)

    def _finished(self, command: jsonrpc.RpcRequest, reply: Any, task: asyncio.Future[None]) -> None:
        self._running.discard(task)
        problem = None if task.cancelled() else task.exception()
        if problem is not None:
            # ``serve`` answers its own failures; any other one must still not leave a caller waiting.
            logger.error("the handler of %s failed", self._subject, exc_info=problem)
            if reply is not None:
                self._send(reply, _failure(command, problem))

    def _send(self, reply: Any, data: bytes) -> None:
        sending = self._answer(reply, data)
        if sending is not None:
            task = asyncio.ensure_future(sending)
            self._sending.add(task)
            task.add_done_callback(self._sending.discard)


class PendingReplies:
    """Replies that handlers owe, by the subject on which they publish them."""

    def __init__(self) -> None:
        self._answers: dict[str, tuple[Answer, float]] = {}
        self._numbers = itertools.count()
        self._lock = threading.Lock()

    @property
    def full(self) -> bool:
        """True while so many replies are owed that no further one should be."""
        return len(self._answers) >= MAX_ARRIVED

    def expect(self, answer: Answer, within_s: float = math.inf) -> str:
        """Keep an answer for ``within_s`` seconds; return its subject. Any thread."""
        subject, now = f"{REPLY_SUBJECT}{next(self._numbers)}", time.monotonic()
        with self._lock:
            if within_s < math.inf:
                for old in [each for each, (_, until) in self._answers.items() if until < now]:
                    del self._answers[old]
            self._answers[subject] = answer, now + within_s
        return subject

    def take(self, subject: str) -> Answer | None:
        """Remove and return an answer; None when it was used or has expired."""
        with self._lock:
            return self._answers.pop(subject, (None, 0.0))[0]

    def clear(self) -> None:
        """Give up all callers."""
        with self._lock:
            self._answers.clear()


def relaying(handler: Handler, replies: PendingReplies) -> Serve:
    """Serve commands by a handler that publishes its reply, else by an error."""

    async def relay(command: jsonrpc.RpcRequest, answer: Answer | None) -> None:
        if answer is None:
            await handler(command.data, None)
            return
        subject, failure = replies.expect(answer), _failure(command, None)
        try:
            await handler(command.data, subject)
        except Exception as problem:
            logger.exception("a handler of commands failed")
            failure = _failure(command, problem)
        finally:
            unanswered = replies.take(subject) is not None
        if unanswered:
            await send(answer, failure)

    return relay


async def send(answer: Answer | None, data: bytes) -> None:
    """Send a reply where a caller waits for one."""
    sending = None if answer is None else answer(data)
    if sending is not None:
        await sending


def reserved(method: str) -> bool:
    """Return True for stops and reads, which have reserved capacity."""
    return method.startswith(("stop", "get", "list", "describe")) or method in ("emergencyStop", "requestRegistration")


def _failure(command: jsonrpc.RpcRequest, problem: BaseException | None) -> bytes:
    reason = "the device gave no answer" if problem is None else f"{type(problem).__name__} in the device"
    return jsonrpc.error(command.id, jsonrpc.INTERNAL_ERROR, reason)


class OrderedFeed:
    """Serves one subscription's messages one by one, in order of arrival.

    Args:
        subject: for the log.
        handler: called with what ``accept`` was given.
        call_soon: has a function called on the feed's loop; ``accept`` may be called from the threads that it may.
        per_s: how many messages are taken in a second; those beyond are dropped at once.
        longest: the longest message that is taken, in bytes.
        unread: gives what the handler is called with in place of a message of so many bytes; None drops it.
    """

    def __init__(
        self,
        subject: str,
        handler: Callable[..., Awaitable[None]],
        call_soon: CallSoon,
        *,
        per_s: float = math.inf,
        longest: int = bounded_json.MESSAGE_MAX,
        unread: Callable[[int], bytes | int | None] = lambda size: None,
    ) -> None:
        self._subject = subject
        self._handler = handler
        self.longest = longest
        self._unread = unread
        self._arrived = asyncio.Event()
        self._backlog = Backlog(partial(call_soon, self._arrived.set), MAX_EVENTS, MAX_WAITING_BYTES)
        self._limit = RateLimiter(per_s, burst=per_s) if per_s < math.inf else None
        self._log = Throttled(logger)
        self._task = asyncio.ensure_future(self._work())

    def accept(self, data: bytes | int, *about: Any) -> None:
        """Take a message for the handler, with what is known about it.

        Args:
            data: its bytes, or their number where there are more than :attr:`longest`.
            about: further arguments of the handler.
        """
        if self._limit is not None and not self._limit.admit():
            self._log.warning("too many messages on %s; dropped the latest", self._subject)
            return
        # A handler may parse it whatever it is, and that holds the interpreter.
        size = data if isinstance(data, int) else len(data)
        why = f"it has {size} bytes" if isinstance(data, int) else bounded_json.refusal(data, self.longest)
        taken = self._unread(size) if why else data
        if taken is None:
            self._log.warning("refused a message on %s: %s", self._subject, why)
        elif self._backlog.push((taken, *about), 0 if why else size):
            self._log.warning("the handler of %s does not keep up; dropped the oldest messages", self._subject)

    async def close(self) -> None:
        """Stop serving; what still waits is dropped."""
        self._task.cancel()
        if self._task is not asyncio.current_task():
            await asyncio.gather(self._task, return_exceptions=True)

    async def _work(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            served = 0
            while (message := self._backlog.take()) is not None:
                try:
                    await self._handler(*message)
                except Exception:
                    logger.exception("the handler of %s failed", self._subject)
                served += 1
                if served % DRAIN_AT_ONCE == 0:
                    await asyncio.sleep(0)


async def on_a_thread(function: Callable[[], Any], undo: Callable[[Any], None] | None = None) -> Any:
    """Await ``function()`` on a thread that ends with it, unlike a pool's.

    When the caller is cancelled meanwhile, a result is handed to ``undo``.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[Any] = loop.create_future()

    def settle(result: Any, error: BaseException | None) -> None:
        if future.done():
            if undo is not None and error is None:
                threading.Thread(target=undo, args=(result,), daemon=True).start()
        elif error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)

    def work() -> None:
        result, error = None, None
        try:
            result = function()
        except BaseException as problem:  # noqa: BLE001 - raised again where the call is awaited
            error = problem
        try:
            loop.call_soon_threadsafe(settle, result, error)
        except RuntimeError:  # the loop was closed while this thread waited
            if undo is not None and error is None:
                undo(result)

    threading.Thread(target=work, name="strands-zenoh-call", daemon=True).start()
    return await future


def start_now(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Start a task whose first step runs at once instead of in the loop's next turn.

    Inside another task it begins in the next turn, as any task does.
    """
    loop = asyncio.get_running_loop()
    if asyncio.current_task(loop) is not None:
        return loop.create_task(work)
    if sys.version_info >= (3, 12):
        return asyncio.Task(work, loop=loop, eager_start=True)
    context = contextvars.copy_context()
    started = _Started(work)
    task = loop.create_task(started, context=context)
    _enter_task(loop, task)
    try:
        started.first = context.run(work.send, None), None
    except BaseException as end:  # noqa: BLE001 - raised again where the task takes this step
        started.first = None, end
    finally:
        _leave_task(loop, task)
    return task


class _Started(Coroutine[Any, Any, None]):
    """A coroutine that took its first step, and replays its outcome to the task."""

    __slots__ = ("_work", "first")

    def __init__(self, work: Coroutine[Any, Any, None]) -> None:
        self._work = work
        self.first: tuple[Any, BaseException | None] | None = None

    def send(self, value: Any, /) -> Any:
        """Give the outcome of the first step, then take the next ones."""
        if self.first is None:
            return self._work.send(value)
        (waits_for, end), self.first = self.first, None
        if end is not None:
            raise end
        return waits_for

    def throw(self, *error: Any) -> Any:
        """Raise inside the coroutine, and cancel the future that it waits for."""
        (waits_for, end), self.first = self.first or (None, None), None
        if end is not None:
            raise end
        if isinstance(waits_for, asyncio.Future):
            waits_for.cancel()
        return self._work.throw(*error)

    def close(self) -> None:
        """End the coroutine at its present step."""
        self._work.close()

    def __await__(self) -> Generator[Any, Any, None]:
        raise TypeError("only a task drives this")
