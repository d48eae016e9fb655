"""Inference off the control thread: answers are fetched without waiting, and a stop drops them."""

from __future__ import annotations

import logging
import threading
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.policies.profiled import InferenceResult, InferenceWorker, InlineInference


class Model:
    """Answers a request with itself, once it is let go."""

    def __init__(self) -> None:
        self.let_go = threading.Event()
        self.begun = threading.Event()
        self.threads: list[str] = []
        self.finished = threading.Event()

    def infer(self, request: Any) -> Any:
        self.threads.append(threading.current_thread().name)
        self.begun.set()
        assert self.let_go.wait(20)
        if isinstance(request, Exception):
            raise request
        return request


@pytest.fixture
def model() -> Model:
    return Model()


@pytest.fixture
def worker(model: Model) -> InferenceWorker:
    return InferenceWorker("pick", model.infer, model.finished.set)


def answered(worker: InferenceWorker) -> InferenceResult:
    return eventually(worker.answer, what="an answer")


def test_asking_does_not_wait_and_the_answer_is_there_once(model: Model, worker: InferenceWorker) -> None:
    worker.ask("one")
    assert model.begun.wait(20)
    assert worker.answer() is None
    assert worker.waited_s is not None
    model.let_go.set()
    answer = answered(worker)
    assert (answer.value, answer.failure) == ("one", None)
    assert answer.latency_s > 0
    assert worker.answer() is None
    assert worker.waited_s is None
    assert model.threads == ["inference-pick"]
    worker.close()


def test_what_the_model_raises_is_its_answer(model: Model, worker: InferenceWorker) -> None:
    model.let_go.set()
    worker.ask(OSError("no server"))
    assert str(answered(worker).failure) == "no server"
    worker.close()


def test_closing_returns_at_once_names_the_hung_inference_and_drops_its_answer(
    model: Model, worker: InferenceWorker, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    worker.ask("late")
    assert model.begun.wait(20)
    # The inference goes on until it is let go: a close that waited for it would not return.
    worker.close()
    assert "The policy pick has been computing" in caplog.text
    assert not model.finished.is_set(), "the model is freed only when nothing computes with it any more"
    model.let_go.set()
    assert model.finished.wait(20)
    assert worker.answer() is None


def test_a_worker_that_was_never_asked_frees_its_model_as_well(model: Model, worker: InferenceWorker) -> None:
    worker.close()
    worker.close()
    assert model.finished.is_set()
    worker.ask("too late")
    assert model.threads == []


def test_inline_inference_answers_after_its_latency_of_a_clock_moved_by_hand() -> None:
    time_s, closed = [0.0], list[int]()
    inline = InlineInference(lambda request: request, lambda: closed.append(1), lambda: time_s[0], latency_s=0.1)
    inline.ask("one")
    assert inline.answer() is None
    time_s[0] = 0.1
    assert inline.waited_s == pytest.approx(0.1)
    answer = inline.answer()
    assert answer is not None
    assert (answer.value, answer.latency_s) == ("one", 0.1)
    inline.close()
    inline.close()
    assert closed == [1]
