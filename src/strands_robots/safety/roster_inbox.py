"""Reports of standing controllers about a stop of this process, as they come."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.safety.estop_listener import FairQueue
from strands_robots.safety.orders import params_of
from strands_robots.safety.roster_report import (
    REPORT_MAX_BYTES,
    STOP_ROSTER,
    RosterReport,
    read_report,
    trusted_controllers,
)
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

UNPROVEN_PAUSE_S = 0.005
"""Pause after a report of a source that no known key has signed, so that a flood of them costs little."""

OnReport = Callable[[RosterReport], object]


class RosterInbox:
    """Reads reports on a thread of its own, while a stop waits for answers.

    A source whose report was signed with a known key has every second turn, so that a flood under made-up names keeps
    no such report away for long.

    Args:
        read: returns the fields of a message; empty for what is none.
    """

    def __init__(self, read: Callable[[bytes], Mapping[str, Any]] = params_of) -> None:
        self._read = read
        self._lock = threading.Lock()
        self._stops: dict[str, OnReport] = {}
        self._queue = FairQueue()
        self._started = False

    def open(self, estop_id: str, on_report: OnReport) -> None:
        """Give reports about this stop to ``on_report``, on the thread of the inbox."""
        with self._lock:
            self._stops[estop_id] = on_report

    def close(self, estop_id: str) -> None:
        """Take no more reports about this stop."""
        with self._lock:
            self._stops.pop(estop_id, None)

    def put(self, source: str, payload: bytes | int) -> None:
        """Take a message that a stop waits for, unless it is too long; returns at once."""
        if isinstance(payload, int) or len(payload) > REPORT_MAX_BYTES or not self._stops:
            return
        self._queue.put(STOP_ROSTER, source, payload, urgent=False)
        if not self._started:
            with self._lock:
                started, self._started = self._started, True
            if not started:
                threading.Thread(target=self._run, name="roster reports", daemon=True).start()

    def end(self) -> None:
        """End the thread."""
        self._queue.close()

    def _run(self) -> None:
        trusted = trusted_controllers()
        while (event := self._queue.get()) is not None:
            if not self._stops:
                trusted = frozenset()
                continue
            trusted = trusted or trusted_controllers()
            fields = self._read(event.payload) if isinstance(event.payload, bytes) else {}
            report = read_report(event.source, fields, trusted)
            with self._lock:
                on_report = None if report is None else self._stops.get(report.estop_id)
            if report is None or not report.trusted:
                time.sleep(UNPROVEN_PAUSE_S)
            else:
                self._queue.vouch(event.source)
            if report is not None and on_report is not None:
                on_report(report)
