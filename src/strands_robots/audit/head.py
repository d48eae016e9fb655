"""Head and anchor of an audit log: small signed files that say where it ends.

The head lies beside the log and holds what the next record needs. Before each write it names the lines to come, so
that a writer that died in between is told from a stranger. The anchor lies elsewhere and holds the number of records
alone: a log and a head that are older than the anchor were rolled back.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import os
import socket
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from strands_robots.state_files import make_private
from strands_robots.utils import canonical_json, field_values

GENESIS = "0" * 64
BREAKS_KEPT = 20
_MACHINE_ID = Path("/etc/machine-id")


class Seal:
    """Signature of records, heads and anchors; none without a key."""

    def __init__(self, key: bytes | None) -> None:
        self._key = key

    @property
    def keyed(self) -> bool:
        """True when there is a key."""
        return self._key is not None

    def sign(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return ``fields`` with their signature as ``sig``; bare without a key."""
        return fields if self._key is None else {**fields, "sig": self._signature(fields)}

    def valid(self, fields: Mapping[str, Any]) -> bool:
        """True when the key made the ``sig`` of these fields; never an error."""
        sig = fields.get("sig")
        bare = {name: value for name, value in fields.items() if name != "sig"}
        if self._key is None or not isinstance(sig, str) or not sig.isascii():
            return False
        try:
            return hmac.compare_digest(sig, self._signature(bare))
        except (ValueError, RecursionError):  # no writer wrote a number that JSON cannot carry
            return False

    def read(self, data: bytes) -> dict[str, Any] | None:
        """Return the fields of a file, or None unless :meth:`sign` made its bytes."""
        try:
            fields = json.loads(data)
            if not isinstance(fields, dict) or canonical_json(fields) != data:
                return None
            if self.keyed and not self.valid(fields):
                return None
        except (ValueError, TypeError, RecursionError):
            return None
        fields.pop("sig", None)
        return fields

    def _signature(self, fields: Mapping[str, Any]) -> str:
        return hmac.new(self._key or b"", canonical_json(fields), hashlib.sha256).hexdigest()


@dataclass(slots=True)
class Head:
    """State of the chain after the last write.

    ``count`` are the records ever written, ``last`` is the hash of the last line and ``line`` its length, ``origins``
    the hashes that the stored files continue from, the oldest file first, ``rotating`` is true while they are renamed,
    ``seqs`` has the last number of each peer, ``pending`` the lines that are being written, ``breaks`` the mismatches
    that a writer found.
    """

    log: str
    count: int = 0
    last: str = GENESIS
    line: int = 0
    size: int = 0
    inode: int = 0
    origins: list[str] = field(default_factory=lambda: [GENESIS])
    rotating: bool = False
    seqs: dict[str, int] = field(default_factory=dict)
    pending: str = ""
    breaks: list[dict[str, Any]] = field(default_factory=list)

    def copy(self) -> Head:
        """Return a head that goes on by itself."""
        return replace(self, origins=list(self.origins), seqs=dict(self.seqs), breaks=list(self.breaks))

    def advance(self, line: bytes, record: Mapping[str, Any]) -> None:
        """Go on by one record, ``line`` without its end."""
        self.count += 1
        self.last = hashlib.sha256(line).hexdigest()
        self.line = len(line) + 1
        self.seqs[record["peer_id"]] = max(record["seq"], self.seqs.get(record["peer_id"], 0))

    def rotated(self, kept: int) -> None:
        """Go on in a new file, beside which ``kept`` older ones are stored."""
        self.origins = [*self.origins, self.last][-(kept + 1) :]
        self.rotating = False
        self.size, self.inode, self.line = 0, 0, 0

    def expects(self, record: Mapping[str, Any]) -> bool:
        """True when ``record`` continues the chain."""
        following = self.seqs.get(record["peer_id"], 0) + 1
        return bool(record["prev"] == self.last and record["seq"] == following)


@dataclass(frozen=True, slots=True)
class Anchor:
    """Number and hash of the last record, kept apart from the log and its head."""

    log: str
    count: int
    last: str


def log_id(path: Path) -> str:
    """Return the name of a log: its machine, its directory and its file."""
    machine = socket.gethostname()
    with contextlib.suppress(OSError):  # a container may have none
        machine = _MACHINE_ID.read_text(encoding="ascii", errors="replace").strip() or machine
    return hashlib.sha256(f"{machine}:{path.parent.resolve() / path.name}".encode()).hexdigest()[:32]


def read_head(path: Path, seal: Seal, log: str) -> Head | None:
    """Return the head in ``path``; None if missing, changed, or of another log."""
    try:
        fields = seal.read(read_bytes(path))
        head = None if fields is None else Head(**fields)
    except (OSError, TypeError):
        return None
    return head if head is not None and head.log == log else None


def signed_head(path: Path) -> bool:
    """True when a head is there that was written with a secret."""
    try:
        fields = json.loads(read_bytes(path))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(fields, dict) and "sig" in fields


def write_head(path: Path, seal: Seal, head: Head, *, durable: bool) -> None:
    """Replace the head in ``path``; with ``durable``, return when it is on the disk."""
    draft = path.with_suffix(".draft")
    with opened(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as descriptor:
        write_all(descriptor, canonical_json(seal.sign(field_values(head))))
        if durable:
            os.fsync(descriptor)
    draft.replace(path)
    if durable:
        sync_directory(path.parent)


def read_anchor(path: Path, seal: Seal, log: str) -> Anchor | None:
    """Return the anchor in ``path``; None if missing, changed, or of another log."""
    try:
        fields = seal.read(read_bytes(path))
        anchor = None if fields is None else Anchor(**fields)
    except (OSError, TypeError):
        return None
    return anchor if anchor is not None and anchor.log == log else None


def write_anchor(path: Path, seal: Seal, anchor: Anchor) -> None:
    """Write the anchor in place, within one sector, and wait for the disk."""
    make_private(path.parent)
    data = canonical_json(seal.sign(field_values(anchor)))
    with opened(path, os.O_WRONLY | os.O_CREAT) as descriptor:
        fresh = os.fstat(descriptor).st_size == 0
        write_all(descriptor, data)
        os.ftruncate(descriptor, len(data))
        os.fsync(descriptor)
    if fresh:
        sync_directory(path.parent)


@contextlib.contextmanager
def opened(path: Path, flags: int) -> Iterator[int]:
    """Open a file of the audit, made for its owner alone; refuse links and pipes.

    Raises:
        OSError: it cannot be opened, or is no regular file.
    """
    # Not blocking: a pipe in the place of a file would hold up its writer for good.
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK, 0o600)
    try:
        if not flags & os.O_DIRECTORY and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(f"{path} is no regular file; the audit does not follow links or pipes")
        yield descriptor
    finally:
        os.close(descriptor)


def read_bytes(path: Path, longest: int = 2**26) -> bytes:
    """Return the bytes of a small file."""
    with opened(path, os.O_RDONLY) as descriptor:
        return os.read(descriptor, longest)


def write_all(descriptor: int, data: bytes) -> None:
    """Write ``data``, or raise OSError when less than all of it fitted."""
    written = os.write(descriptor, data)
    if written != len(data):
        raise OSError(f"{written} of {len(data)} bytes of the audit record fitted")


def sync_directory(directory: Path) -> None:
    """Return when the names in ``directory`` are on the disk."""
    with opened(directory, os.O_RDONLY | os.O_DIRECTORY) as descriptor:
        os.fsync(descriptor)
