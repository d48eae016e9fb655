"""First stops, their verdicts and resumes, which later noise never displaces.

The main log is rotated, so that a flood of other events would end with nothing else in it. The first record of each
stop and each resume of a robot is written to a second log as well, which is chained, signed and anchored alike and is
never rotated. At :data:`LASTING_MAX_BYTES` it takes no more.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from strands_robots.audit.journal import AUDIT_PEER, BROKEN, NAME, AuditEntry, Journal
from strands_robots.audit.verification import verify
from strands_robots.state_files import make_private
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

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
