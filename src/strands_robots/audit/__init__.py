"""The safety audit: a record of every stop, resume and refusal.

:func:`log_safety_event` returns when the record is on the disk. :func:`queue_safety_event` hands it to the same writer
thread and returns at once: on the way of a stop, of a verdict or of a refusal nothing waits for a disk. Neither raises.
:func:`flush_audit` returns True when everything handed over before it is on the disk. A record that cannot be written
is logged at CRITICAL and tried again until it can; :data:`PENDING_MAX` of them are held.

A process signs with the secret of its first record for as long as it lives.

The main log is rotated, so that a flood of other events would end with nothing else in it. The first record of each
stop and each resume of a robot is written to a second log as well, which is chained, signed and anchored alike and is
never rotated. At :data:`LASTING_MAX_BYTES` it takes no more.
"""

from __future__ import annotations

import atexit
import contextlib
import queue
import stat
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.audit.head import Anchor, log_id
from strands_robots.audit.journal import AUDIT_PEER, BROKEN, NAME, AuditEntry, Journal, storable
from strands_robots.audit.verification import WITNESS, compare, stated_head, verify, verify_records, witnessed
from strands_robots.moved import getter
from strands_robots.state_files import make_private, state_dir
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, shown

logger = stop_logger(__name__)

if not TYPE_CHECKING:  # a package with a __getattr__ has every name for a type checker
    __getattr__ = getter(__name__)

PENDING_MAX = 10_000
QUEUED_MAX = 2 * PENDING_MAX
RETRY_S = 1.0
LOST = "audit_records_lost"
NOT_ON_DISK = "records of this process are not on the disk yet"
FLUSH_S = 2.0
"""Seconds that a record, a flush or a reader waits for the disk."""


def audit_directory() -> Path:
    """``STRANDS_MESH_AUDIT_DIR``, else the directory of the robot's state."""
    stated = settings.raw("STRANDS_MESH_AUDIT_DIR")
    return Path(stated).expanduser() if stated else state_dir()


def audit_log_path() -> Path:
    """Return the file that events are appended to; it need not exist yet."""
    return audit_directory() / NAME


def log_safety_event(event_type: str, peer_id: str, payload: dict[str, Any]) -> None:
    """Append one safety event to the audit log; returns when it is on the disk.

    Never raises. Where the disk refuses the record, or does not take it within 2 s, that is logged at CRITICAL, and it
    is tried again for as long as the process lives. It may not stand on the way of a stop: see
    :func:`queue_safety_event`.

    Args:
        event_type: short lower-case name, such as ``emergency_stop``.
        peer_id: the robot or peer that it happened at.
        payload: facts of the event. Those that JSON cannot hold, or too long ones, are replaced by their short
            ``repr``; the record says so, and the check of the audit names it.
    """
    # Here, so that a foreign repr holds up its caller alone, and a later change of the payload is not recorded.
    entry = AuditEntry(time.time(), _text(event_type), _text(peer_id), storable(payload))
    if not _WRITER.write(_writing_key(), entry, FLUSH_S):
        logger.critical("Audit not on disk within %g s: %s %s.", FLUSH_S, entry.event, entry.peer_id)


def queue_safety_event(event_type: str, peer_id: str, payload: dict[str, Any]) -> None:
    """Hand over one safety event to be appended; returns at once and never raises.

    For the way of a stop, of its verdict and of a refusal. A process that is killed within the next milliseconds takes
    the record with it. The arguments are those of :func:`log_safety_event`.
    """
    _WRITER.put(_writing_key(), AuditEntry(time.time(), _text(event_type), _text(peer_id), payload))


def flush_audit(timeout: float = FLUSH_S) -> bool:
    """Return True when every record is on the disk; wait ``timeout`` s at most."""
    if not _WRITER.used:
        return True
    done = threading.Event()
    _WRITER.put(_writing_key(), done)
    return done.wait(timeout)


def read_audit_log(since: float | None = None) -> list[dict[str, Any]]:
    """Return every record, oldest first; with ``since`` (wall-clock s) newer ones."""
    flush_audit(FLUSH_S)
    main, kept = _journals(_journal_key())
    newer = list(main.records())
    records = [*rotated_out(kept.records(), newer), *newer]
    return [each for each in records if since is None or _time(each) >= since]


def audit_head() -> dict[str, Any] | None:
    """Return the last record that this process wrote, for a witness; never waits.

    Before its first record it is the last one on the disk, once that has been read: the first call has that done.
    """
    if _WRITER.last is None:
        _WRITER.put(_writing_key(), threading.Event())
    return stated_head(_WRITER.last)


def own_log_id() -> str:
    """Return the name of this machine's audit, as its heads carry it."""
    return _log_id(audit_directory())


@lru_cache(maxsize=16)
def _log_id(directory: Path) -> str:
    return log_id(directory / NAME)


