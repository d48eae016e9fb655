"""Audit file: one chained record a line, shared by processes, and its check.

A record is sorted compact JSON with ``ts`` (wall-clock s), ``event``, ``peer_id``, ``payload``, ``seq`` (per peer,
never reused), ``prev`` (SHA-256 of the line before it) and, with a key, ``sig`` (HMAC-SHA256 of the rest). The head
file beside it holds what the next record needs and what the last one was, so that a log cut at its end shows too;
it may lag behind after a crash and is then caught up from the log.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import hmac
import json
import os
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.safety.ed25519 import canonical
from strands_robots.utils import shown

NAME = "mesh_audit.jsonl"
GENESIS = "0" * 64
MAX_BYTES = 100 * 2**20
KEPT_FILES = 5
BREAKS_SHOWN = 100
PAYLOAD_MAX_BYTES = 256 * 2**10


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """An event to be recorded."""

    ts: float
    event: str
    peer_id: str
    payload: Any


@dataclass(slots=True)
class Head:
    """State of the chain: last line's hash, its file, last number of each peer.

    ``origin`` is the hash that the oldest kept record continues from.
    """

    last: str = GENESIS
    size: int = 0
    inode: int = 0
    origin: str = GENESIS
    seqs: dict[str, int] = field(default_factory=dict)


class Journal:
    """Audit log in ``directory``. Not thread-safe; a file lock excludes processes.

    Raises, from :meth:`append`:
        OSError: full disk, read-only directory, a link where the log should be, a lost permission.
    """

    def __init__(
        self, directory: Path, key: bytes | None = None, max_bytes: int = MAX_BYTES, kept: int = KEPT_FILES
    ) -> None:
        self.directory = directory
        self.path = directory / NAME
        self._head_path = directory / "mesh_audit.head"
        self._key = key
        self._max_bytes = max_bytes
        self._kept = kept
        self._head: Head | None = None

    def append(self, entries: Sequence[AuditEntry]) -> None:
        """Write every entry and return when all of them are on the disk.

        On an error none is acknowledged, though some may have been written: a second try may record them twice.
        """
        self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with self._locked():
            head = self._current()
            if head.size >= self._max_bytes:
                self._rotate(head)
            self._head = None
            with _opened(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT) as descriptor:
                fresh = os.fstat(descriptor).st_size == 0
                # A torn line of a writer that died is closed off; it was never acknowledged.
                torn = not fresh and not self._ends_whole(head.size)
                lines = b"".join(self._line(entry, head) for entry in entries)
                _write_all(descriptor, (b"\n" if torn else b"") + lines)
                os.fsync(descriptor)
                head.size, head.inode = os.fstat(descriptor).st_size, os.fstat(descriptor).st_ino
            if fresh:
                _sync_directory(self.directory)
            self._save(head)
            self._head = head

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
        return [path for path in (*names, self.path) if path.exists()]

    def signature_valid(self, record: dict[str, Any]) -> bool:
        """True when the key made the record's ``sig``."""
        bare = {name: value for name, value in record.items() if name != "sig"}
        sig = record.get("sig")
        return self._key is not None and isinstance(sig, str) and hmac.compare_digest(sig, self._sign(bare))

    def head(self) -> Head | None:
        """Return the head file's content; None if missing, unreadable or unsigned."""
        try:
            data = json.loads(_read(self._head_path))
            sig = data.pop("sig", "")
            genuine = self._key is None or hmac.compare_digest(sig, self._sign(data))
            return Head(**data) if genuine else None
        except (OSError, ValueError, TypeError, AttributeError):
            return None

    def _line(self, entry: AuditEntry, head: Head) -> bytes:
        seq = head.seqs.get(entry.peer_id, 0) + 1
        record: dict[str, Any] = {
            "ts": entry.ts,
            "event": entry.event,
            "peer_id": entry.peer_id,
            "payload": storable(entry.payload),
            "seq": seq,
            "prev": head.last,
        }
        if self._key is not None:
            record["sig"] = self._sign(record)
        head.seqs[entry.peer_id] = seq
        line = canonical(record)
        head.last = hashlib.sha256(line).hexdigest()
        return line + b"\n"

    def _sign(self, record: dict[str, Any]) -> str:
        return hmac.new(self._key or b"", canonical(record), hashlib.sha256).hexdigest()

    def _current(self) -> Head:
        try:
            status = self.path.lstat()
        except FileNotFoundError:
            size, inode = 0, 0
        else:
            if not stat.S_ISREG(status.st_mode):
                raise OSError(f"{self.path} is no regular file; the audit does not follow links")
            size, inode = status.st_size, status.st_ino
        for head in (self._head, self.head()):
            if head is None or (inode and head.inode != inode) or head.size > size:
                continue
            self._catch_up(head)
            return head
        return self._scan()

    def _catch_up(self, head: Head) -> None:
        with contextlib.suppress(FileNotFoundError), self.path.open("rb") as file:  # the first record is to come
            file.seek(head.size)
            for line in file:
                _advance(head, line.rstrip(b"\n"))
                head.size += len(line)
            head.inode = os.fstat(file.fileno()).st_ino

    def _scan(self) -> Head:
        head = Head()
        for number, (_, _, line) in enumerate(self.lines()):
            record = parse(line)
            if number == 0 and record is not None:
                head.origin = record["prev"]
            _advance(head, line)
        with contextlib.suppress(FileNotFoundError):  # nothing was written yet
            status = self.path.stat()
            head.size, head.inode = status.st_size, status.st_ino
        return head

    def _ends_whole(self, size: int) -> bool:
        with self.path.open("rb") as file:
            file.seek(size - 1)
            return file.read(1) == b"\n"

    def _rotate(self, head: Head) -> None:
        for number in range(self._kept, 0, -1):
            younger = self._rotated(number - 1) if number > 1 else self.path
            if younger.exists():
                younger.replace(self._rotated(number))
        oldest = next(iter(self.lines()), None)
        first = parse(oldest[2]) if oldest else None
        head.origin = first["prev"] if first else head.last
        head.size, head.inode = 0, 0
        _sync_directory(self.directory)

    def _rotated(self, number: int) -> Path:
        return self.path.with_name(f"{NAME}.{number}")

    def _save(self, head: Head) -> None:
        data: dict[str, Any] = {
            "last": head.last,
            "size": head.size,
            "inode": head.inode,
            "origin": head.origin,
            "seqs": head.seqs,
        }
        if self._key is not None:
            data["sig"] = self._sign(data)
        draft = self._head_path.with_suffix(".draft")
        # A head that cannot be written is caught up later; the records are what was promised.
        with (
            contextlib.suppress(OSError),
            _opened(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as descriptor,
        ):
            _write_all(descriptor, canonical(data))
            draft.replace(self._head_path)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        with _opened(self.directory / "mesh_audit.lock", os.O_RDWR | os.O_CREAT) as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield


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
        text = canonical({"payload": payload})
        if len(text) <= PAYLOAD_MAX_BYTES:
            return payload
        reason = f"{len(text)} bytes, more than {PAYLOAD_MAX_BYTES}"
    except (TypeError, ValueError, RecursionError) as exc:
        reason = f"{type(exc).__name__}: {exc}"[:200]
    items = list(payload.items())[:64] if isinstance(payload, dict) else [("value", payload)]
    return {"SERIALISE_FAILED": reason, "kept": {shown(key): shown(value) for key, value in items}}


@dataclass(slots=True)
class Findings:
    """Counts of a check of the log; ``breaks`` are places, in order."""

    total: int = 0
    signed: int = 0
    verified: int = 0
    bad: int = 0
    missing: int = 0
    gaps: int = 0
    torn: int = 0
    broken: int = 0
    breaks: list[dict[str, Any]] = field(default_factory=list)

    def note(self, where: str, why: str) -> None:
        """Remember a break; beyond the first hundred only the counts go on."""
        if len(self.breaks) < BREAKS_SHOWN:
            self.breaks.append({"where": where, "why": why})


def verify(journal: Journal, *, keyed: bool) -> dict[str, Any]:
    """Check the log: its chain, its numbers and its signatures.

    ``bad`` are invalid signatures, ``missing`` records without one although a key is set, ``gaps`` jumps
    in a peer's numbers, ``broken`` records that do not continue the one before, ``torn`` lines that a dying writer
    left and the chain passes over. ``head`` is ok, missing (a cut at the end cannot be excluded) or cut.
    """
    head = journal.head()
    found, last, first = Findings(), head.origin if head else None, True
    seqs: dict[str, int] = {}
    reached_head = head is not None and head.last == head.origin
    for path, number, line in journal.lines():
        where = f"{path.name}:{number}"
        record = parse(line)
        if record is None:
            found.torn += 1
            continue
        found.total += 1
        if last is not None and record["prev"] != last:
            found.broken += 1
            found.note(where, "does not continue the record before it")
        expected = seqs.get(record["peer_id"])
        if expected is not None and record["seq"] != expected + 1:
            found.gaps += 1
            found.note(where, f"{record['peer_id']} went from {expected} to {record['seq']}")
        seqs[record["peer_id"]] = record["seq"]
        _signature(journal, record, found, where, keyed=keyed)
        last, first = hashlib.sha256(line).hexdigest(), False
        reached_head = reached_head or (head is not None and head.last == last)
    standing = "missing" if head is None and not first else "ok" if head is None or reached_head else "cut"
    if standing == "cut":
        found.note("end", "the last record that was acknowledged is not there")
    counts = {name: getattr(found, name) for name in Findings.__slots__}
    whole = not (found.bad or found.missing or found.gaps or found.broken) and standing != "cut"
    return {**counts, "head": standing, "ok": whole}


def _signature(journal: Journal, record: dict[str, Any], found: Findings, where: str, *, keyed: bool) -> None:
    if "sig" not in record:
        if keyed:
            found.missing += 1
            found.note(where, "not signed")
        return
    found.signed += 1
    if not keyed:
        return
    if journal.signature_valid(record):
        found.verified += 1
    else:
        found.bad += 1
        found.note(where, "the signature does not hold")


def _advance(head: Head, line: bytes) -> None:
    record = parse(line)
    if record is None:
        return
    head.last = hashlib.sha256(line).hexdigest()
    head.seqs[record["peer_id"]] = max(record["seq"], head.seqs.get(record["peer_id"], 0))


@contextlib.contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _read(path: Path) -> bytes:
    with _opened(path, os.O_RDONLY) as descriptor:
        return os.read(descriptor, 2**26)


def _write_all(descriptor: int, data: bytes) -> None:
    written = os.write(descriptor, data)
    if written != len(data):
        raise OSError(f"{written} of {len(data)} bytes of the audit record fitted")


def _sync_directory(directory: Path) -> None:
    with _opened(directory, os.O_RDONLY | os.O_DIRECTORY) as descriptor:
        os.fsync(descriptor)
