"""Settings of a test alone: free ports and own state."""

from __future__ import annotations

import logging
import socket
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext

from strands_robots import settings
from strands_robots.audit import flush_audit
from strands_robots.safety.sightings import flush_sightings


@contextmanager
def private_network(
    deadline_s: float, more: Mapping[str, str], *, log: logging.Handler | None = None
) -> Iterator[None]:
    """Put the user's settings aside for free ports and own state.

    It is the environment of the whole process, so one block at a time.

    Args:
        deadline_s: seconds in which a halt has to answer.
        more: further settings.
        log: takes the errors that this package logs, in the place of its log, which each refusal and stop of a check
            would fill.
    """
    with tempfile.TemporaryDirectory(prefix="strands-robots-", ignore_cleanup_errors=True) as state:
        values = {
            "STRANDS_STATE_DIR": state,
            "STRANDS_DC_PORT": str(_free_port()),
            "STRANDS_MESH_PORT": str(_free_port()),
            "STRANDS_HALT_DEADLINE_S": str(deadline_s),
            **more,
        }
        with settings.only(values), nullcontext() if log is None else _logging_to(log):
            try:
                yield
            finally:
                # What is still queued belongs into the directory that is removed.
                flush_audit()
                flush_sightings()


@contextmanager
def _logging_to(log: logging.Handler) -> Iterator[None]:
    """Have this package log to ``log`` alone, and as before at the end."""
    ours = logging.getLogger("strands_robots")
    before = ours.handlers, ours.level, ours.propagate
    ours.handlers, ours.propagate = [log], False
    ours.setLevel(logging.ERROR)
    try:
        yield
    finally:
        ours.handlers, ours.propagate = before[0], before[2]
        ours.setLevel(before[1])


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
