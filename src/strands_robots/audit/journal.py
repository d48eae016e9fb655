"""Audit file: one chained record a line, shared by processes.

A record is sorted compact JSON with ``ts`` (wall-clock s), ``event``, ``peer_id``, ``payload``, ``seq`` (per peer,
never reused), ``prev`` (SHA-256 of the line before it) and, with a key, ``sig`` (HMAC-SHA256 of the rest). The head
beside it and the anchor elsewhere say where it ends (:mod:`strands_robots.audit.head`). A writer that finds the log,
the head and the anchor at odds records :data:`BROKEN` and goes on; the check fails from then on.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import random
import stat
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from strands_robots.audit.head import (
    BREAKS_KEPT,
    GENESIS,
    Anchor,
    Head,
    Seal,
    log_id,
    opened,
    read_anchor,
    read_head,
    signed_head,
    sync_directory,
    write_all,
    write_anchor,
    write_head,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import canonical_json, shown

logger = stop_logger(__name__)

NAME = "mesh_audit.jsonl"
BROKEN = "audit_broken"
AUDIT_PEER = "audit"
MAX_BYTES = 100 * 2**20
KEPT_FILES = 5
PAYLOAD_MAX_BYTES = 256 * 2**10
REPLACED = "SERIALISE_FAILED"
"""Field of a payload in place of facts that could not be written, with the reason."""

LOCK_S = 10.0
"""Seconds that a writer or a reader waits for the other processes."""

WRITE_BYTES = 2**20
"""Bytes after which a write ends and the next begins: the head names the lines of one write."""

TAIL_MAX_BYTES = 64 * 2**20
"""Longest part behind the head that is looked at; a writer that died leaves one write."""


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """An event to be recorded."""

    ts: float
    event: str
    peer_id: str
    payload: Any


@dataclass(frozen=True, slots=True)
class LogSnapshot:
    """State of a log at one moment: head, anchor, files and their sizes."""

    head: Head | None
    anchor: Anchor | None
    files: tuple[tuple[Path, BinaryIO, int], ...]

    def lines(self) -> Iterator[tuple[Path, int, bytes]]:
        """Yield file, line number from 1 and bytes of every line, with its end."""
        for path, file, size in self.files:
            file.seek(0)
            left = size
            for number, line in enumerate(file, 1):
                if left <= 0:
                    break
                yield path, number, line[:left]
                left -= len(line)


class Journal:
    """Audit log in ``directory``. Not thread-safe; a file lock excludes processes.

    Args:
        anchor: file of the anchor; by default below ``directory``.
        kept: rotated files that are stored besides the current one; 0 means that the log is never rotated.

    Raises, from :meth:`append`:
        OSError: full disk, read-only directory, a link where the log should be, a lost permission.
    """

    def __init__(
        self,
        directory: Path,
        key: bytes | None = None,
        max_bytes: int = MAX_BYTES,
        kept: int = KEPT_FILES,
        *,
        name: str = NAME,
        anchor: Path | None = None,
    ) -> None:
        self.directory = directory
        self.path = directory / name
        self._head_path = self.path.with_suffix(".head")
        self._anchor_path = anchor or directory / "anchors" / name
        self._seal = Seal(key)
        self._max_bytes = max_bytes
        self._kept = kept
        self._head: Head | None = None

    @property
    def written(self) -> Head | None:
        """Head after the last write of this object."""
        return self._head

    def stored(self) -> Head | None:
        """Return the head after the last write, of this object or any before it."""
        return self._head or read_head(self._head_path, self._seal, log_id(self.path))

    def append(self, entries: Sequence[AuditEntry]) -> None:
        """Write every entry and return when all of them are on the disk.

        On an error none is acknowledged, though some may have been written: a second try may record them twice.
        """
        self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        waiting = list(entries)
        with self._locked():
            while waiting:
                del waiting[: self._write(waiting)]

    def lines(self) -> Iterator[tuple[Path, int, bytes]]:
        """Yield file, line number from 1 and bytes of every line, oldest first."""
        for path in self.files():
            with contextlib.suppress(FileNotFoundError), path.open("rb") as file:  # rotated away meanwhile
                for number, line in enumerate(file, 1):
                    yield path, number, line.rstrip(b"\n")

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield every whole record, oldest first."""
        for _, _, line in self.lines():
            record = parse(line)
            if record is not None:
                yield record

    def files(self) -> list[Path]:
        """Return the files that exist, oldest first."""
        names = [self._rotated(number) for number in range(self._kept, 0, -1)]
        # A pipe is none: reading it would not end.
        return [path for path in (*names, self.path) if path.is_file()]

    def in_order(self, files: Sequence[Path]) -> bool:
        """True when the numbers of these files have no gap."""
        return list(files) == [*(self._rotated(number) for number in range(len(files) - 1, 0, -1)), self.path]

    @property
    def seal(self) -> Seal:
        """Signature of the records."""
        return self._seal

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[LogSnapshot]:
        """Give the log as it is now; writers go on meanwhile."""
        with contextlib.ExitStack() as files:
            with contextlib.ExitStack() as lock:
                with contextlib.suppress(FileNotFoundError):  # nothing was written yet
                    lock.enter_context(self._locked(shared=True))
                log = log_id(self.path)
                head = read_head(self._head_path, self._seal, log)
                found = [(path, files.enter_context(path.open("rb"))) for path in self.files()]
                sized = tuple((path, file, os.fstat(file.fileno()).st_size) for path, file in found)
                anchor = read_anchor(self._anchor_path, self._seal, log)
            yield LogSnapshot(head, anchor, sized)

    def _write(self, entries: Sequence[AuditEntry]) -> int:
        """Write the first entries, at least one; return how many."""
        head, mismatches = self._recover()
        self._note(head, mismatches)
        if self._kept and head.size >= self._max_bytes:
            mismatches += self._rotate(head)
        after = head.copy()
        alarms = [AuditEntry(time.time(), BROKEN, AUDIT_PEER, {"why": why}) for why in mismatches]
        lines = [self._line(each, after) for each in alarms]
        done = length = 0
        while done < len(entries) and length < WRITE_BYTES:
            lines.append(self._line(entries[done], after))
            length += len(lines[-1])
            done += 1
        with opened(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT) as descriptor:
            # A torn line is closed off; it was never acknowledged.
            text = (b"" if _ends_whole(descriptor) else b"\n") + b"".join(lines)
            if head.inode == 0:
                head.inode = os.fstat(descriptor).st_ino
                sync_directory(self.directory)
            head.pending = text.decode("ascii")
            write_head(self._head_path, self._seal, head, durable=True)
            write_all(descriptor, text)
            os.fsync(descriptor)
            after.size, after.inode = os.fstat(descriptor).st_size, os.fstat(descriptor).st_ino
        self._finish(after)
        return done

    def _finish(self, head: Head) -> None:
        write_anchor(self._anchor_path, self._seal, Anchor(head.log, head.count, head.last))
        head.pending, head.rotating = "", False
        # The head on the disk names the lines that are written by now: without this one it is caught up.
        with contextlib.suppress(OSError):
            write_head(self._head_path, self._seal, head, durable=False)
        self._head = head

    def _line(self, entry: AuditEntry, head: Head) -> bytes:
        record = self._seal.sign(
            {
                "ts": entry.ts,
                "event": entry.event,
                "peer_id": entry.peer_id,
                "payload": storable(entry.payload),
                "seq": head.seqs.get(entry.peer_id, 0) + 1,
                "prev": head.last,
            }
        )
        line = canonical_json(record)
        head.advance(line, record)
        return line + b"\n"

    def _recover(self) -> tuple[Head, list[str]]:
        """Return the state to go on from, and every mismatch of log, head and anchor."""
        log = log_id(self.path)
        size, inode = self._status()
        anchor = read_anchor(self._anchor_path, self._seal, log)
        found = read_head(self._head_path, self._seal, log)
        if found is None and self._head is None and self._untouched(size):
            write_anchor(self._anchor_path, self._seal, Anchor(log, 0, GENESIS))
            return Head(log), []
        signed = self._head is None and not self._seal.keyed and signed_head(self._head_path)
        head, mismatches = self._believed(found, anchor, log)
        if signed:
            mismatches.append("it is signed, and this process has no secret")
        if head.rotating and inode != head.inode and self._renamed(head):
            head.rotated(self._kept)
        announced_from = head.count
        # A log that does not fit its head is not caught up.
        why = self._misfit(head, size, inode) or self._catch_up(head)
        if why is not None:
            mismatches.append(why)
        mismatches += anchor_mismatches(head, anchor, announced_from, keyed=self._seal.keyed)
        if mismatches:
            head.size, head.inode = self._status()
            head.count = max(head.count, anchor.count if anchor else 0)
        elif anchor is None or anchor.count < head.count:
            write_anchor(self._anchor_path, self._seal, Anchor(log, head.count, head.last))
        head.pending = ""
        return head, mismatches

    def _untouched(self, size: int) -> bool:
        if size or self._head_path.exists() or any(path != self.path for path in self.files()):
            return False
        begun = read_anchor(self._anchor_path, self._seal, log_id(self.path))
        return begun.count == 0 if begun is not None else not self._anchor_path.exists()

    def _believed(self, found: Head | None, anchor: Anchor | None, log: str) -> tuple[Head, list[str]]:
        own = None if self._head is None else self._head.copy()
        if found is None:
            missing = ["its head is missing, changed or not signed with this secret"] if self._seal.keyed else []
            return own or self._scan(log, anchor), missing
        if own is not None and found.count + found.pending.count("\n") < own.count:
            return own, [f"its head is rolled back to record {found.count}; this process wrote record {own.count}"]
        if own is not None and found.count == own.count and found.last != own.last:
            return own, [f"its head has another record {own.count} than this process wrote"]
        return found, []

    def _misfit(self, head: Head, size: int, inode: int) -> str | None:
        if inode == 0:
            return "it is gone" if head.size else None
        if head.inode not in (0, inode):
            return "another file is in its place"
        if size < head.size:
            return f"it was cut from {head.size} to {size} bytes"
        if head.line:
            with self.path.open("rb") as file:
                file.seek(max(head.size - head.line, 0))
                line = file.read(head.line)
            torn = not line.endswith(b"\n") and not self._seal.keyed
            if hashlib.sha256(line[:-1]).hexdigest() != head.last and not torn:
                return "its last record was changed"
        return None

    def _catch_up(self, head: Head) -> str | None:
        """Go over what a writer left behind that died; return why it is no writer's."""
        pending = head.pending.encode()
        tail = self._tail(head.size)
        if pending.startswith(tail):
            self._complete(head, pending, tail)
            return None
        if self._seal.keyed or len(tail) > TAIL_MAX_BYTES:
            return "its end is none that its head announced"
        for line in tail.split(b"\n"):
            record = parse(line)
            if record is not None:
                if not head.expects(record):
                    return "its end does not continue it"
                head.advance(line, record)
        head.size += len(tail)
        return None

    def _complete(self, head: Head, pending: bytes, tail: bytes) -> None:
        if len(tail) < len(pending):
            with opened(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT) as descriptor:
                write_all(descriptor, pending[len(tail) :])
                os.fsync(descriptor)
        for line in pending.splitlines():
            record = parse(line)
            if record is not None:
                head.advance(line, record)
        head.size += len(pending)

    def _tail(self, start: int) -> bytes:
        with contextlib.suppress(FileNotFoundError), self.path.open("rb") as file:  # the first record is to come
            file.seek(start)
            return file.read(TAIL_MAX_BYTES + 1)
        return b""

    def _scan(self, log: str, anchor: Anchor | None) -> Head:
        """Return the state as the log shows it, numbered by the anchor's record."""
        head, origins = Head(log), []
        for _, number, line in self.lines():
            record = parse(line)
            if number == 1:
                origins.append(record["prev"] if record is not None else head.last)
            if record is None:
                continue
            head.advance(line, record)
            if anchor is not None and head.last == anchor.last:
                head.count = anchor.count
        head.origins = origins or head.origins
        head.size, head.inode = self._status()
        return head

    def _note(self, head: Head, mismatches: Sequence[str]) -> None:
        for why in mismatches:
            logger.critical("The safety audit %s was tampered with: %s.", self.path, why)
            if len(head.breaks) < BREAKS_KEPT:
                head.breaks.append({"ts": time.time(), "why": why})

    def _status(self) -> tuple[int, int]:
        try:
            status = self.path.lstat()
        except FileNotFoundError:
            return 0, 0
        if not stat.S_ISREG(status.st_mode):
            raise OSError(f"{self.path} is no regular file; the audit does not follow links")
        return status.st_size, status.st_ino

    def _rotate(self, head: Head) -> list[str]:
        """Rename the files; return what was wrong with the one that is removed."""
        # A rotation that a dying writer left half done has a gap, up to which the files are renamed.
        gap = next((number for number in range(1, self._kept + 1) if not self._rotated(number).exists()), self._kept)
        mismatches = [] if head.rotating else self._dropping(head)
        self._note(head, mismatches)
        head.rotating = True
        write_head(self._head_path, self._seal, head, durable=True)
        for number in range(gap, 0, -1):
            younger = self._rotated(number - 1) if number > 1 else self.path
            younger.replace(self._rotated(number))
        head.rotated(min(self._kept, len(self.files())))
        sync_directory(self.directory)
        return mismatches

    def _dropping(self, head: Head) -> list[str]:
        files = self.files()
        if len(files) != len(head.origins):
            return [f"it has {len(files)} files of {len(head.origins)}"]
        if not self.in_order(files):
            return ["its rotated files were renamed"]
        if len(files) <= self._kept or continues(files[0], head.origins[0], head.origins[1]):
            return []
        return [f"records were changed in {files[0].name}, the oldest file, which is removed now"]

    def _renamed(self, head: Head) -> bool:
        with contextlib.suppress(FileNotFoundError):  # it was not renamed
            status = self._rotated(1).lstat()
            return (status.st_ino, status.st_size) == (head.inode, head.size)
        return False

    def _rotated(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}")

    @contextlib.contextmanager
    def _locked(self, *, shared: bool = False) -> Iterator[None]:
        flags = os.O_RDONLY if shared else os.O_RDWR | os.O_CREAT
        with opened(self.path.with_suffix(".lock"), flags) as descriptor:
            _lock(descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, self.path)
            yield


