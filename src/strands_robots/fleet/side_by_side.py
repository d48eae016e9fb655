"""Work on several networks or robots at once, also while the interpreter ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


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
