"""Requested stops that wait for their verdict; every one is carried out.

The stop executor shares one halt among the stops that wait for it. Here is counted who waits for an answer, so that a
flood costs its sender answers and no robot its stop, and answers are given on another thread than halts.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from strands_robots.contract import Haltable
from strands_robots.safety.stop_executor import StopExecutor, stop_executor
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.workers import UNBOUNDED
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

CALLER_MAX = 256
"""Stops of one caller that wait for an answer; beyond it the caller's oldest loses its own."""

TOTAL_MAX = 4096
"""The same for all callers; beyond it the one with the most loses the answer to its oldest."""

Request = tuple[str, str]
"""Caller and turn."""

Answer = Callable[[StopVerdict, list[Request]], None]
"""Answers requests that share a verdict."""


class StopRequests:
    """Stops of one peer without an answer.

    Args:
        answer: called on a thread of the pool, one call at a time.
        executor: carries out the stops.
    """

    def __init__(self, answer: Answer, executor: Callable[[], StopExecutor] = stop_executor) -> None:
        self._answer = answer
        self._executor = executor
        self._waiting: dict[Request, None] = {}
        self._by_caller: Counter[str] = Counter()
        self._verdicts: deque[tuple[StopVerdict, Request]] = deque()
        self._answering = False
        self._lock = threading.Lock()
        self.unanswered = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, target: Haltable, name: str, reason: str, request: Request, *, within: float | None = None) -> None:
        """Have ``target`` halted and ``request`` answered; return at once."""
        with self._lock:
            if request not in self._waiting:
                self._waiting[request] = None
                self._by_caller[request[0]] += 1
            if self._by_caller[request[0]] > CALLER_MAX:
                self._forget(request[0])
            elif len(self._waiting) > TOTAL_MAX:
                self._forget(self._by_caller.most_common(1)[0][0])
        self._executor().submit(target, name, reason, within=within).add_done_callback(partial(self._halted, request))

    def _halted(self, request: Request, halted: Future[StopVerdict]) -> None:
        with self._lock:
            if request not in self._waiting:
                return
            self._verdicts.append((halted.result(), request))
            begin, self._answering = not self._answering, True
        if begin:
            UNBOUNDED.submit(self._answer_all)

    def _answer_all(self) -> None:
        while True:
            with self._lock:
                due, self._verdicts = self._verdicts, deque()
                if not due:
                    self._answering = False
                    return
            try:
                for verdict, requests in _grouped(due):
                    self._answer(verdict, requests)
            except Exception:
                logger.exception("The answers to a stop failed.")
            finally:
                with self._lock:
                    for _, request in due:
                        self._release(request)

    def _forget(self, caller: str) -> None:
        oldest = next((request for request in self._waiting if request[0] == caller), None)
        if oldest is not None:
            self._release(oldest)
            self.unanswered += 1

    def _release(self, request: Request) -> None:
        if request in self._waiting:
            del self._waiting[request]
            self._by_caller[request[0]] -= 1
            self._by_caller = +self._by_caller


def _grouped(due: deque[tuple[StopVerdict, Request]]) -> list[tuple[StopVerdict, list[Request]]]:
    """Merge requests of the same target; a repeated one is answered once."""
    groups: dict[tuple[object, ...], tuple[StopVerdict, dict[Request, None]]] = {}
    answered: set[Request] = set()
    for verdict, request in due:
        if request in answered:
            continue
        answered.add(request)
        same = (verdict.halted, tuple(verdict.not_stopped.items()), tuple(verdict.unknown.items()))
        groups.setdefault(same, (verdict, {}))[1][request] = None
    return [(verdict, list(requests)) for verdict, requests in groups.values()]
