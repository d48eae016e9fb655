"""Does an audit log hold together? Counts, and the place of every break."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any

from strands_robots.safety.journal import Journal, parse

BREAKS_SHOWN = 100


@dataclass(slots=True)
class Findings:
    """What a walk over the log found; ``breaks`` says where, first one first."""

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
    """Walk the log once.

    ``bad`` are signatures that do not hold, ``missing`` records without one although a key is set, ``gaps`` jumps
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
    if journal.signature_holds(record):
        found.verified += 1
    else:
        found.bad += 1
        found.note(where, "the signature does not hold")
