"""StopSignal: SIGINT and SIGTERM end a wait."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from strands_robots.threads import StopSignal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_wait_and_restores_the_handlers(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in StopSignal.SIGNALS]
    with StopSignal() as stop:
        assert stop.wait(0.01) is None
        threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
        assert stop.wait(20) == number
        assert [signal.getsignal(each) for each in StopSignal.SIGNALS] == before


def test_leaving_without_a_signal_restores_the_handlers() -> None:
    before = [signal.getsignal(each) for each in StopSignal.SIGNALS]
    with StopSignal():
        assert [signal.getsignal(each) for each in StopSignal.SIGNALS] != before
    assert [signal.getsignal(each) for each in StopSignal.SIGNALS] == before


def test_only_the_main_thread_has_signal_handlers() -> None:
    refused: list[BaseException] = []

    def enter() -> None:
        try:
            with StopSignal():
                pass
        except ValueError as exc:
            refused.append(exc)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert len(refused) == 1
