"""What holds each robot: asked over the network, and read from this machine's lockout file."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from strands_robots.cli.fleet import asked
from strands_robots.cli.output import Failure
from strands_robots.safety.lockout import OVERFLOW, Hold, utc
from strands_robots.safety.persistence import LockoutStore

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient

AT_ONCE = 8


@dataclass(frozen=True, slots=True)
class Standing:
    """One robot as it says it stands, or why it does not say: ``problem`` is empty where it answered."""

    name: str
    holds: tuple[Hold, ...] = ()
    problem: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    round_trip_ms: float = 0.0

    @property
    def resumable(self) -> tuple[str, ...]:
        """The epochs that a signature can clear."""
        return tuple(hold.epoch for hold in self.holds if hold.epoch != OVERFLOW)


def robots(fleet: FleetClient, seconds: float = 2.0) -> list[str]:
    """The devices on the network that can be locked and resumed."""
    return [peer.id for peer in fleet.peers(seconds) if any(each.get("name") == "resume" for each in peer.functions)]


def standing(fleet: FleetClient, names: Iterable[str], seconds: float) -> list[Standing]:
    """What each robot says of itself, asked side by side."""
    wanted = list(dict.fromkeys(names))
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(lambda name: _ask(fleet, name, seconds), wanted))


def on_disk() -> dict[str, tuple[Hold, ...]]:
    """The robots of this machine that the lockout file holds, by key where they have no name.

    Raises:
        Failure: the file cannot be read.
    """
    try:
        kept = LockoutStore().load_all()
    except (OSError, ValueError) as exc:
        raise Failure(f"The lockout file of this machine cannot be read, so its robots come up locked: {exc}") from exc
    return {each.name or key: each.state.all for key, each in kept.items() if each.state.locked}


def _ask(fleet: FleetClient, name: str, seconds: float) -> Standing:
    began = time.monotonic()
    try:
        answer = asked(fleet, name, "getStatus", {}, seconds)
    except Failure as failure:
        return Standing(name, problem=failure.reason)
    took_ms = (time.monotonic() - began) * 1000
    if "locked" not in answer:
        return Standing(name, problem="it says nothing of a lockout", facts=answer, round_trip_ms=took_ms)
    told = answer.get("lockout")
    holds = tuple(_hold(each) for each in told if isinstance(each, Mapping)) if isinstance(told, list) else ()
    return Standing(name, holds, facts=answer, round_trip_ms=took_ms)


def _hold(told: Mapping[str, Any]) -> Hold:
    since = told.get("since")
    at = float(since) if isinstance(since, int | float) else 0.0
    return Hold(str(told.get("epoch", "")), str(told.get("source", "")), str(told.get("reason", "")), at)


def rows(name: str, held: Iterable[Hold]) -> list[tuple[str, str]]:
    """Cells for one robot: for each hold since when, by whom and why, and its epoch, which other commands take."""
    cells: list[tuple[str, str]] = []
    for hold in held:
        why = f": {hold.reason}" if hold.reason else ""
        cells += [("" if cells else name, f"since {utc(hold.at)} by {hold.source}{why}"), ("", f"epoch {hold.epoch}")]
    return cells


def fields(hold: Hold) -> dict[str, Any]:
    """A hold for ``--json``."""
    return {"epoch": hold.epoch, "source": hold.source, "reason": hold.reason, "since": hold.at}
