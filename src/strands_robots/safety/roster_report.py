"""Reports of standing controllers: the robots that they miss after a stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from strands_robots.safety.identity import KeyFileError, kept_consoles, stated_consoles
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.orders import estop_keys, params_of
from strands_robots.safety.roster import REPORTED_MAX, RosterRow, bounded
from strands_robots.safety.sightings import Known
from strands_robots.safety.statements import Purpose, own_key
from strands_robots.safety.stop_link import STOP_ROSTER, FairQueue
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, identifier

logger = stop_logger(__name__)

REPORT_MAX_BYTES = 16 * 2**10
"""Longest message; a longer one is not read."""

CELL_MAX = 64
MORE_MAX = 1_000_000


@dataclass(frozen=True, slots=True)
class RosterReport:
    """Robots that a standing controller misses after one stop.

    Attributes:
        source: the controller, as it calls itself.
        rows: that it misses; at most 64.
        more: number of those that it misses besides.
        trusted: a key that is known here signed it.
    """

    source: str
    estop_id: str
    rows: tuple[RosterRow, ...]
    more: int
    trusted: bool


def report_fields(estop_id: str, missing: Sequence[RosterRow]) -> dict[str, Any]:
    """Return the fields of a report, the surest and longest heard robots first."""
    rows, more = bounded(missing)
    named = [
        {"name": row.name, "how": row.known.name.lower(), **({"cell": row.cell[:CELL_MAX]} if row.cell else {})}
        for row in rows
    ]
    return {"estop_id": estop_id, "missing": named, "more": more}


def read_report(source: str, fields: Mapping[str, Any], trusted: Collection[bytes]) -> RosterReport | None:
    """Read the fields of a report; None for what is none.

    Args:
        source: as the topic names it.
        trusted: public keys of which one must have signed a report that counts.
    """
    estop_id, missing, more = fields.get("estop_id"), fields.get("missing"), fields.get("more")
    if not is_epoch(estop_id) or not isinstance(missing, list):
        return None
    read = [_row(each) for each in missing[:REPORTED_MAX]]
    rows = {row.name: row for row in read if row is not None}
    beyond = more if isinstance(more, int) and not isinstance(more, bool) and 0 <= more <= MORE_MAX else 0
    key = own_key(Purpose.STOP_ROSTER, source, fields)
    return RosterReport(source, str(estop_id), tuple(rows.values()), beyond, key is not None and key in trusted)


def trusted_controllers() -> frozenset[bytes]:
    """Return the public keys whose reports count; it reads the disk."""
    keys = {*estop_keys(), *stated_consoles()}
    try:
        keys |= kept_consoles()
    except (KeyFileError, OSError) as exc:
        logger.critical("The keys of consoles cannot be used, so their reports do not count: %s", exc)
    return frozenset(keys)


def _row(stated: object) -> RosterRow | None:
    """Return a robot of a report, or None; what it says of itself is not believed."""
    if not isinstance(stated, Mapping):
        return None
    how, cell = stated.get("how"), stated.get("cell")
    try:
        name = identifier("name", stated.get("name"))
    except ValidationError:
        return None
    known = Known.__members__.get(how.upper(), Known.HEARD) if isinstance(how, str) and len(how) < 16 else Known.HEARD
    fits = isinstance(cell, str) and len(cell) <= CELL_MAX and cell.isprintable()
    return RosterRow(name, known, cell=str(cell) if fits else "")


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
