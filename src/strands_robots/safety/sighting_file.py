"""SQLite file of the robots that were heard or served from this machine.

It is private, bounded and in WAL mode; each use opens it anew and waits 0.2 s at most for another process. A damaged
file is put aside and begun again; for ten minutes from then every reader is told so.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.identity import Exemption
from strands_robots.safety.network_key import NO_NETWORK, NetworkKey
from strands_robots.safety.scope import Scope
from strands_robots.state_files import StateFileError, adopt, boot, make_private, require_private_file, uptime
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

if TYPE_CHECKING:
    import sqlite3

logger = stop_logger(__name__)

VERSION = 1
BUSY_MS = 200
ROWS_MAX = 4096
"""Robots that were heard. Beyond it the stale are forgotten first, then the latest, those that never signed first. A
quarter is kept for the longest heard of these: keys cost nothing either."""

CROWDED = "more robots were heard in the last ten minutes than sightings.db holds; some are missing"
"""Problem of a reader where rows were forgotten that were not stale."""

SERVED_MAX = 1024

RECENT_S = 600.0
"""A robot that was heard longer ago than this does not count."""

UNKNOWN = "unknown"
"""Start of a live process where the system does not say it."""

LEAVING_S = 1.0
"""Seconds after a robot's orderly end in which its last presence may still be heard."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS heard (
    id INTEGER PRIMARY KEY, network TEXT NOT NULL, name TEXT NOT NULL,
    boot TEXT NOT NULL, uptime REAL NOT NULL, wall REAL NOT NULL,
    signed_boot TEXT, signed_uptime REAL, signed_wall REAL,
    cell TEXT, signed_only INTEGER, stoppable INTEGER, departed INTEGER NOT NULL,
    UNIQUE (network, name));
CREATE TABLE IF NOT EXISTS served (
    id INTEGER PRIMARY KEY, network TEXT NOT NULL, name TEXT NOT NULL, pid INTEGER NOT NULL, started TEXT NOT NULL,
    boot TEXT NOT NULL, uptime REAL NOT NULL, wall REAL NOT NULL,
    cell TEXT NOT NULL, signed_only INTEGER NOT NULL, ended INTEGER NOT NULL,
    UNIQUE (network, name, pid, started));
CREATE TABLE IF NOT EXISTS lost (boot TEXT NOT NULL, uptime REAL NOT NULL, wall REAL NOT NULL);
"""

_CROWDED = "CREATE TABLE IF NOT EXISTS crowded (boot TEXT NOT NULL, uptime REAL NOT NULL, wall REAL NOT NULL)"

# The same boot by the clock since boot, another one by the wall clock.
_STALE = "(CASE WHEN {row}.boot = {now_boot} THEN {now_uptime} - {row}.uptime ELSE {now_wall} - {row}.wall END > 600)"
_REPLACED = _STALE.format(row="heard", now_boot="excluded.boot", now_uptime="excluded.uptime", now_wall="excluded.wall")

_NOTE = f"""
INSERT INTO heard (network, name, boot, uptime, wall, signed_boot, signed_uptime, signed_wall, cell, signed_only,
    stoppable, departed) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
ON CONFLICT (network, name) DO UPDATE SET
    boot = excluded.boot, wall = excluded.wall,
    uptime = CASE WHEN boot = excluded.boot THEN max(uptime, excluded.uptime) ELSE excluded.uptime END,
    signed_boot = coalesce(excluded.signed_boot, signed_boot),
    signed_uptime = coalesce(excluded.signed_uptime, signed_uptime),
    signed_wall = coalesce(excluded.signed_wall, signed_wall),
    cell = CASE WHEN excluded.cell IS NULL THEN cell
        WHEN cell IS NULL OR cell = excluded.cell OR {_REPLACED} THEN excluded.cell ELSE '' END,
    signed_only = coalesce(excluded.signed_only, signed_only),
    stoppable = nullif(max(coalesce(stoppable, -1), coalesce(excluded.stoppable, -1)), -1),
    departed = excluded.departed
"""

_SERVE = """
INSERT INTO served (network, name, pid, started, boot, uptime, wall, cell, signed_only, ended)
VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
ON CONFLICT (network, name, pid, started) DO UPDATE SET boot = excluded.boot, uptime = excluded.uptime,
    id = CASE WHEN ended > excluded.ended THEN (SELECT max(id) + 1 FROM served) ELSE id END,
    wall = excluded.wall, cell = excluded.cell, signed_only = excluded.signed_only, ended = excluded.ended
