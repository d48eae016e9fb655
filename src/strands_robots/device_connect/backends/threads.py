"""One thread for one call that waits, such as opening a session."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any


async def on_a_thread(function: Callable[[], Any], undo: Callable[[Any], None] | None = None) -> Any:
    """``function()`` on a thread of its own, for the rare calls that wait; a loop's pool would keep its threads.

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
        except BaseException as problem:  # noqa: BLE001 - handed to whoever waits
            error = problem
        try:
            loop.call_soon_threadsafe(settle, result, error)
        except RuntimeError:  # the loop was closed while this thread waited
            if undo is not None and error is None:
                undo(result)

    threading.Thread(target=work, name="strands-zenoh-call", daemon=True).start()
    return await future
