"""Roster of a network: the robots that must answer a stop, and why one is silent.

Exit code rule: where no robot is enrolled for the network, every row counts. Where some are, rows that are ENROLLED,
SERVED or SIGNED count; names that were only HEARD are told and do not alter the exit code, so made-up names cannot.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.identity import (
    EnrolledKeys,
    EnrolledRobot,
    KeyFileError,
    kept_consoles,
    of_tenant,
    stated_consoles,
)
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.safety.orders import estop_keys, params_of
from strands_robots.safety.sighting_file import CROWDED
from strands_robots.safety.sightings import Known, RosterRow, Sightings, sightings, this_moment
from strands_robots.safety.statements import Purpose, own_key
from strands_robots.safety.stop_link import STOP_ROSTER, FairQueue
from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger
from strands_robots.threads import WokenThread
from strands_robots.utils import ValidationError, identifier

logger = stop_logger(__name__)

REPORTED_MAX = 64


@dataclass(frozen=True, slots=True)
class _Memory:
    """Memory of all networks, and the names of the one asked for."""

    networks: tuple[NetworkKey, ...]
    found: tuple[RosterRow, ...]
    enrolled: Mapping[str, EnrolledRobot]
    problems: tuple[str, ...]

    def at(self, networks: Iterable[NetworkKey]) -> bool:
        return any(own.meets(each) for each in networks for own in self.networks)

    def here(self, row: RosterRow) -> bool:
        return self.at((row.network,))

    def further(self, proven: Mapping[str, Collection[str]]) -> tuple[NetworkKey, ...]:
        """Return networks that are the one asked for, as robots prove."""
        recorded = {key for name in proven if name in self.enrolled for key in self.enrolled[name].networks}
        recorded |= {
            each.network
            for each in self.found
            if each.name in proven and not {run for run, _ in each.processes}.isdisjoint(proven[each.name])
        }
        kind, tenant = self.networks[0].kind, self.networks[0].tenant
        alike = (each for each in recorded if (each.kind, each.tenant) == (kind, tenant) and not self.at((each,)))
        return tuple(sorted(alike, key=lambda each: each.text))


@dataclass(frozen=True, slots=True)
class Roster:
    """Robots of one network.

    Attributes:
        network: asked for.
        rows: that must answer, in the order of :class:`Known`, then longest heard first; devices without a stop too.
        exempt: robots that are retired or off. ``age_s`` tells whether one of this name was heard all the same.
        elsewhere: number of enrolled or served robots of other networks of this user.
        enrolled: number of robots enrolled for this network, without the exempt ones.
        problems: sentences on what could not be read; with one of them no exit code is 0.
    """

    network: NetworkKey
    rows: tuple[RosterRow, ...] = ()
    exempt: tuple[RosterRow, ...] = ()
    elsewhere: int = 0
    enrolled: int = 0
    problems: tuple[str, ...] = ()
    _memory: _Memory | None = field(default=None, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        network: NetworkKey,
        pressed: float | None = None,
        *,
        store: Sightings | None = None,
    ) -> Roster:
        """Read the roster from the disk; call it once the stop has left.

        Args:
            network: of the stop.
            pressed: :func:`~strands_robots.state_files.uptime` at the press; now by default. Robots count that were
                heard from ten minutes before it until now.
            store: in place of the state directory's.
        """
        store = store or sightings()
        now = this_moment()
        at = now if pressed is None else now.earlier(uptime() - pressed)
        found, problem = store.read(at)
        problems = [problem] if problem else []
        try:
            enrolled = of_tenant(EnrolledKeys(store.directory).robots(), network.tenant)
        except (StrandsRobotsError, OSError) as exc:
            enrolled = {}
            problems.append(f"the enrolled robots cannot be read: {exc}")
        roster = cls._at(_Memory((network,), tuple(found), enrolled, tuple(problems)))
        if not roster.enrolled or CROWDED not in problems:
            return roster
        # The file forgets names that were heard; where robots are enrolled these do not count.
        problems.remove(CROWDED)
        return cls._at(_Memory((network,), tuple(found), enrolled, tuple(problems)))

    @classmethod
    def _at(cls, memory: _Memory) -> Roster:
        rows: dict[str, RosterRow] = {}
        processes: dict[str, dict[str, int]] = {}
        for each in sorted(filter(memory.here, memory.found), key=lambda row: (row.known, row.age_s)):
            rows.setdefault(each.name, each)
            processes.setdefault(each.name, {}).update(each.processes)
        rows = {name: replace(row, processes=tuple(processes[name].items())) for name, row in rows.items()}
        enrolled = memory.enrolled
        here = {name: robot for name, robot in enrolled.items() if not robot.networks or memory.at(robot.networks)}
        exempt: list[RosterRow] = []
        for name, robot in here.items():
            row = rows.get(name, RosterRow(name, Known.ENROLLED))
            known = replace(row, exemption=robot.exemption, enrolled_cell=robot.cell)
            if robot.exemption is not None and not known.alive:
                exempt.append(known)
                rows.pop(name, None)
            else:
                # A robot that this machine serves now is there, whatever was decided about it.
                rows[name] = replace(known, known=Known.ENROLLED, stoppable=True, exemption=None)
        others = {name for name, robot in enrolled.items() if name not in here and robot.exemption is None}
        served = {each.name for each in memory.found if each.alive and not memory.here(each)}
        return cls(
            memory.networks[0],
            in_order(rows.values()),
            in_order(exempt),
            len(others | served),
            sum(robot.exemption is None for robot in here.values()),
            memory.problems,
            memory,
        )

    @property
    def joined(self) -> tuple[NetworkKey, ...]:
        """Further names of this network, as :meth:`with_answers` found."""
        return () if self._memory is None else self._memory.networks[1:]

    @property
    def served_elsewhere(self) -> frozenset[str]:
        """Robots that living processes of this machine serve on other networks."""
        memory = self._memory
        if memory is None:
            return frozenset()
        return frozenset(each.name for each in memory.found if each.alive and not memory.here(each))

    @property
    def perhaps_here(self) -> dict[str, RosterRow]:
        """Robots served by this machine under an address that may be of this network."""
        memory = self._memory
        if memory is None:
            return {}
        return {
            each.name: each
            for each in memory.found
            if each.alive and not memory.here(each) and all(own.may_be(each.network) for own in memory.networks)
        }

    def with_answers(self, proven: Mapping[str, Collection[str]]) -> Roster:
        """Return the roster with the robots of networks that are this one.

        A network may be reached under several addresses. A robot that answers here and is enrolled under another one,
        or whose very process is served under it, shows that both are the same. It adds rows and takes none away.

        Args:
            proven: robots that answered, signed by a key that is known here, and the run ids in their answers.
        """
        memory = self._memory
        while memory is not None and (further := memory.further(proven)):
            memory = replace(memory, networks=(*memory.networks, *further))
        if memory is None or memory is self._memory:
            return self
        joined = Roster._at(memory)
        rows = {row.name: row for row in joined.rows}
        for row in self.rows:
            also = rows.get(row.name, row)
            if also.known < row.known:
                rows[row.name] = replace(also, stoppable=True)
            else:
                rows[row.name] = replace(row, alive=also.alive, pid=also.pid, processes=also.processes)
        exempt = tuple(row for row in joined.exempt if row.name not in rows)
        # Names that were only heard count on as they did.
        enrolled = joined.enrolled if self.enrolled else 0
        return replace(joined, rows=in_order(rows.values()), exempt=exempt, enrolled=enrolled)

    def counts(self, row: RosterRow) -> bool:
        """Return True when the exit code depends on this row.

        That a device has no stop is said by its presence, which is not signed: it exempts no robot that has shown a
        key.
        """
        return row.known is not Known.HEARD or (row.stoppable is not False and not self.enrolled)

    @property
    def must_answer(self) -> tuple[RosterRow, ...]:
        """The rows that the exit code depends on."""
        return tuple(row for row in self.rows if self.counts(row))

    def with_reported(self, rows: Iterable[RosterRow], by: str) -> Roster:
        """Return the roster with rows that the controller ``by`` reported.

        A row of this machine stays, and takes the surer of the two grades. Where the controller's signature is not
        verified the caller passes every row as HEARD.
        """
        united = {row.name: row for row in self.rows}
        exempt = {row.name for row in self.exempt}
        for row in rows:
            known = united.get(row.name)
            if known is None and row.name not in exempt:
                united[row.name] = replace(row, reported_by=by)
            elif known is not None and row.known < known.known:
                united[row.name] = replace(known, known=row.known, stoppable=True, reported_by=by)
        return replace(self, rows=in_order(united.values()))


def in_order(rows: Iterable[RosterRow]) -> tuple[RosterRow, ...]:
    """Return the rows, surest first, then longest heard first."""
    return tuple(sorted(rows, key=lambda row: (row.known, row.order, row.name)))


def bounded(rows: Sequence[RosterRow], most: int = REPORTED_MAX) -> tuple[tuple[RosterRow, ...], int]:
    """Return the first ``most`` rows in order, and the number of the others."""
    kept = in_order(rows)[:most]
    return kept, len(rows) - len(kept)


UNTOLD = "Zenoh does not tell a sender whether access rules drop a stop."
"""Said beside silent robots where the network cannot name that reason."""


@dataclass(frozen=True, slots=True)
class Sending:
    """Facts of the sending of a stop.

    Attributes:
        left: it left this machine.
        signed: with ``--key``.
        denied: what the broker said to refuse it, or "".
        tells: the network tells a sender what it refuses.
    """

    left: bool = True
    signed: bool = False
    denied: str = ""
    tells: bool = False


def reason_of(
    row: RosterRow, sending: Sending, *, found: bool, elsewhere: Mapping[str, tuple[NetworkKey, float]]
) -> str:
    """Return why a robot of the roster may be silent: only what is known.

    Args:
        row: the robot.
        sending: how the stop was sent.
        found: it was heard on this network since the press.
        elsewhere: the network where a robot of this name was heard last, and seconds since.
    """
    if not sending.left:
        return "the stop did not leave this machine: the link is down"
    if sending.denied:
        return f"the broker refuses this sender's stops: {sending.denied}"
    if row.alive is not None:
        return _process(row)
    if row.signed_only and not sending.signed:
        return "it acts on signed stops alone: estop --key FILE"
    if row.departed:
        return "it said that it leaves the network; that was not signed"
    if found or row.age_s < 0:
        return "it is on this network and does not answer"
    where, ago = elsewhere.get(row.name, (None, 0.0))
    if where is not None and ago < row.age_s:
        return f"it was heard {seconds(ago)} ago on another network: {described(where)}"
    if row.reported_by:
        return f"this machine has not heard it; {row.reported_by} has, and misses it too"
    if row.age_s == math.inf:
        return "no route to it: it was not heard in the last ten minutes"
    return f"no route to it: it was last heard {seconds(row.age_s)} before"


def described(network: NetworkKey) -> str:
    """Return a network in words."""
    where = ", ".join(network.where[:2])
    return f"the native mesh at {where}" if network.kind == MESH else f"tenant {network.tenant} at {where}"


def seconds(age_s: float) -> str:
    """Return an age for a sentence, such as ``42 s``."""
    return f"{age_s:.0f} s" if age_s < 600 else f"{age_s / 60:.0f} min"


def cannot_answer(row: RosterRow) -> bool:
    """Return True where its process on this machine has ended, or is stopped."""
    return row.alive is not None and (not row.alive or process_state(row.pid) in ("Z", "X", "T", "t"))


def _process(row: RosterRow) -> str:
    state = process_state(row.pid) if row.alive and row.pid else ""
    if not row.alive or state in ("Z", "X"):
        return "its process on this machine has ended"
    if state in ("T", "t"):
        how = "SIGSTOP" if state == "T" else "a debugger"
        return f"its process {row.pid} on this machine is stopped ({how})"
    return f"its process {row.pid} on this machine is there and does not answer"


def process_state(pid: int | None) -> str:
    """Return the letter of a process's state in /proc, such as T, or ""."""
    try:
        status = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return ""
    return status.rpartition(b")")[2].split()[:1][0].decode("ascii", "replace") if b")" in status else ""


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
        self._trusted = frozenset[bytes]()
        self._worker = WokenThread("roster reports", self._read_all)

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
        self._worker.wake()

    def end(self) -> None:
        """End the thread."""
        self._worker.close()

    def _read_all(self) -> None:
        while (event := self._queue.take()) is not None:
            if not self._stops:
                self._trusted = frozenset()
                continue
            self._trusted = self._trusted or trusted_controllers()
            fields = self._read(event.payload) if isinstance(event.payload, bytes) else {}
            report = read_report(event.source, fields, self._trusted)
            with self._lock:
                on_report = None if report is None else self._stops.get(report.estop_id)
            if report is None or not report.trusted:
                time.sleep(UNPROVEN_PAUSE_S)
            else:
                self._queue.vouch(event.source)
            if report is not None and on_report is not None:
                on_report(report)
