"""Threads that stand ready to halt: one a robot, so that a robot whose halt blocks holds up no other."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable

from strands_robots.contract import Haltable
from strands_robots.safety.stopping import StopVerdict, explain, grade

Answered = Callable[[StopVerdict], None]
_Jobs = queue.SimpleQueue[tuple[str, Answered] | None]


def halt_of(robot: Haltable, robot_id: str, reason: str) -> StopVerdict:
    """The robot's verdict on its own halt; whatever else it answers or raises is graded."""
    return verdict_of(lambda: robot.halt(reason), robot_id)


def verdict_of(stop: Callable[[], object], name: str) -> StopVerdict:
    """What ``stop`` answers as a verdict on the one that is called ``name``; what it raises is graded too."""
    try:
        answer = stop()
    except Exception as exc:  # noqa: BLE001 - a stop that raises is a robot that may be moving, and is named so
        answer = exc
    if isinstance(answer, StopVerdict):
        return answer
    outcome = grade(answer)
    if outcome.stopped:
        return StopVerdict((name,))
    if outcome.stopped is None:
        return StopVerdict(unknown={name: explain(answer)})
    return StopVerdict(not_stopped={name: explain(answer)})


class HaltWorker:
    """A daemon thread that waits for its robot's next halt. A new one is made ready when a halt has got stuck."""

    def __init__(self, robot: Haltable, robot_id: str) -> None:
        self._robot = robot
        self._robot_id = robot_id
        # Taken for assignments and puts alone: a halt ordered while the thread is renewed must not fall between.
        self._changing = threading.Lock()
        self._closed = False
        self._jobs: _Jobs = queue.SimpleQueue()
        self._thread = self._start(self._jobs)

    def halt(self, reason: str, answered: Answered) -> None:
        """Halt on the ready thread; ``answered`` is called there with the verdict. Returns at once."""
        with self._changing:
            self._jobs.put((reason, answered))

    def renew(self) -> None:
        """Put a fresh thread beside one whose halt has not answered; that one ends when its halt returns.

        The fresh one takes over what waits behind that halt. Raises RuntimeError where no thread can start.
        """
        jobs: _Jobs = queue.SimpleQueue()
        thread = self._start(jobs)
        with self._changing:
            stuck, self._jobs, self._thread = self._jobs, jobs, thread
            with contextlib.suppress(queue.Empty):  # all taken over
                while True:
                    jobs.put(stuck.get_nowait())
            stuck.put(None)
            if self._closed:
                jobs.put(None)

    def close(self, wait: float = 1.0) -> None:
        """End the thread; one that is stuck in a halt is left behind as a daemon."""
        with self._changing:
            self._closed = True
            self._jobs.put(None)
            thread = self._thread
        if thread is not threading.current_thread():
            thread.join(wait)

    def _start(self, jobs: _Jobs) -> threading.Thread:
        thread = threading.Thread(target=self._run, args=(jobs,), name=f"halt-{self._robot_id}", daemon=True)
        thread.start()
        return thread

    def _run(self, jobs: _Jobs) -> None:
        while (job := jobs.get()) is not None:
            reason, answered = job
            answered(halt_of(self._robot, self._robot_id, reason))
