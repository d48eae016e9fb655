"""The demo's robot: a process of its own that serves a simulated arm, and never outlives the demo."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

from strands_robots.cli.output import Exit, Failure

READY_S = 20.0
"""Seconds until the robot has to be on the network; the first start compiles the installation's bytecode."""

GOODBYE_S = 6.0
"""Seconds it has to stop its motion and depart, before it is killed."""


class Child:
    """A running ``strands-robots serve``."""

    def __init__(self, process: subprocess.Popen[str], ready: dict[str, Any]) -> None:
        self.process = process
        self.ready = ready

    def check(self) -> None:
        """Raises :class:`Failure` when the process has ended."""
        code = self.process.poll()
        if code is not None:
            raise Failure(f"The robot's process ended with exit code {code}.")

    def leave(self) -> None:
        """Ask it to stop the robot and depart, and wait until it did.

        Raises:
            Failure: it did not end in time, or not with success.
        """
        self.process.terminate()
        try:
            code = self.process.wait(GOODBYE_S)
        except subprocess.TimeoutExpired:
            raise Failure(f"The robot's process did not end within {GOODBYE_S:g} s.") from None
        if code not in (Exit.OK, Exit.INTERRUPTED):
            raise Failure(f"The robot's process ended with exit code {code}.")


@contextmanager
def serving(robot: str, peer_id: str, port: int, tenant: str) -> Iterator[Child]:
    """Serve ``robot`` on 127.0.0.1 at ``port`` for the length of the block.

    Raises:
        Failure: it is not on the network within :data:`READY_S` seconds.
    """
    words = ("serve", robot, "--peer-id", peer_id, "--port", str(port), "--tenant", tenant)
    with process([*words, "--json", "--until-stdin-closes"]) as child:
        yield Child(child, _ready(child))


@contextmanager
def process(words: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """A ``strands-robots`` process that is gone when the block is left, however it is left."""
    child = subprocess.Popen(
        [sys.executable, "-m", "strands_robots.cli", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl-C reaches the demo alone, which then ends its robot in order.
        start_new_session=True,
    )
    try:
        yield child
    finally:
        if child.poll() is None:
            child.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it is killed below
                child.wait(GOODBYE_S)
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout, child.stderr):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):  # the child is gone, which is what is wanted
                    pipe.close()


def _ready(child: subprocess.Popen[str]) -> dict[str, Any]:
    lines: queue.Queue[str] = queue.Queue()
    complaints: list[str] = []
    readers = (
        threading.Thread(target=_carry, args=(child.stdout, lines.put), daemon=True),
        threading.Thread(target=_carry, args=(child.stderr, complaints.append), daemon=True),
    )
    for reader in readers:
        reader.start()
    deadline = time.monotonic() + READY_S
    while time.monotonic() < deadline:
        with contextlib.suppress(queue.Empty):
            told = json.loads(lines.get(timeout=0.1))
            if told.get("status") == "error":
                raise Failure(f"The robot could not be served: {told.get('reason')}")
            if told.get("event") == "serving":
                ready: dict[str, Any] = told
                return ready
        if child.poll() is not None and lines.empty():
            readers[1].join(1.0)
            said = "".join(complaints).strip().splitlines()
            raise Failure(f"The robot's process ended with exit code {child.returncode}: {said[-1] if said else ''}")
    raise Failure(f"The robot was not on the network within {READY_S:g} s.")


def _carry(pipe: IO[str] | None, take: Any) -> None:
    for line in pipe or ():
        take(line)
