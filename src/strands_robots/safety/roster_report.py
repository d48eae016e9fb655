"""Report of a standing controller: the robots that it misses after a stop."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from strands_robots.safety.consoles import kept_consoles, stated_consoles
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.orders import estop_keys
from strands_robots.safety.resume import is_epoch
from strands_robots.safety.roster import REPORTED_MAX, RosterRow, bounded
from strands_robots.safety.sightings import Known
from strands_robots.safety.statements import Purpose, own_key
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, identifier

logger = stop_logger(__name__)

STOP_ROSTER = "stopRoster"

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
