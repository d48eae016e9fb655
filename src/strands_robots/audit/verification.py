"""Check of an audit log: chain, numbers, signatures, head, anchor and witnesses."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.audit.head import Anchor, Head, Seal, log_id
from strands_robots.audit.journal import BROKEN, Journal, LogSnapshot, anchor_mismatches, parse, replaced
from strands_robots.utils import field_values

BREAKS_SHOWN = 100
SIGNATURES = "signatures"
"""Place of a break that is none of a line: the signatures were not verified."""

FACTS_REPLACED = "its facts could not be written; what could be kept is there as text"


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
    tampered: int = 0
    replaced: int = 0
    sequence_gaps: list[tuple[int, int]] = field(default_factory=list)
    breaks: list[dict[str, Any]] = field(default_factory=list)

    def gap(self, where: str, peer: str, before: int, after: int) -> None:
        """Count a jump in a peer's numbers; the first hundred are listed as pairs."""
        self.gaps += 1
        if len(self.sequence_gaps) < BREAKS_SHOWN:
            self.sequence_gaps.append((before, after))
        self.note(where, f"{peer} went from {before} to {after}")

    def facts(self, record: Mapping[str, Any], where: str) -> None:
        """Count what a record itself says: that the log was changed, or facts lost."""
        payload = record.get("payload")
        if record.get("event") == BROKEN:
            self.tampered += 1
            self.note(where, f"the writer found: {payload.get('why') if isinstance(payload, dict) else payload}")
        if replaced(payload):
            self.replaced += 1
            self.note(where, FACTS_REPLACED)

    def signature(self, record: Mapping[str, Any], where: str, seal: Seal) -> bool:
        """Count a record's signature; False for one that the key did not make."""
        if "sig" not in record:
            if seal.keyed:
                self.missing += 1
                self.note(where, "not signed")
            return not seal.keyed
        self.signed += 1
        if not seal.keyed:
            return False
        valid = seal.valid(record)
        if valid:
            self.verified += 1
        else:
            self.bad += 1
            self.note(where, "the signature does not hold")
        return valid

    def result(self, head: str, *, keyed: bool, ok: bool) -> dict[str, Any]:
        """Return the counts; some of them have a second, longer name."""
        if self.signed and not keyed:
            self.note(SIGNATURES, f"{self.signed} signed records were not verified: there is no secret here")
        return {
            **{name: getattr(self, name) for name in self.__slots__},
            "bad_signature": self.bad,
            "missing_sig": self.missing,
            "unverifiable_signed": 0 if keyed else self.signed,
            "psk_present": keyed,
            "head": head,
            "ok": ok,
        }

    def note(self, where: str, why: str) -> None:
        """Remember a break; beyond the first hundred only the counts go on."""
        if len(self.breaks) < BREAKS_SHOWN:
            self.breaks.append({"where": where, "why": why})

    def whole(self, *, keyed: bool) -> bool:
        """True when nothing was found; a torn line is an offence only where a key is set."""
        found = self.bad or self.missing or self.gaps or self.broken or self.tampered or self.replaced
        return not found and self.verified == self.signed and not (keyed and self.torn)


def verify(journal: Journal, *, keyed: bool) -> dict[str, Any]:
    """Check the log as it is on the disk now.

    ``bad`` are invalid signatures, ``missing`` records without one although a key is set, ``gaps`` jumps in a peer's
    numbers, ``broken`` records that do not continue the one before, ``torn`` lines that are no record, ``tampered``
    what a writer found and recorded as ``audit_broken``, ``replaced`` records whose facts could not be written.
    ``head`` is ok, missing (a cut at the end cannot be excluded), cut (the last record is not there) or older (it was
    rolled back, or the anchor was). With a key everything but ok fails; without one a missing head and torn lines do
    not, but signed records do: they are not verified.
    """
    with journal.snapshot() as snapshot:
        return _Check(journal, snapshot, keyed=keyed).run()


