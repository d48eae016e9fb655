"""Inference off the control thread; its answers are fetched without waiting."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from strands_robots.policies.unfinished import computing

logger = logging.getLogger(__name__)

Infer = Callable[[Any], Any]
"""Computes the answer to one request; may take long, and may raise."""


@dataclass(frozen=True)
class InferenceResult:
    """The answer to a request, or what was raised instead, and how long it took."""

    value: Any
    failure: BaseException | None
    latency_s: float


class Inference(Protocol):
    """Asks a model; no call waits for it."""

    def ask(self, request: Any) -> None:
        """Ask; there must be no request in flight."""

    def answer(self) -> InferenceResult | None:
        """Return the answer, once, when it is there."""

    @property
    def waited_s(self) -> float | None:
        """Seconds since the request in flight, None without one."""

    def close(self) -> None:
        """Drop the request in flight and its answer."""


class InferenceWorker:
    """Inference on a thread of its own, which begins with the first request.

    Args:
        name: named in the thread and in the log.
        infer: called on the thread.
        finish: called once when no inference runs any more, as the last thing: it may free the model.
        now: monotonic time in seconds.
    """

    def __init__(
        self, name: str, infer: Infer, finish: Callable[[], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._name = name
        self._infer = infer
        self._finish = finish
        self._now = now
        self._asked_at: float | None = None
        self._requests: queue.SimpleQueue[tuple[Any] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[InferenceResult] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closed = False

    def ask(self, request: Any) -> None:
        if self._closed:
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"inference-{self._name}", daemon=True)
            self._thread.start()
        self._asked_at = self._now()
        self._requests.put((request,))

    def answer(self) -> InferenceResult | None:
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        self._asked_at = None
        return None if self._closed else answer

    @property
    def waited_s(self) -> float | None:
        return None if self._asked_at is None else self._now() - self._asked_at

    def close(self) -> None:
        """Drop the request in flight; the model is freed once it has returned."""
        if self._closed:
            return
        self._closed = True
        if self._thread is None:
            self._finish()
            return
        waited = self.waited_s
        if waited is not None:
            logger.info("The policy %s has been computing for %.1f s; its answer is dropped.", self._name, waited)
        self._requests.put(None)

    def _run(self) -> None:
        try:
            while (request := self._requests.get()) is not None and not self._closed:
                began = self._asked_at if self._asked_at is not None else self._now()
                value, failure = None, None
                try:
                    with computing(f"The inference of the policy {self._name}"):
                        value = self._infer(request[0])
                except BaseException as exc:  # noqa: BLE001 - raised again in the control thread
                    failure = exc
                self._answers.put(InferenceResult(value, failure, self._now() - began))
        finally:
            self._finish()


class InlineInference:
    """Inference in the calling thread, for a clock that is moved by hand.

    Args:
        infer: called by :meth:`ask`.
        finish: called by :meth:`close`.
        now: time in seconds.
        latency_s: seconds of that time after which an answer is there.
    """

    def __init__(
        self, infer: Infer, finish: Callable[[], None], now: Callable[[], float], latency_s: float = 0.0
    ) -> None:
        self._infer = infer
        self._finish = finish
        self._now = now
        self._latency_s = latency_s
        self._asked_at: float | None = None
        self._answer: InferenceResult | None = None
        self._closed = False

    def ask(self, request: Any) -> None:
        self._asked_at = self._now()
        value, failure = None, None
        try:
            value = self._infer(request)
        except Exception as exc:  # noqa: BLE001 - raised again where the answer is fetched
            failure = exc
        self._answer = InferenceResult(value, failure, self._latency_s)

    def answer(self) -> InferenceResult | None:
        if self._asked_at is None or self._now() - self._asked_at < self._latency_s - 1e-9:
            return None
        answer, self._answer, self._asked_at = self._answer, None, None
        return answer

    @property
    def waited_s(self) -> float | None:
        return None if self._asked_at is None else self._now() - self._asked_at

    def close(self) -> None:
        self._answer = self._asked_at = None
        if not self._closed:
            self._closed = True
            self._finish()