def log_witness(witness: str, robot_id: str, head: object, *, signed: bool) -> None:
    """Record the head of another machine's audit, from a verdict of ``robot_id``."""
    known = witnessed(head)
    if known is not None and known.log != own_log_id():
        facts = {"log": known.log, "count": known.count, "last": known.last}
        queue_safety_event(WITNESS, robot_id, {**facts, "witness": witness, "signed": signed})


def compare_with_witnesses(files: Sequence[Path]) -> tuple[int, list[dict[str, Any]]]:
    """Compare the audit with those of other machines.

    Returns the number of their records about it, and what it no longer has.
    """
    flush_audit(FLUSH_S)
    return compare(_journals(_journal_key())[0], files)


def verify_audit_integrity(records: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """Check the audit of this machine, or records that were read from one.

    Counts ``total``, ``signed``, ``verified``, ``bad``, ``missing``, ``gaps``, ``torn``, ``broken``, ``tampered``,
    ``replaced``, the list ``breaks`` that says where, ``head``, and ``ok``; see
    :func:`strands_robots.audit.verification.verify`. ``kept`` are the records that are never rotated out. What could
    not be verified is not ok: signed records without their secret, and records of this process that the disk has not
    taken. Beside them: ``bad_signature`` (as ``bad``), ``missing_sig`` (as ``missing``), ``unverifiable_signed``
    (signed, and no secret here), ``psk_present``, and ``sequence_gaps``, the first hundred jumps as pairs of numbers.

    Args:
        records: check these alone, such as the lines of a file from another machine, by the secret that is set here:
            signatures and numbers, without chain, head and anchor. None: the audit on the disk, all of it.

    Raises:
        OSError: the files cannot be read, or another process keeps them locked.
        ValidationError: ``records`` is no list of objects.
    """
    if records is not None:
        return verify_records(_checked_records(records), _journal_key()[1])
    written = flush_audit(FLUSH_S)
    key = _journal_key()
    found = verify_both(*_journals(key), keyed=key[1] is not None)
    if not written:
        found["breaks"].append({"where": "end", "why": NOT_ON_DISK})
        found["ok"] = False
    return found


def _checked_records(records: object) -> list[dict[str, Any]]:
    if not isinstance(records, list | tuple):
        raise ValidationError(f"records must be a list of records, not {shown(records)}.")
    for index, each in enumerate(records):
        if not isinstance(each, dict):
            raise ValidationError(f"records[{index}] must be an object, not {shown(each)}.")
    return list(records)


_Key = tuple[Path, bytes | None]


_SECRETS: dict[Path, bytes] = {}
"""Secret of the first record of this process, by directory."""

_MISSED: set[tuple[Path, bytes | None]] = set()


def _stated_secret() -> bytes | None:
    secret = settings.raw("STRANDS_MESH_AUDIT_PSK")
    return secret.encode() if secret else None


def _journal_key() -> _Key:
    """Return directory and secret to read and check with: the stated one first."""
    directory = audit_directory()
    return directory, _stated_secret() or _SECRETS.get(directory)


def _writing_key() -> _Key:
    """Return directory and secret to write with: that of the first record."""
    directory, stated = audit_directory(), _stated_secret()
    if stated is not None:
        _SECRETS.setdefault(directory, stated)
    secret = _SECRETS.get(directory)
    if secret != stated and (directory, stated) not in _MISSED:
        _MISSED.add((directory, stated))
        logger.critical(
            "STRANDS_MESH_AUDIT_PSK %s: this process goes on signing the safety audit with the secret it began with.",
            "was changed" if stated else "is gone",
        )
    return directory, secret


def _journals(key: _Key) -> tuple[Journal, Journal]:
    """Return the log, and the one of the records that are never rotated out."""
    directory, secret = key
    # The anchor is not beside the log, so that a copy of the log and its head does not bring it along.
    anchor = state_dir() / "anchors" / log_id(directory / NAME)
    return Journal(directory, secret, anchor=anchor), lasting_journal(directory, secret, anchor)


def _text(value: object) -> str:
    return value if isinstance(value, str) else shown(value)


def _time(record: dict[str, Any]) -> float:
    ts = record.get("ts")
    return float(ts) if isinstance(ts, int | float) else 0.0


def _must_last(entry: AuditEntry) -> bool:
    return identity(entry.event, entry.peer_id, entry.payload) is not None


class _Tried(threading.Event):
    """Set after the next try to write, however it went."""


class _Pending:
    """Records of one journal that are not on the disk yet, and waiting flushes."""

    def __init__(self, key: _Key) -> None:
        self.directory = key[0]
        self.journal, kept = _journals(key)
        self._lasting = LastingRecords(kept)
        self.entries: deque[AuditEntry] = deque()
        self.waiting: list[threading.Event] = []
        self.tried: list[_Tried] = []
        self.failing = False
        self.last = self._last()
        self._reported = 0

    def _last(self) -> Anchor | None:
        head = self.journal.stored()
        return None if head is None else Anchor(head.log, head.count, head.last)

    def write(self) -> bool:
        """Put everything on the disk, or keep it and say so; False when it is kept."""
        self._shed()
        batch = list(self.entries)
        try:
            if batch:
                self._lasting.write(batch)
                self.journal.append(batch)
                self.last = self._last()
        except Exception as exc:  # noqa: BLE001 - whatever stops the record is reported, and the record is kept
            self._complain(exc)
            return False
        if self.failing:
            logger.warning("The safety audit in %s is written again.", self.directory)
        self.failing, self._reported = False, 0
        self.entries.clear()
        if batch:
            _warn_of_readers(self.directory)
        return True

    def acknowledge(self) -> None:
        """Let the flushes go on whose records are on the disk."""
        for done in self.waiting:
            done.set()
        self.waiting.clear()

    def answer(self) -> None:
        """Let the callers go on whose record was tried."""
        for each in self.tried:
            each.set()
        self.tried.clear()

    def _complain(self, exc: Exception) -> None:
        if not self.failing:
            logger.critical("The safety audit in %s cannot be written: %s. Records are kept.", self.directory, exc)
        self.failing = True
        for entry in list(self.entries)[self._reported :]:
            logger.critical("Audit not on disk: %s %s %s", entry.event, entry.peer_id, shown(entry.payload))
        self._reported = len(self.entries)

    def _shed(self) -> None:
        lost = len(self.entries) - PENDING_MAX
        if lost <= 0:
            return
        # One more makes room for the record that says so. Noise goes first, the oldest of it.
        by_worth = sorted(self.entries, key=_must_last)
        gone = by_worth[: lost + 1]
        away = {id(each) for each in gone}
        counted = sum(each.payload["lost"] if each.event == LOST else 1 for each in gone)
        self.entries = deque(each for each in self.entries if id(each) not in away)
        self.entries.appendleft(AuditEntry(time.time(), LOST, "audit", {"lost": counted}))
        self._reported = min(self._reported, len(self.entries))


class _Writer:
    """Thread that owns the journals, fed by one queue that is never full."""

    def __init__(self) -> None:
        self._lost: Counter[_Key] = Counter()
        self._counting = threading.Lock()
        self._queue: queue.SimpleQueue[tuple[_Key, AuditEntry | threading.Event]] = queue.SimpleQueue()
        self._pending: dict[_Key, _Pending] = {}
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self.last: Anchor | None = None

    def put(self, key: _Key, item: AuditEntry | threading.Event) -> None:
        """Hand over a record, or an event to set when all before it are on the disk.

        A disk that hangs keeps the thread: noise beyond :data:`QUEUED_MAX` records is counted instead.
        """
        if isinstance(item, AuditEntry) and self._queue.qsize() >= QUEUED_MAX and not _must_last(item):
            with self._counting:
                self._lost[key] += 1
            return
        self._queue.put((key, item))
        # A fork leaves the child with the object and without the thread.
        if self._thread is None or not self._thread.is_alive():
            with self._starting:
                if self._thread is None or not self._thread.is_alive():
                    self._thread = threading.Thread(target=self._run, name="safety-audit", daemon=True)
                    self._thread.start()

    def write(self, key: _Key, entry: AuditEntry, within_s: float) -> bool:
        """Hand over a record and wait for it; False when time is over first.

        A record that the disk refused was logged by the writer.
        """
        self.put(key, entry)
        if threading.current_thread() is self._thread:
            # A handler of the log records what the writer complains of.
            return True
        tried = _Tried()
        self.put(key, tried)
        return tried.wait(within_s)

    @property
    def used(self) -> bool:
        """True once anything was handed over."""
        return self._thread is not None

    def _run(self) -> None:
        while True:
            self._take()
            for pending in self._pending.values():
                if pending.entries or pending.waiting or pending.tried:
                    written = pending.write()
                    self.last = pending.last or self.last
                    pending.answer()
                    if written:
                        pending.acknowledge()

    def _take(self) -> None:
        unwritten = any(pending.entries for pending in self._pending.values())
        with contextlib.suppress(queue.Empty):  # everything was taken, or it is time to try again
            key, item = self._queue.get(timeout=RETRY_S if unwritten else None)
            while True:
                pending = self._pending_of(key)
                if isinstance(item, AuditEntry):
                    pending.entries.append(item)
                elif isinstance(item, _Tried):
                    pending.tried.append(item)
                else:
                    pending.waiting.append(item)
                key, item = self._queue.get_nowait()

    def _pending_of(self, key: _Key) -> _Pending:
        pending = self._pending.get(key)
        if pending is None:
            # Made once: it reads the head from the disk.
            pending = self._pending[key] = _Pending(key)
        if self._lost:
            with self._counting:
                lost, self._lost = self._lost, Counter()
            for each, count in lost.items():
                self._pending_of(each).entries.append(AuditEntry(time.time(), LOST, "audit", {"lost": count}))
        return pending


_warned: set[Path] = set()


def _warn_of_readers(directory: Path) -> None:
    if directory not in _warned:
        _warned.add(directory)
        if stat.S_IMODE(directory.stat().st_mode) & 0o077:
            logger.warning("%s is open to other users; the safety audit belongs in a 0700 directory.", directory)


_WRITER = _Writer()
atexit.register(flush_audit)


FOLDER = "kept"
LASTING_MAX_BYTES = 64 * 2**20
BEGUN = "audit_begun"
STOPS = frozenset({"emergency_stop", "remote_estop_engaged"})
EVENTS = STOPS | {"resume_ok", "resume_local", BROKEN}

Identity = tuple[str, str, str]


def lasting_journal(directory: Path, key: bytes | None, anchor: Path) -> Journal:
    """Return the second log of the audit in ``directory``."""
    return Journal(directory / FOLDER, key, kept=0, anchor=anchor.with_name(f"{anchor.name}-{FOLDER}"))


def identity(event: object, peer_id: object, payload: object) -> Identity | None:
    """Return what makes a record one of its kind; None for one that need not last."""
    if event not in EVENTS or not isinstance(payload, Mapping):
        return None
    about = payload.get("epoch", payload.get("epochs", payload.get("why")))
    return (str(event), str(peer_id), str(about)) if about else None


class LastingRecords:
    """Second log of one audit, with what is in it already."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._seen: set[Identity] | None = None
        self._full = False

    def write(self, entries: Iterable[AuditEntry]) -> None:
        """Write those of ``entries`` that must last and are the first of their kind.

        Raises:
            OSError: as :meth:`Journal.append`.
        """
        if self._seen is None:
            self._begin()
        fresh = {self._identity(each): each for each in reversed(list(entries))}
        fresh = {what: each for what, each in fresh.items() if what is not None and what not in (self._seen or ())}
        if not fresh or self._filled():
            return
        self._journal.append(list(reversed(fresh.values())))
        self._seen = (self._seen or set()) | {what for what in fresh if what is not None}

    def _begin(self) -> None:
        make_private(self._journal.directory)
        # It exists from the first record on, so that one that was deleted is not taken for one never begun.
        if not self._journal.files():
            self._journal.append([AuditEntry(time.time(), BEGUN, AUDIT_PEER, {})])
        self._seen = identities(self._journal.records())

    def _filled(self) -> bool:
        head = self._journal.written
        if head is None or head.size < LASTING_MAX_BYTES:
            return False
        if not self._full:
            logger.critical("%s is full: later stops may be rotated out of the audit.", self._journal.path)
        self._full = True
        return True

    @staticmethod
    def _identity(entry: AuditEntry) -> Identity | None:
        return identity(entry.event, entry.peer_id, entry.payload)


def identities(records: Iterable[Mapping[str, Any]]) -> set[Identity]:
    """Return the identities of those records that must last."""
    found = (identity(each.get("event"), each.get("peer_id"), each.get("payload")) for each in records)
    return {each for each in found if each is not None}


def rotated_out(kept: Iterable[dict[str, Any]], records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the kept records that are no longer in the main log."""
    there = identities(records)
    return [
        each
        for each in kept
        if (what := identity(each.get("event"), each.get("peer_id"), each.get("payload"))) and what not in there
    ]


def verify_both(main: Journal, kept: Journal, *, keyed: bool) -> dict[str, Any]:
    """Check both logs, and that the second has every stop of the first.

    The counts are those of the main log; ``kept`` counts the records of the other.
    """
    found, other = verify(main, keyed=keyed), verify(kept, keyed=keyed)
    breaks = [*found["breaks"], *({**each, "where": f"{FOLDER}/{each['where']}"} for each in other["breaks"])]
    # Without a second log there is nothing to compare: an audit without a secret may be older than it.
    absent: set[Identity] = set()
    if kept.files() and not _filled_file(kept):
        stops = {what for what in identities(main.records()) if what[0] != BROKEN}
        absent = stops - identities(kept.records())
    breaks += [
        {"where": f"{FOLDER}/{NAME}", "why": f"the {each[0]} of {each[1]} is not there"} for each in sorted(absent)
    ]
    return {
        **found,
        "kept": other["total"],
        "breaks": breaks[:100],
        "ok": found["ok"] and other["ok"] and not absent,
    }


def _filled_file(kept: Journal) -> bool:
    return kept.path.exists() and kept.path.stat().st_size >= LASTING_MAX_BYTES
