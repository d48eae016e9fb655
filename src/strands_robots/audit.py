"""The safety record: who stopped what, who resumed it, what was refused.

:func:`log_safety_event` hands the record to one writer thread and returns at once: it never waits for a disk and
never raises, so that it may stand on the way of a stop. A record is acknowledged when :func:`flush_audit` returns
True: then everything handed over before it is on the disk. A record that cannot be written is logged at CRITICAL
and tried again until it can; :data:`PENDING_MAX` of them are held.
"""

from __future__ import annotations

import atexit
import logging
import queue
import stat
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.safety import integrity
from strands_robots.safety.approval import state_dir
from strands_robots.safety.journal import Entry, Journal
from strands_robots.utils import shown

logger = logging.getLogger(__name__)

PENDING_MAX = 10_000
RETRY_S = 1.0
FLUSH_S = 2.0


def audit_directory() -> Path:
    """``STRANDS_MESH_AUDIT_DIR``, else the directory of the robot's state."""
    stated = settings.raw("STRANDS_MESH_AUDIT_DIR")
    return Path(stated).expanduser() if stated else state_dir()


def log_safety_event(event_type: str, peer_id: str, payload: dict[str, Any]) -> None:
    """Append one safety event to the audit log; returns at once.

    Args:
        event_type: short lower-case name, such as ``emergency_stop``.
        peer_id: the robot or peer that it happened at.
        payload: what is to be known; what JSON cannot hold is recorded by its short ``repr``.
    """
    _WRITER.put(_journal_key(), Entry(time.time(), _text(event_type), _text(peer_id), payload))


def flush_audit(timeout: float = FLUSH_S) -> bool:
    """True when every record handed over so far is on the disk; waits ``timeout`` seconds at most."""
    return _WRITER.flush(timeout)


def read_audit_log(since: float | None = None) -> list[dict[str, Any]]:
    """Every record over all rotations, oldest first; with ``since`` (wall-clock s) only those not older."""
    flush_audit()
    records = _journal(_journal_key()).records()
    return [each for each in records if since is None or _time(each) >= since]


def verify_audit_integrity() -> dict[str, Any]:
    """Counts ``total``, ``signed``, ``verified``, ``bad``, ``missing``, ``gaps``, ``torn``, ``broken``, the list
    ``breaks`` that says where, ``head``, and ``ok``; see :func:`strands_robots.safety.integrity.verify`.
    """
    flush_audit()
    key = _journal_key()
    return integrity.verify(_journal(key), keyed=key[1] is not None)


_Key = tuple[Path, bytes | None]


def _journal_key() -> _Key:
    secret = settings.raw("STRANDS_MESH_AUDIT_PSK")
    return audit_directory(), secret.encode() if secret else None


def _journal(key: _Key) -> Journal:
    return Journal(*key)


def _text(value: object) -> str:
    return value if isinstance(value, str) else shown(value)


def _time(record: dict[str, Any]) -> float:
    ts = record.get("ts")
    return float(ts) if isinstance(ts, int | float) else 0.0


class _Writer:
    """The thread that owns the journal. Everything reaches it through one queue that is never full."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[_Key, Entry] | threading.Event] = queue.SimpleQueue()
        self._pending: deque[tuple[_Key, Entry]] = deque()
        self._waiting: list[threading.Event] = []
        self._journals: dict[_Key, Journal] = {}
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._failing = False

    def put(self, key: _Key, entry: Entry) -> None:
        self._queue.put((key, entry))
        self._ensure()

    def flush(self, timeout: float) -> bool:
        if self._thread is None and self._queue.empty():
            return True
        done = threading.Event()
        self._queue.put(done)
        self._ensure()
        return done.wait(timeout)

    def _ensure(self) -> None:
        # A fork leaves the child with the object and without the thread.
        if self._thread is not None and self._thread.is_alive():
            return
        with self._starting:
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name="safety-audit", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        while True:
            self._take()
            while self._pending:
                key = self._pending[0][0]
                batch = [entry for each, entry in self._pending if each == key]
                if not self._write(key, batch):
                    break
                self._pending = deque(item for item in self._pending if item[0] != key)
            if not self._pending:
                for done in self._waiting:
                    done.set()
                self._waiting.clear()

    def _take(self) -> None:
        try:
            item = self._queue.get(timeout=RETRY_S if self._pending else None)
            while True:
                if isinstance(item, threading.Event):
                    self._waiting.append(item)
                else:
                    self._pending.append(item)
                item = self._queue.get_nowait()
        except queue.Empty:
            self._shed()

    def _shed(self) -> None:
        lost = len(self._pending) - PENDING_MAX
        if lost <= 0:
            return
        key = self._pending[0][0]
        for _ in range(lost + 1):
            self._pending.popleft()
        self._pending.appendleft((key, Entry(time.time(), "audit_records_lost", "audit", {"lost": lost + 1})))

    def _write(self, key: _Key, batch: list[Entry]) -> bool:
        journal = self._journals.setdefault(key, _journal(key))
        try:
            journal.append(batch)
        except Exception as exc:  # noqa: BLE001 - whatever stops the record is reported, and the record is kept
            if not self._failing:
                logger.critical("The safety audit in %s cannot be written: %s. Records are kept.", key[0], exc)
            self._failing = True
            for entry in batch[-1:]:
                logger.critical("Audit not on disk: %s %s %s", entry.event, entry.peer_id, shown(entry.payload))
            return False
        if self._failing:
            logger.warning("The safety audit in %s is written again.", key[0])
            self._failing = False
        else:
            _warn_of_readers(key[0])
        return True


_told: set[Path] = set()


def _warn_of_readers(directory: Path) -> None:
    if directory not in _told:
        _told.add(directory)
        if stat.S_IMODE(directory.stat().st_mode) & 0o077:
            logger.warning("%s is open to other users; the safety audit belongs in a 0700 directory.", directory)


_WRITER = _Writer()
atexit.register(flush_audit)
