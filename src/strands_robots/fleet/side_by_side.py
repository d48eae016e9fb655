"""Work on several networks or robots at once, also while the interpreter ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def on_own_thread(work: Callable[[], R]) -> Future[R]:
    """Begin ``work`` on a thread of its own, or do it here where none starts."""
    done: Future[R] = Future()
    # From now on it cannot be cancelled.
    done.set_running_or_notify_cancel()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as exc:  # noqa: BLE001 - it is raised where the result is taken
            done.set_exception(exc)

    try:
        threading.Thread(target=run, name="fleet-work", daemon=True).start()
    except RuntimeError:
        run()
    return done


def side_by_side(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return ``work`` of each item, in order; raise the first exception at the end.

    A pool of threads takes no work once the interpreter ends; a stop must be possible even then, so what gets no
    thread is done one after the other.
    """
    done: dict[int, R] = {}
    failed: dict[int, BaseException] = {}

    def one(place: int) -> None:
        try:
            done[place] = work(items[place])
        except BaseException as exc:  # noqa: BLE001 - it is raised on the caller's thread
            failed[place] = exc

    started, rest = [], list(range(len(items)))
    while len(rest) > 1:
        thread = threading.Thread(target=one, args=(rest[0],), name="fleet-work", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            break
        started.append(thread)
        rest.pop(0)
    for place in rest:
        one(place)
    for thread in started:
        thread.join()
    if failed:
        raise failed[min(failed)]
    return [done[place] for place in range(len(items))]


def those(test: Callable[[T], bool], items: Sequence[T], *, every: bool) -> list[T]:
    """Return items for which ``test`` is true: all, or those known at the first one.

    One that raises is none.
    """
    found: dict[int, bool] = {}
    change = threading.Condition()

    def one(place: int) -> None:
        there = False
        try:
            there = test(items[place])
        finally:
            with change:
                found[place] = there
                change.notify_all()

    for place in range(len(items)):
        on_own_thread(partial(one, place))
    with change:
        change.wait_for(lambda: len(found) == len(items) or (not every and any(found.values())))
        return [each for place, each in enumerate(items) if found.get(place)]
