"""Heads of other machines' audits, recorded in one's own.

A robot's verdict carries the head of its machine's audit, and the controller that receives it writes that down. A log
that was rolled back with its head and its anchor is consistent in itself, but no longer has the record that the
witness names.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from strands_robots.audit.head import Anchor, log_id
from strands_robots.audit.journal import Journal, parse
from strands_robots.utils import field_values

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