"""

_NOW_STALE = _STALE.format(row="heard", now_boot=":boot", now_uptime=":uptime", now_wall=":wall")

_EVICT = f"""
DELETE FROM heard WHERE id IN (
    SELECT id FROM heard ORDER BY {_NOW_STALE} DESC,
        id IN (SELECT id FROM heard WHERE signed_boot IS NULL AND NOT {_NOW_STALE} ORDER BY id LIMIT :most / 4) ASC,
        (signed_boot IS NOT NULL) ASC, id DESC
    LIMIT max(0, (SELECT count(*) FROM heard) - :most))
"""


class SightingFileError(StrandsRobotsError, OSError):
    """The file could not be read or written; the message says why."""


class Known(IntEnum):
    """Grades of knowledge of a robot, the surest first."""

    ENROLLED = 0
    SERVED = 1
    SIGNED = 2
    HEARD = 3


@dataclass(frozen=True, slots=True)
class Moment:
    """A point in time that outlives a process.

    Attributes:
        boot: id of the boot of the machine.
        uptime: seconds since boot, those asleep included.
        wall: wall-clock seconds; they count across boots alone.
    """

    boot: str
    uptime: float
    wall: float

    def age_s(self, now: Moment) -> float:
        """Return the seconds from this moment to ``now``.

        Of an earlier boot it is the difference of the wall clocks, and at least the time since boot: the wall clock may
        have been reset.
        """
        if self.boot == now.boot and self.boot:
            return now.uptime - self.uptime
        return max(now.wall - self.wall, now.uptime)

    def earlier(self, seconds: float) -> Moment:
        """Return the moment ``seconds`` before this one."""
        return Moment(self.boot, self.uptime - seconds, self.wall - seconds)


def this_moment() -> Moment:
    """Return the present moment."""
    return Moment(boot(), uptime(), time.time())


@dataclass(frozen=True, slots=True)
class RosterRow:
    """A robot as this machine remembers it, and as a row of a roster.

    Attributes:
        name: its id on the network.
        known: the surest way in which it is known.
        age_s: seconds since it was last heard here, or since its process wrote last; infinite where it was not within
            ten minutes, below 0 after the press.
        order: lower for a robot that was heard first earlier.
        cell: or "".
        signed_only: it locks for signed stops alone (``--key``); None where that is unknown.
        stoppable: False for a device without a stop: told, not counted. None where that is unknown.
        departed: it said, unsigned, that it left.
        alive: its process on this machine lives; None where it is not served from here.
        pid: of that process.
        processes: run id and pid of every living process of this machine that serves it; each must answer.
        exemption: of rows of :attr:`Roster.exempt`.
        reported_by: the controller that reported it, "" where this machine heard it.
        enrolled_cell: of its enrolment, "" for none; None where that is unknown.
        named: nothing is known of it but that the caller of a stop named it.
        network: where it was heard, or is served.
    """

    name: str
    known: Known
    age_s: float = math.inf
    order: int = 0
    cell: str = ""
    signed_only: bool | None = None
    stoppable: bool | None = None
    departed: bool = False
    alive: bool | None = None
    pid: int | None = None
    processes: tuple[tuple[str, int], ...] = ()
    exemption: Exemption | None = None
    reported_by: str = ""
    enrolled_cell: str | None = None
    named: bool = False
    network: NetworkKey = field(default=NO_NETWORK, compare=False)

    @property
    def last_cell(self) -> str:
        """The cell in which it was heard last, else that of its enrolment; "" for none."""
        return self.cell or self.enrolled_cell or ""

    def within(self, scope: Scope, stated: str | None) -> bool:
        """Return False for a robot of another cell than that of a scope.

        Anyone may forge a presence. It takes no enrolled robot out of the count, and of one that has shown a key it
        does not contradict what is remembered.

        Args:
            stated: the cell that it was heard in last, "" for none; None where it reads no scope.
        """
        if scope.everything or scope.only or stated is None:
            return stated is None or scope.covers(self.name, ())
        if self.processes:
            cells = [self.cell]
        elif self.known is Known.ENROLLED:
            if self.enrolled_cell is None:
                return True
            cells = [self.enrolled_cell, stated, *([self.cell] if self.cell else [])]
        elif stated and stated != self.cell and self.age_s < math.inf and self.known is not Known.HEARD:
            cells = [""]
        else:
            cells = [stated]
        return any(scope.covers(self.name, {cell} - {""}) for cell in cells)


@dataclass(frozen=True, slots=True)
class Note:
    """A robot that was heard ``at`` a moment, and when it last answered signed."""

    network: NetworkKey
    name: str
    at: Moment
    signed: Moment | None = None
    cell: str | None = None
    signed_only: bool | None = None
    stoppable: bool | None = None
    departed: bool = False


@dataclass(frozen=True, slots=True)
class Served:
    """A robot that a process of this machine serves, or served when it ``ended``."""

    network: NetworkKey
    name: str
    pid: int
    started: str
    at: Moment
    cell: str = ""
    signed_only: bool = False
    ended: bool = False

    @property
    def run(self) -> str:
        """The run id of its process, as its signed answers state it."""
        return _run(self.at.boot, self.pid, self.started)

    def lives(self, now: Moment) -> bool:
        """True while its process lives and serves it."""
        return not self.ended and self.at.boot == now.boot and process_start(self.pid) == self.started != ""

    def holds(self, network: NetworkKey, name: str, now: Moment) -> bool:
        """True while another process serves this robot, for callers that reach both."""
        # Where the system does not say when a process started, its number may be another one's by now.
        sure = self.started != UNKNOWN or self.at.age_s(now) < RECENT_S
        another = self.name == name and self.pid != os.getpid() and self.network.joins(network)
        return another and sure and self.lives(now)


def process_start(pid: int) -> str:
    """Return the start of a process, in ticks since boot; "" where there is none.

    Where the system does not say, it is ``unknown`` for every live process.
    """
    try:
        # The name in brackets may hold anything.
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
        return "" if fields[0] in (b"Z", b"X") else fields[19].decode("ascii")
    except (OSError, IndexError):
        if Path("/proc/self/stat").exists():
            return ""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return ""
    except PermissionError:
        return UNKNOWN
    return UNKNOWN


def own_run() -> str:
    """Return the run id of this process: 16 hex digits, another one in each process."""
    return _run_of(os.getpid())


@lru_cache(maxsize=4)
def _run_of(pid: int) -> str:
    return _run(boot(), pid, process_start(pid))


def _run(since_boot: str, pid: int, started: str) -> str:
    return hashlib.sha256(f"{since_boot} {pid} {started}".encode()).hexdigest()[:16]


class SightingFile:
    """The file ``sightings.db`` of one state directory."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "sightings.db"
        self._root = directory

    def write(self, notes: Sequence[Note], served: Sequence[Served], now: Moment, *, crowded: bool = False) -> None:
        """Write these rows, and forget what is too much.

        Args:
            crowded: robots were heard that are not among the notes.

        Raises:
            SightingFileError: nothing was written.
        """
        with self._opened(make=True) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.executemany(_NOTE, [_note_row(each) for each in notes])
            connection.executemany(_SERVE, [_served_row(each) for each in served])
            if notes:
                facts = {"boot": now.boot, "uptime": now.uptime, "wall": now.wall, "most": ROWS_MAX}
                fresh = connection.execute(f"SELECT count(*) FROM heard WHERE NOT {_NOW_STALE}", facts).fetchone()[0]
                if crowded or fresh > ROWS_MAX:
                    connection.execute(_CROWDED)
                    connection.execute("DELETE FROM crowded")
                    connection.execute("INSERT INTO crowded VALUES (?, ?, ?)", _moment_row(now))
                connection.execute(_EVICT, facts)
            if served:
                self._forget_served(connection, now)
            connection.execute("COMMIT")

    def read(self, now: Moment) -> tuple[list[RosterRow], str]:
        """Return the robots of the ten minutes before ``now``, and a problem or "".

        Raises:
            SightingFileError: nothing could be read.
        """
        if not self.path.exists() and not self.path.is_symlink():
            return [], ""
        with self._opened() as connection:
            problem = _held(connection)
            lost = [Moment(*row) for row in connection.execute("SELECT boot, uptime, wall FROM lost")]
            heard = connection.execute(
                "SELECT network, name, boot, uptime, wall, signed_boot, signed_uptime, signed_wall, cell, signed_only,"
                " stoppable, departed, id FROM heard ORDER BY id LIMIT ?",
                (2 * ROWS_MAX,),
            ).fetchall()
            served = self._served(connection)
            made = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'crowded'").fetchone()
            crowded = connection.execute("SELECT boot, uptime, wall FROM crowded").fetchall() if made else []
            networks = connection.execute(
                "SELECT network, boot, uptime, wall FROM heard UNION ALL"
                " SELECT network, boot, uptime, wall FROM served WHERE NOT ended"
            ).fetchmany(2 * (ROWS_MAX + SERVED_MAX))
        unread = sum(_network(str(row[0])) is None and _moment(*row[1:]).age_s(now) < RECENT_S for row in networks)
        if unread and not problem:
            problem = f"{unread} robots in sightings.db are of networks that this release cannot read"
        if not problem and any(Moment(*row).age_s(now) < RECENT_S for row in crowded):
            problem = CROWDED
        if any(each.age_s(now) < RECENT_S for each in lost):
            problem = (
                "sightings.db was damaged and begun again less than ten minutes ago; robots heard before may be missing"
            )
        return _united(heard, served, now), problem

    def served(self, name: str) -> list[Served]:
        """Return the rows of a served robot, the latest first, ended ones included.

        Raises:
            SightingFileError: they could not be read.
        """
        if not self.path.exists() and not self.path.is_symlink():
            return []
        with self._opened() as connection:
            return self._served(connection, "name = :name", {"name": name})

    def _served(
        self, connection: sqlite3.Connection, where: str = "1", facts: Mapping[str, object] | None = None
    ) -> list[Served]:
        rows = connection.execute(
            "SELECT network, name, pid, started, boot, uptime, wall, cell, signed_only, ended FROM served"
            f" WHERE {where} ORDER BY id DESC LIMIT :most",
            {**(facts or {}), "most": 2 * SERVED_MAX},
        )
        found = []
        for network, name, pid, started, since_boot, since, wall, cell, signed_only, ended in rows:
            key, at = _network(network), Moment(since_boot, since, wall)
            if key is not None:
                found.append(Served(key, name, pid, started, at, cell, bool(signed_only), bool(ended)))
        return found

    def _forget_served(self, connection: sqlite3.Connection, now: Moment) -> None:
        """Forget served robots whose process is gone and ten minutes are over."""
        gone = [
            (each.network.text, each.name, each.pid, each.started)
            for each in self._served(
                connection, "boot != :boot OR uptime < :since", {"boot": now.boot, "since": now.uptime - RECENT_S}
            )
            if each.at.age_s(now) >= RECENT_S and not each.lives(now)
        ]
        connection.executemany("DELETE FROM served WHERE network = ? AND name = ? AND pid = ? AND started = ?", gone)
        connection.execute(
            "DELETE FROM served WHERE id IN (SELECT id FROM served ORDER BY ended DESC, uptime"
            " LIMIT max(0, (SELECT count(*) FROM served) - ?))",
            (SERVED_MAX,),
        )

    @contextlib.contextmanager
    def _opened(self, *, make: bool = False) -> Iterator[sqlite3.Connection]:
        import sqlite3  # noqa: PLC0415 - a process that hears no robot does not load it

        try:
            if make:
                self._make()
            inode = require_private_file(self.path, self._root)
            connection = sqlite3.connect(self.path, timeout=BUSY_MS / 1000, isolation_level=None)
        except (OSError, StateFileError, sqlite3.Error) as exc:
            raise SightingFileError(f"{self.path.name} cannot be used: {exc}") from exc
        try:
            with contextlib.closing(connection):
                self._prepare(connection, make=make)
                yield connection
        except sqlite3.OperationalError as exc:
            raise SightingFileError(f"{self.path.name} cannot be used: {exc}") from exc
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as exc:
            # SQLite says so of a malformed file; any other error is no reason to begin anew.
            if make and type(exc) is sqlite3.DatabaseError:
                self._put_aside(inode)
            raise SightingFileError(f"{self.path.name} is damaged: {exc}") from exc

    def _prepare(self, connection: sqlite3.Connection, *, make: bool) -> None:
        connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}")
        connection.execute("PRAGMA synchronous = NORMAL")
        until = time.monotonic() + BUSY_MS / 1000
        # Another process may be making it.
        while not (version := connection.execute("PRAGMA user_version").fetchone()[0]) and not make:
            if time.monotonic() > until:
                break
            time.sleep(0.01)
        if version not in (0, VERSION):
            raise SightingFileError(f"{self.path.name} is of another release (version {version})")
        if version == VERSION:
            return
        if not make:
            raise SightingFileError(f"{self.path.name} was never written whole")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("BEGIN IMMEDIATE")
        for statement in filter(str.strip, _SCHEMA.split(";")):
            connection.execute(statement)
        if self._aside.exists() and connection.execute("SELECT count(*) FROM lost").fetchone()[0] == 0:
            at = this_moment()
            aged = max(0.0, at.wall - self._aside.stat().st_mtime)
            earlier = at.earlier(aged)
            connection.execute("INSERT INTO lost VALUES (?, ?, ?)", (earlier.boot, earlier.uptime, earlier.wall))
        connection.execute(f"PRAGMA user_version = {VERSION}")
        connection.execute("COMMIT")

    def _make(self) -> None:
        adopt(self._root)
        make_private(self._root)
        with contextlib.suppress(FileExistsError):
            os.close(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600))

    @property
    def _aside(self) -> Path:
        return self.path.with_suffix(".damaged")

    def _put_aside(self, inode: int) -> None:
        """Keep a damaged file for a person to look at; the next write begins anew."""
        with contextlib.suppress(OSError):  # another process was first
            if self.path.stat().st_ino != inode:
                return
            for suffix in ("-wal", "-shm"):
                self.path.with_name(self.path.name + suffix).unlink(missing_ok=True)
            os.utime(self.path)
            self.path.replace(self._aside)
            logger.critical("%s is damaged and was put aside as %s.", self.path.name, self._aside.name)