def anchor_mismatches(head: Head, anchor: Anchor | None, lowest: int, *, keyed: bool) -> list[str]:
    """Return what is wrong with the anchor of a log that was read to its end.

    It is written before the head: only records above ``lowest``, which a dead writer had announced, may be ahead of it.
    """
    if anchor is None:
        return ["its anchor is missing, changed or not signed with this secret"] if keyed else []
    if anchor.count > head.count:
        return [f"it is rolled back to record {head.count}; its anchor has record {anchor.count}"]
    if anchor.count == head.count and anchor.last != head.last:
        return [f"its anchor has another record {anchor.count}"]
    if anchor.count < lowest:
        return [f"its anchor is rolled back to record {anchor.count}, of {head.count}"]
    return []


def continues(path: Path, start: str, end: str) -> bool:
    """True when the lines of a file are one chain from ``start`` to ``end``."""
    last = start
    with path.open("rb") as file:
        for raw in file:
            line = raw.removesuffix(b"\n")
            if line == raw or f'"prev":"{last}"'.encode() not in line:
                return False
            last = hashlib.sha256(line).hexdigest()
    return last == end


def parse(line: bytes) -> dict[str, Any] | None:
    """Return the record of a line, or None for one that was torn or is no record."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    fits = isinstance(record, dict) and isinstance(record.get("prev"), str) and isinstance(record.get("seq"), int)
    return record if fits and isinstance(record.get("peer_id"), str) else None


def storable(payload: Any) -> Any:
    """Return ``payload`` as JSON can hold it, else a record that says so."""
    try:
        text = canonical_json({"payload": payload})
        if len(text) <= PAYLOAD_MAX_BYTES:
            return payload
        reason = f"{len(text)} bytes, more than {PAYLOAD_MAX_BYTES}"
    except (TypeError, ValueError, RecursionError) as exc:
        reason = f"{type(exc).__name__}: {exc}"[:200]
    items = list(payload.items())[:64] if isinstance(payload, dict) else [("value", payload)]
    return {REPLACED: reason, "kept": {shown(key): shown(value) for key, value in items}}


def replaced(payload: object) -> bool:
    """True for what :func:`storable` made of a payload."""
    return isinstance(payload, dict) and REPLACED in payload


def _lock(descriptor: int, kind: int, path: Path) -> None:
    """Lock within :data:`LOCK_S`; raise OSError where another process keeps it."""
    deadline = time.monotonic() + LOCK_S
    pause = 0.001
    while True:
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError as exc:
            if time.monotonic() >= deadline:
                raise OSError(f"another process has kept {path} locked for {LOCK_S:g} s") from exc
            # By chance, so that a writer that is always busy leaves a turn to the others.
            time.sleep(random.uniform(0.5, 1.0) * pause)
            pause = min(0.02, 1.5 * pause)
        else:
            return


def _ends_whole(descriptor: int) -> bool:
    size = os.fstat(descriptor).st_size
    return size == 0 or os.pread(descriptor, 1, size - 1) == b"\n"
