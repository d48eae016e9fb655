"""Reads of a leader on a thread of its own."""

from __future__ import annotations

import threading

import pytest

from strands_robots.leader_thread import LeaderSilentError, LeaderThread


def test_reads_are_made_one_after_another_on_one_thread_and_raise_what_they_raise() -> None:
    thread = LeaderThread("pad", 20.0)
    assert len({thread.read(threading.get_ident) for _ in range(3)} | {threading.get_ident()}) == 2
    with pytest.raises(ZeroDivisionError):
        thread.read(lambda: 1 / 0)
    assert thread.read(lambda: "again") == "again"
    thread.close()


def test_late_read_is_given_up_and_its_answer_taken_for_no_other() -> None:
    free = threading.Event()
    thread = LeaderThread("pad", 0.01)
    with pytest.raises(LeaderSilentError, match=r"pad has not answered for 0\.01 s"):
        thread.read(lambda: free.wait(20) and "late")
    free.set()
    with pytest.raises(LeaderSilentError, match="has not answered"):
        thread.read(lambda: "next")


def test_interrupt_ends_the_wait_for_a_read_that_hangs() -> None:
    free, hangs = threading.Event(), threading.Event()
    thread = LeaderThread("pad", 60.0)

    def hang() -> bool:
        hangs.set()
        return free.wait(60)

    def interrupt() -> None:
        hangs.wait(20)
        thread.interrupt()

    interrupting = threading.Thread(target=interrupt)
    interrupting.start()
    with pytest.raises(LeaderSilentError, match="pad is not waited for"):
        thread.read(hang)
    free.set()
    interrupting.join()


def test_closed_thread_reads_nothing() -> None:
    thread = LeaderThread("pad", 20.0)
    thread.close()
    with pytest.raises(LeaderSilentError, match="pad is not read any more"):
        thread.read(lambda: "next")
