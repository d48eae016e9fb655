"""A task whose first step runs at once instead of in the loop's next turn."""

from __future__ import annotations

import asyncio
import contextvars
import sys

# Documented under "Extending asyncio": how a task says that it is the one that runs.
from asyncio.tasks import _enter_task, _leave_task
from collections.abc import Coroutine, Generator
from typing import Any


def start(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """A task for ``work``, which has run up to where it first waits.

    Inside another task it begins in the next turn, as any task does.
    """
    loop = asyncio.get_running_loop()
    if asyncio.current_task(loop) is not None:
        return loop.create_task(work)
    if sys.version_info >= (3, 12):
        return asyncio.Task(work, loop=loop, eager_start=True)
    context = contextvars.copy_context()
    begun = _Begun(work)
    task = loop.create_task(begun, context=context)
    _enter_task(loop, task)
    try:
        context.run(begun.begin)
    finally:
        _leave_task(loop, task)
    return task


class _Begun(Coroutine[Any, Any, None]):
    """A coroutine that has taken its first step; a task that steps it first is told how that step ended."""

    __slots__ = ("_first", "_work")

    def __init__(self, work: Coroutine[Any, Any, None]) -> None:
        self._work = work
        self._first: tuple[Any, BaseException | None] | None = None

    def begin(self) -> None:
        """Take the first step."""
        try:
            self._first = self._work.send(None), None
        except BaseException as end:  # noqa: BLE001 - raised again where the task takes this step
            self._first = None, end

    def send(self, value: Any, /) -> Any:
        """What the first step gave, then the next steps."""
        if self._first is None:
            return self._work.send(value)
        (waits_for, end), self._first = self._first, None
        if end is not None:
            raise end
        return waits_for

    def throw(self, *error: Any) -> Any:
        """Raise inside the coroutine; a task that is cancelled before its first step cancels what it waits for."""
        (waits_for, end), self._first = self._first or (None, None), None
        if end is not None:
            raise end
        if isinstance(waits_for, asyncio.Future):
            waits_for.cancel()
        return self._work.throw(*error)

    def close(self) -> None:
        """End the coroutine where it stands."""
        self._work.close()

    def __await__(self) -> Generator[Any, Any, None]:
        raise TypeError("only a task drives this")