def _held(connection: sqlite3.Connection) -> str:
    """Return a problem while another process keeps all others from writing."""
    import sqlite3  # noqa: PLC0415 - as above

    try:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("ROLLBACK")
    except sqlite3.OperationalError as exc:
        return f"sightings.db cannot be written ({exc}); robots heard last may be missing"
    return ""


def _note_row(note: Note) -> tuple[object, ...]:
    signed = note.signed
    return (
        note.network.text,
        note.name,
        *_moment_row(note.at),
        *((None, None, None) if signed is None else _moment_row(signed)),
        note.cell,
        note.signed_only,
        # A robot that signs its answers has a stop.
        note.stoppable if signed is None else True,
        note.departed,
    )


def _served_row(row: Served) -> tuple[object, ...]:
    at = _moment_row(row.at)
    return (row.network.text, row.name, row.pid, row.started, *at, row.cell, row.signed_only, row.ended)


def _moment_row(at: Moment) -> tuple[str, float, float]:
    return at.boot, at.uptime, at.wall


def _united(heard: Sequence[tuple[object, ...]], served: Sequence[Served], now: Moment) -> list[RosterRow]:
    """Return the sightings of the ten minutes before ``now``, one a robot and key."""
    latest: dict[tuple[NetworkKey, str], Served] = {}
    living: dict[tuple[NetworkKey, str], dict[str, int]] = {}
    for row in served:
        if row.lives(now):
            living.setdefault((row.network, row.name), {})[row.run] = row.pid
        known = latest.get((row.network, row.name))
        if known is None or (row.lives(now), -row.at.age_s(now)) > (known.lives(now), -known.at.age_s(now)):
            latest[row.network, row.name] = row
    by_name: dict[str, list[Served]] = {}
    for row in latest.values():
        by_name.setdefault(row.name, []).append(row)
    found: dict[tuple[NetworkKey, str], RosterRow] = {}
    for each in heard:
        seen = _sighting(each, now)
        if seen is None or seen.age_s >= RECENT_S:
            continue
        ended = [row for row in by_name.get(seen.name, ()) if row.ended and row.network.meets(seen.network)]
        if not any(seen.age_s >= row.at.age_s(now) - LEAVING_S for row in ended):
            found[seen.network, seen.name] = seen
    for key, own in latest.items():
        alive, age = own.lives(now), own.at.age_s(now)
        if own.ended or not (alive or age < RECENT_S):
            continue
        seen = found.get(key) or RosterRow(own.name, Known.SERVED, age, network=own.network)
        found[key] = replace(
            seen,
            known=Known.SERVED,
            age_s=min(age, seen.age_s),
            cell=own.cell,
            signed_only=own.signed_only,
            stoppable=True,
            alive=alive,
            pid=own.pid,
            processes=tuple(living.get(key, {}).items()),
        )
    return list(found.values())


def _sighting(row: tuple[object, ...], now: Moment) -> RosterRow | None:
    network, name, *rest = row
    key = _network(str(network))
    if key is None:
        return None
    since_boot, since, wall, signed_boot, signed_since, signed_wall, cell, signed_only, stoppable, departed, order = (
        rest
    )
    signed = signed_boot is not None and _moment(signed_boot, signed_since, signed_wall).age_s(now) < RECENT_S
    return RosterRow(
        str(name),
        Known.SIGNED if signed else Known.HEARD,
        _moment(since_boot, since, wall).age_s(now),
        int(str(order)),
        str(cell or ""),
        None if signed_only is None else bool(signed_only),
        None if stoppable is None else bool(stoppable),
        bool(departed),
        network=key,
    )


@lru_cache(maxsize=64)
def _network(text: str) -> NetworkKey | None:
    """Return a network key, None for one that cannot be read, as of a later release."""
    try:
        return NetworkKey.parse(text)
    except ValidationError:
        return None


def _moment(since_boot: object, since: object, wall: object) -> Moment:
    return Moment(str(since_boot), float(str(since)), float(str(wall)))
