"""Robots of the roster without a sign since a stop, before others are freed."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from strands_robots.safety.lockout import Lockout
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.persistence import StoredLockout
from strands_robots.safety.roster import Roster, RosterRow
from strands_robots.safety.sightings import sightings, this_moment
from strands_robots.safety.stop_roster import NAMED_MAX, counts
from strands_robots.state_files import uptime


@dataclass(frozen=True, slots=True)
class Unheard:
    """Robots that were not heard, and why there may be more."""

    names: tuple[str, ...] = ()
    problem: str = ""

    def __bool__(self) -> bool:
        return bool(self.names or self.problem)

    def __str__(self) -> str:
        more = f" and {len(self.names) - NAMED_MAX} more" if len(self.names) > NAMED_MAX else ""
        said = [f"NOT HEARD: {', '.join(self.names[:NAMED_MAX])}{more}."] if self.names else []
        said += [f"NOT KNOWN who was not heard: {self.problem}."] if self.problem else []
        return f"{' '.join(said)} Robots that are freed keep no stop for one that comes back."


def unheard_now(network: NetworkKey, heard: Collection[str]) -> Unheard:
    """Return the robots of the roster that are not among ``heard``.

    Names that were only heard are left out where robots are enrolled. It reads the disk.
    """
    try:
        roster = Roster.of(network)
    except Exception as exc:  # noqa: BLE001 - said in place of the names
        return Unheard(problem=f"the roster cannot be read: {exc}")
    names = (row.name for row in roster.rows if counts(roster, row) and row.name not in heard)
    return Unheard(tuple(names), "; ".join(roster.problems))


def unheard_since(freed: Collection[str], stored: Mapping[str, StoredLockout]) -> Unheard:
    """Return the robots without a sign since the stops that lock ``freed``.

    It asks no network, so that it works without one: a robot of this machine has to have acted on the stop, any other
    one to have been heard since.

    Args:
        freed: names of the robots that are about to be freed.
        stored: this machine's lockout file.
    """
    locked: dict[Lockout, set[str]] = {}
    for each in stored.values():
        for lockout in each.state.lockouts if each.name in freed else ():
            locked.setdefault(lockout, set()).add(each.name)
    acted: dict[str, set[str]] = {}
    for each in stored.values():
        # A robot may have been served as a simulation and as hardware, under one name.
        acted.setdefault(each.name, set()).update(each.seen, each.state.epochs)
    names: dict[str, None] = {}
    try:
        for lockout, robots in locked.items():
            names |= dict.fromkeys(_without(lockout, robots, acted))
    except Exception as exc:  # noqa: BLE001 - said in place of the names
        return Unheard(tuple(names), f"the roster cannot be read: {exc}")
    return Unheard(tuple(names))


def _without(lockout: Lockout, robots: Collection[str], acted: Mapping[str, Collection[str]]) -> Iterable[str]:
    ago = max(0.0, time.time() - lockout.at)
    found, _ = sightings().read(this_moment().earlier(ago))
    for network in {each.network for each in found if each.name in robots}:
        roster = Roster.of(network, uptime() - ago)
        for row in roster.rows:
            must = counts(roster, row) and lockout.scope.covers(row.name, {row.cell} - {""})
            if must and not _had(row, lockout.epoch, ago, acted):
                yield row.name


def _had(row: RosterRow, epoch: str, ago: float, acted: Mapping[str, Collection[str]]) -> bool:
    if epoch in acted.get(row.name, ()):
        return True
    return row.alive is None and row.age_s is not None and row.age_s < ago