def verify_records(records: Sequence[Mapping[str, Any]], key: bytes | None) -> dict[str, Any]:
    """Check the signatures and the numbers of records that were read before.

    The result is that of :func:`verify`; ``head`` is *unread*, because chain, head and anchor are the file's. A record
    that is not verified does not count for the numbers: a forged one cannot hide that others were left out.
    """
    found, seal = Findings(total=len(records)), Seal(key)
    seqs: dict[str, int] = {}
    for index, record in enumerate(records, 1):
        where, peer, seq = f"record {index}", record.get("peer_id"), record.get("seq")
        found.facts(record, where)
        if not found.signature(record, where, seal):
            continue
        if not isinstance(peer, str) or not isinstance(seq, int) or isinstance(seq, bool):
            found.torn += 1
            found.note(where, "no writer wrote this record")
            continue
        before = seqs.get(peer)
        if before is not None and seq != before + 1:
            found.gap(where, peer, before, seq)
        seqs[peer] = seq if before is None else max(before, seq)
    return found.result("unread", keyed=seal.keyed, ok=found.whole(keyed=seal.keyed))


class _Check:
    def __init__(self, journal: Journal, snapshot: LogSnapshot, *, keyed: bool) -> None:
        self._journal = journal
        self._snapshot, self._announced = _acknowledged(snapshot, journal.path)
        # A log without a key here is not verified, whatever its journal has.
        self._seal = journal.seal if keyed else Seal(None)
        self._keyed = keyed
        self._found = Findings()
        self._seqs: dict[str, int] = {}

    def run(self) -> dict[str, Any]:
        head, found = self._snapshot.head, self._found
        last: str | None = None
        # Counted on behind the head's own record: a writer that died there had announced them.
        reached = head.count if head is not None and head.last == head.origins[0] else None
        anchored = False
        for path, number, raw in self._snapshot.lines():
            where = f"{path.name}:{number}"
            line = raw.removesuffix(b"\n")
            record = parse(line)
            if record is None or line == raw:
                found.torn += 1
                if self._keyed:
                    found.note(where, "no writer wrote this line")
            if record is None:
                continue
            found.total += 1
            self._record(record, where, self._follows(record, last, head))
            last = hashlib.sha256(line).hexdigest()
            anchored = anchored or (self._snapshot.anchor is not None and last == self._snapshot.anchor.last)
            reached = None if reached is None else reached + 1
            if head is not None and last == head.last:
                reached = head.count
        self._names(head)
        standing = self._standing(head, reached, last, anchored=anchored)
        for each in head.breaks if head is not None else ():
            found.tampered += not self._tampering_seen(each)
        whole = found.whole(keyed=self._keyed) and standing in (("ok",) if self._keyed else ("ok", "missing"))
        return found.result(standing, keyed=self._keyed, ok=whole)

    @staticmethod
    def _follows(record: dict[str, Any], last: str | None, head: Head | None) -> bool:
        if last is not None:
            return bool(record["prev"] == last)
        return head is None or record["prev"] in head.origins[: 2 if head.rotating else 1]

    def _names(self, head: Head | None) -> None:
        """Find a renamed file: only a rotation leaves a gap in their numbers."""
        files = [path for path, _, size in self._snapshot.files if size]
        if head is not None and head.size and not head.rotating and not self._journal.in_order(files):
            self._found.broken += 1
            self._found.note("files", f"not in the order of rotation: {', '.join(each.name for each in files)}")

    def _record(self, record: dict[str, Any], where: str, follows: bool) -> None:
        found, peer = self._found, record["peer_id"]
        if not follows:
            found.broken += 1
            found.note(where, "does not continue the record before it")
        expected = self._seqs.get(peer)
        if expected is not None and record["seq"] != expected + 1:
            found.gap(where, peer, expected, record["seq"])
        self._seqs[peer] = record["seq"]
        found.facts(record, where)
        found.signature(record, where, self._seal)

    def _tampering_seen(self, record: dict[str, Any]) -> bool:
        """True when the record of a break that the head names is still in the log."""
        if self._found.tampered:
            return True
        self._found.note("head", f"the writer found: {record.get('why')}")
        return False

    def _standing(self, head: Head | None, reached: int | None, last: str | None, *, anchored: bool) -> str:
        anchor, found = self._snapshot.anchor, self._found
        if head is None:
            if anchor is not None and anchor.count and not anchored and not self._keyed:
                found.note("end", f"record {anchor.count}, which the anchor has, is not there")
                return "cut"
            if self._keyed:
                found.note("head", "there is none that is signed with this secret")
            return "missing" if self._keyed or last is not None else "ok"
        if reached is None or self._short(head):
            found.note("end", "the last record that was acknowledged is not there")
            return "cut"
        ended = Head(head.log, count=reached, last=last or head.last)
        wrong = anchor_mismatches(ended, anchor, head.count, keyed=self._keyed)
        # A head of before a rotation may have the very size of the file that is current now.
        announced = sum(bool(line) for line in head.pending.splitlines())
        if self._keyed and not (self._announced and reached - head.count in (0, announced)):
            wrong.append("the head is older than the log")
        for why in wrong:
            found.note("end", why)
        return "older" if wrong else "ok"

    def _short(self, head: Head) -> bool:
        size = next((size for path, _, size in self._snapshot.files if path == self._journal.path), None)
        if size is None:
            return head.size > 0 and not head.rotating
        return size < head.size and not head.rotating


def _acknowledged(snapshot: LogSnapshot, current: Path) -> tuple[LogSnapshot, bool]:
    """Leave out what a dead writer began; False when no head announced it.

    The next writer completes it.
    """
    head = snapshot.head
    if head is None:
        return snapshot, True
    files, announced = [], True
    for path, file, size in snapshot.files:
        until = size
        if path == current and size > head.size:
            file.seek(head.size)
            begun = file.read(size - head.size)
            announced = head.pending.encode().startswith(begun)
            if announced and len(begun) < len(head.pending):
                until = head.size
        files.append((path, file, until))
    return LogSnapshot(head, snapshot.anchor, tuple(files)), announced


WITNESS = "audit_witness"

_LOG, _DIGEST = re.compile(r"[0-9a-f]{32}\Z"), re.compile(r"[0-9a-f]{64}\Z")


def stated_head(head: Anchor | None) -> dict[str, Any] | None:
    """Return a head as a verdict carries it."""
    return None if head is None else field_values(head)


def witnessed(value: object) -> Anchor | None:
    """Return the head that a verdict carries; None for anything else."""
    if not isinstance(value, Mapping):
        return None
    log, count, last = (value.get(name) for name in ("log", "count", "last"))
    if not (isinstance(log, str) and isinstance(last, str) and isinstance(count, int)) or isinstance(count, bool):
        return None
    return Anchor(log, count, last) if _LOG.match(log) and _DIGEST.match(last) and 0 < count < 2**53 else None


def compare(journal: Journal, files: Iterable[Path]) -> tuple[int, list[dict[str, Any]]]:
    """Compare a log with the witnesses in the audit files of other machines.

    A robot's verdict carries the head of its machine's audit, and the controller that receives it writes that down. A
    log that was rolled back with its head and its anchor is consistent in itself, but no longer has the record that
    the witness names.

    Returns how many of their records are about this log, and what it no longer has. A record that was rotated out of
    the log cannot be compared.

    Raises:
        OSError: a file cannot be read.
    """
    witnesses = [each for path in files for each in _witnesses(path, log_id(journal.path))]
    wanted = {head.last for _, _, head in witnesses}
    there, total = {}, 0
    for _, _, line in journal.lines():
        if parse(line) is not None:
            total += 1
            digest = hashlib.sha256(line).hexdigest()
            if digest in wanted:
                there[digest] = total
    with journal.snapshot() as now:
        count = now.head.count if now.head is not None else total
    gone = []
    for where, seen_by, head in witnesses:
        if head.last not in there and head.count > count - total:
            why = f"record {head.count}, which {seen_by} saw, is not there: it was rolled back or written anew"
            gone.append({"where": where, "why": why})
    return len(witnesses), gone


def _witnesses(path: Path, log: str) -> Iterable[tuple[str, str, Anchor]]:
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            record = parse(line.rstrip(b"\n"))
            payload = record.get("payload") if record is not None and record.get("event") == WITNESS else None
            head = witnessed(payload)
            if head is not None and head.log == log and isinstance(payload, Mapping):
                how = "signed" if payload.get("signed") is True else "claimed"
                yield f"{path.name}:{number}", f"{payload.get('witness')} ({how})", head
