"""Memory of the robots that this user's processes heard or serve.

The file ``sightings.db`` in the state directory is shared by all of them. Writes are queued, at most one for a robot in
ten seconds, and done on a thread that lives while there is something to write; never on the way of a stop. A file that
is damaged, locked or cannot be written hinders no command: that is a warning, and a reader gets the reason besides
what could be read.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakSet

from strands_robots.audit import log_safety_event
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.identity import EnrolledKeys, key_here, local_name, of_tenant
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.sighting_file import (
    RECENT_S,
    ROWS_MAX,
    Known,
    Moment,
    Note,
    RosterRow,
    Served,
    SightingFile,
    SightingFileError,
    process_start,
    this_moment,
)
from strands_robots.safety.statements import STATED_WITHIN_S, Purpose, own_key
from strands_robots.state_files import make_private, state_dir
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

__all__ = ["RECENT_S", "Known", "Moment", "RosterRow", "Sightings", "flush_sightings", "sightings", "this_moment"]


T = TypeVar("T")

AGAIN_S = 10.0
"""Seconds in which a robot that was heard is not written again."""

FACTS_S = 1.0
"""The same for a robot whose facts have changed."""

REFRESH_S = 30.0
"""Seconds after which the rows of served robots are written again."""

BATCH_S = 0.3
"""Seconds in which what is heard is collected into one write."""

RETRY_S = 2.0
RETRIES = 5

READ_S = 1.0
"""Seconds that a reader waits for the disk."""

ENDING_S = 0.5
"""Seconds that the end of the process waits for the last write."""

LEAVES_S = 2.0
"""Seconds that a start waits for a process that may be about to leave its robot."""

LEAVES_EVERY_S = 0.05

KINDS = {DEVICE_CONNECT: "Device Connect", MESH: "the native mesh"}

Facts = tuple[str | None, bool | None, bool | None]
NEVER: tuple[float, Facts] = (float("-inf"), (None, None, None))

NAME_MAX = 256
ANSWERS_MAX = 1024
"""Answers whose signature waits to be checked; a further one counts as heard only."""


class DuplicateDeviceError(StrandsRobotsError, RuntimeError):
    """A robot with the wanted id is live and answered, or this machine serves it."""


@dataclass(frozen=True, slots=True)
class _Answer:
    network: NetworkKey
    name: str
    purpose: Purpose
    statement: Mapping[str, Any]
    expected: Mapping[str, Any]
    at: Moment


class Sightings:
    """Remembered robots of one state directory; callable from any thread.

    Args:
        directory: the state directory.
        clock: the present moment.
    """

    def __init__(self, directory: Path, clock: Callable[[], Moment] = this_moment) -> None:
        self.directory = directory
        self.file = SightingFile(directory)
        self._starts = StartLocks(directory)
        self._starts_seen: dict[tuple[NetworkKey, str], int] = {}
        self.problem = ""
        """Empty, or the reason why the last write did not succeed."""
        self._clock = clock
        self._lock = threading.Condition()
        self._noted: dict[tuple[NetworkKey, str], tuple[float, Facts]] = {}
        self._tidied = float("-inf")
        self._crowded = False
        self._notes: deque[Note] = deque(maxlen=2 * ROWS_MAX)
        self._answers: list[_Answer] = []
        self._own: dict[tuple[NetworkKey, str], Served] = {}
        self._changed: dict[tuple[NetworkKey, str], Served] = {}
        self._publics: dict[tuple[NetworkKey, str], bytes] = {}
        self._refreshed = time.monotonic()
        self._thread: threading.Thread | None = None
        self._hurry = False
        self._writing = False
        self._attempts = 0

    def note(
        self,
        network: NetworkKey,
        name: str,
        *,
        cell: str | None = None,
        signed_only: bool | None = None,
        stoppable: bool | None = None,
        departing: bool = False,
    ) -> None:
        """Record that a robot was heard; return at once.

        For its presence and its unsigned answers. Anyone may forge them, so ``stoppable`` is never taken back, and a
        robot of which two cells are stated within ten minutes has none. None leaves a fact as it is known.
        """
        key, now = (network, name), time.monotonic()
        if not _storable(name):
            return
        facts = (cell, signed_only, stoppable)
        since, stated = self._noted.get(key, NEVER)
        # Facts that are new are written earlier, so that a presence right after a heartbeat counts.
        known = facts in (stated, (None, None, None))
        if now - since < (AGAIN_S if known and not departing else FACTS_S):
            return
        heard = Note(
            network,
            name,
            self._clock(),
            None,
            cell if cell is None or _storable(cell) else "",
            signed_only,
            stoppable,
            departing,
        )
        with self._lock:
            if not self._admitted(key, now, stated if facts == (None, None, None) else facts):
                return
            self._notes.append(heard)
            self._start()

    def note_answer(
        self,
        network: NetworkKey,
        name: str,
        purpose: Purpose,
        statement: object,
        expected: Mapping[str, Any] | None = None,
    ) -> None:
        """Record an answer to a question or a stop of this machine; return at once.

        The signature is checked on the writing thread, against the key that the answer shows.

        Args:
            purpose: that the signature must have.
            statement: the signed fields.
            expected: fields that show that it answers this question: its nonce, the ``estop_id``. Without them a
                statement of this minute counts.
        """
        self.note(network, name)
        if not isinstance(statement, Mapping) or "sig" not in statement or not _storable(name):
            return
        with self._lock:
            if len(self._answers) < ANSWERS_MAX:
                self._answers.append(_Answer(network, name, purpose, statement, expected or {}, self._clock()))
                self._start()

    def serve(
        self,
        network: NetworkKey,
        name: str,
        *,
        cell: str = "",
        signed_only: bool = False,
        public: bytes | None = None,
    ) -> None:
        """Record that this process serves a robot, until :meth:`leave`.

        Of two processes that begin at once the later one is refused. It waits for what is on disk already, as
        :meth:`was_here`; its own row is written later.

        Args:
            public: its key; it undoes an exemption that the operator set for the enrolled robot with this key.

        Raises:
            DuplicateDeviceError: as :meth:`was_here`.
        """
        self._rows_where_free(network, name, begins=True)
        row = Served(network, name, os.getpid(), process_start(os.getpid()), self._clock(), cell, signed_only)
        with self._lock:
            self._own[network, name] = self._changed[network, name] = row
            if public is not None:
                self._publics[network, name] = public
            self._start()

    def leave(self, network: NetworkKey, name: str) -> None:
        """Record the orderly end of a robot of this process; return at once."""
        with self._lock:
            row = self._own.pop((network, name), None)
            if row is not None:
                self._changed[network, name] = replace(row, at=self._clock(), ended=True)
                self._start()

    def refresh(self) -> None:
        """Have the rows of served robots written again when due; return at once."""
        now = time.monotonic()
        if not self._own or now - self._refreshed < REFRESH_S:
            return
        with self._lock:
            self._refreshed = now
            at = self._clock()
            self._own = {key: replace(row, at=at) for key, row in self._own.items()}
            self._changed.update(self._own)
            self._start()

    def was_here(self, network: NetworkKey, name: str) -> float | None:
        """Return the seconds since a robot was last served from here.

        None where that is over ten minutes ago, or never. Call it before :meth:`serve`: it is how a fresh start knows
        that a stop may have been missed. It waits a second at most for the disk, and where the file cannot be read it
        returns 0, so that the robot asks.

        Raises:
            DuplicateDeviceError: another live process with this state directory serves it, and callers would take the
                two, which sign with one key, for one robot. A process that is just ending gets two seconds.
        """
        rows = self._rows_where_free(network, name, begins=False)
        if rows is None:
            return 0.0
        now, known = self._clock(), [*rows, *self._changed.copy().values()]
        ages = [row.at.age_s(now) for row in known if row.name == name and row.network.meets(network)]
        recent = [age for age in ages if age < RECENT_S]
        return max(0.0, min(recent)) if recent else None

    def _rows_where_free(self, network: NetworkKey, name: str, *, begins: bool) -> list[Served] | None:
        """Return the rows of a robot once nobody else serves it; None if unreadable.

        Args:
            begins: take its start lock, until its row is written.

        Raises:
            DuplicateDeviceError: as :meth:`was_here`; or another process held the lock for two seconds.
        """
        until = time.monotonic() + LEAVES_S
        while True:
            try:
                taken, rows = self._within(lambda: self._looked(network, name, begins=begins), READ_S)
            except OSError as exc:
                logger.warning("%s: it is not known whether another process serves it: %s", name, exc)
                return None
            now = self._clock()
            other = next((row for row in rows if row.holds(network, name, now)), None)
            if taken and other is None:
                return rows
            if time.monotonic() >= until:
                if begins:
                    self._starts.free(network, name)
                who = "another process of this machine, which is just starting it"
                if other is not None:
                    where = f"{KINDS[other.network.kind]} ({', '.join(other.network.where)})"
                    who = f"process {other.pid} of this machine, on {where}"
                raise DuplicateDeviceError(
                    f"{name} is served already by {who}. Both would have one key and be taken for one robot: give this "
                    f"one another peer_id, or a state directory of its own with STRANDS_STATE_DIR."
                )
            time.sleep(LEAVES_EVERY_S)

    def _looked(self, network: NetworkKey, name: str, *, begins: bool) -> tuple[bool, list[Served]]:
        if not begins:
            # The count first: a row that is written after it counts anew. Without it the next look reads the rows.
            with contextlib.suppress(OSError):
                self._starts_seen[network, name] = self._starts.count(network, name)
            return True, self.file.served(name)
        # The lock first: who had it before has written by now.
        before, seen = self._starts.take(network, name), self._starts_seen.pop((network, name), None)
        if before is not None and before == seen:
            return True, []
        return before is not None, self.file.served(name)

    def flush(self, within: float = ENDING_S) -> bool:
        """Write what is queued now; False where that takes over ``within`` seconds."""
        deadline = time.monotonic() + within
        with self._lock:
            attempts = self._attempts
            while self._waiting or self._writing:
                self._hurry = True
                if not self._start():
                    break
                self._lock.notify_all()
                left = deadline - time.monotonic()
                if left <= 0 or (self.problem and self._attempts > attempts + 1):
                    return False
                self._lock.wait(left)
            else:
                return True
        # The interpreter ends and gives no more threads.
        return self._write_batch() == ""

    def read(self, now: Moment | None = None) -> tuple[list[RosterRow], str]:
        """Return the robots of the ten minutes before ``now``, and a problem or "".

        A robot that was heard since ``now`` is among them. It waits a second at most for the disk; never call it before
        a stop has left.
        """
        written = self.flush(READ_S)
        problem = "" if written else (self.problem or "sightings.db was not written in time")
        try:
            found, missing = self._within(lambda: self.file.read(now or self._clock()), READ_S)
        except OSError as exc:
            return [], str(exc)
        return found, problem or missing

    @property
    def _waiting(self) -> bool:
        return bool(self._notes or self._answers or self._changed)

    def _admitted(self, key: tuple[NetworkKey, str], now: float, facts: Facts) -> bool:
        """Return True where a name has a place in memory; longest heard first."""
        if key not in self._noted and len(self._noted) >= ROWS_MAX:
            if now - self._tidied < AGAIN_S:
                self._crowded = True
                return False
            self._tidied = now
            self._noted = {each: noted for each, noted in self._noted.items() if now - noted[0] < RECENT_S}
            if len(self._noted) >= ROWS_MAX:
                self._crowded = True
                return False
        self._noted[key] = now, facts
        return True

    def _start(self) -> bool:
        """Start the writing thread unless it runs; the lock is held. False without one."""
        if self._thread is not None and self._thread.is_alive():
            return True
        _STARTED.add(self)
        thread = threading.Thread(target=self._work, name="sightings", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            return False
        self._thread = thread
        return True

    def _work(self) -> None:
        failed, pause = 0, BATCH_S
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._hurry, pause)
                self._hurry = False
                if not self._waiting or failed > RETRIES:
                    # One that begins from here on is written by the next thread.
                    unwritten = tuple(self._changed)
                    self._thread = None
                    self._lock.notify_all()
                    break
            problem = self._write_batch()
            failed, pause = (failed + 1, RETRY_S) if problem else (0, BATCH_S)
        # Where the disk takes no row, the next start is not refused for it.
        self._free_starts(unwritten)

    def _write_batch(self) -> str:
        """Write what is queued, and queue it again where that fails; return the problem."""
        with self._lock:
            notes = list(self._notes)
            self._notes.clear()
            answers, self._answers = self._answers, []
            served, self._changed = self._changed, {}
            self._writing = True
        problem = "it failed"
        try:
            problem = self._write(notes, answers, served)
            if not problem:
                self._free_starts(served)
        finally:
            self._written(notes, answers, served, problem)
        return problem

    def _free_starts(self, served: Iterable[tuple[NetworkKey, str]]) -> None:
        for network, name in served:
            self._starts.free(network, name)

    def _written(
        self,
        notes: list[Note],
        answers: list[_Answer],
        served: dict[tuple[NetworkKey, str], Served],
        problem: str,
    ) -> None:
        """Note the outcome of a write."""
        with self._lock:
            if problem:
                self._notes = deque([*notes, *self._notes], self._notes.maxlen)
                self._changed = {**served, **self._changed}
                self._answers = (answers + self._answers)[:ANSWERS_MAX]
            if problem and problem != self.problem:
                logger.warning("Robots that are heard are not remembered: %s", problem)
            self.problem = problem
            self._attempts += 1
            self._writing = False
            self._lock.notify_all()

    def _write(
        self,
        notes: Iterable[Note],
        answers: Iterable[_Answer],
        served: Mapping[tuple[NetworkKey, str], Served],
    ) -> str:
        """Write one batch; return the problem, or ""."""
        signed = [(each, key) for each in answers if (key := _key_of(each)) is not None]
        counted = self._counted(signed)
        all_notes = [*notes, *(Note(each.network, each.name, each.at, each.at) for each, _ in counted)]
        crowded, self._crowded = self._crowded, False
        try:
            self.file.write(all_notes, list(served.values()), self._clock(), crowded=crowded)
        except SightingFileError as exc:
            return str(exc)
        # Without a nonce of ours it may be an answer to somebody else.
        proven = [(each.network, each.name, key) for each, key in signed if each.expected]
        for network, name in served:
            public = self._publics.pop((network, name), None)
            if public is not None:
                proven.append((network, name, public))
        self._heard_signed(proven)
        return ""

    def _counted(self, signed: Collection[tuple[_Answer, bytes]]) -> list[tuple[_Answer, bytes]]:
        """Return the answers that count as signed.

        A key costs nothing. Where robots are enrolled for the network it must be one of theirs, or of this machine.
        """
        try:
            enrolled = EnrolledKeys(self.directory).robots() if signed else {}
        except (StrandsRobotsError, OSError):
            return list(signed)  # the reader says so
        keys = {each.key for each in enrolled.values()}

        def counts(answer: _Answer, key: bytes) -> bool:
            network = answer.network
            known = of_tenant(enrolled, network.tenant).values()
            here = (each for each in known if not each.networks or any(own.meets(network) for own in each.networks))
            own = key_here(local_name(network.tenant, answer.name), self.directory)
            return key in keys or all(each.exemption for each in here) or key == own

        return [(answer, key) for answer, key in signed if counts(answer, key)]

    def _heard_signed(self, proven: Iterable[tuple[NetworkKey, str, bytes]]) -> None:
        """End the exemption of enrolled robots that were heard, and keep their network."""
        proven = list(proven)
        if not proven:
            return
        try:
            enrolled = EnrolledKeys(self.directory)
            for network, name, key in proven:
                undone = enrolled.heard(local_name(network.tenant, name), key, network)
                if undone is not None:
                    facts = {"was": undone.state, "by": undone.by, "network": network.text}
                    log_safety_event("exemption_undone", name, facts)
                    logger.warning("%s was %s and was heard with its enrolled key: it must answer.", name, undone.state)
        except (StrandsRobotsError, OSError) as exc:
            logger.warning("The enrolled robots could not be updated: %s", exc)

    def _within(self, work: Callable[[], T], seconds: float) -> T:
        """Run ``work`` on a thread; a disk that hangs holds up no command."""
        done: list[T] = []
        failed: list[OSError] = []

        def run() -> None:
            try:
                done.append(work())
            except OSError as exc:
                failed.append(exc)

        thread = threading.Thread(target=run, name="sightings-read", daemon=True)
        thread.start()
        thread.join(seconds)
        if failed:
            raise failed[0]
        if not done:
            raise SightingFileError(f"{self.file.path.name} was not read within {seconds:g} s")
        return done[0]


def _key_of(answer: _Answer) -> bytes | None:
    """Return the key that an answer is signed with; None for an old answer."""
    fields = answer.statement
    if any(fields.get(name) != value for name, value in answer.expected.items()):
        return None
    at = fields.get("t")
    if not answer.expected and (not isinstance(at, int | float) or abs(answer.at.wall - at) > STATED_WITHIN_S):
        return None
    return own_key(answer.purpose, answer.name, fields)


def _storable(name: str) -> bool:
    """Return True for a name that a file can hold, never half a character."""
    return 0 < len(name) <= NAME_MAX and name.isprintable()


_STARTED: WeakSet[Sightings] = WeakSet()


def flush_sightings(within: float = ENDING_S) -> None:
    """Write what is queued, at the end of the process."""
    for store in tuple(_STARTED):
        store.flush(within)


atexit.register(flush_sightings)


@lru_cache(maxsize=16)
def _of(directory: Path) -> Sightings:
    return Sightings(directory)


def sightings() -> Sightings:
    """Return the sightings of the state directory."""
    return _of(state_dir())


PLACES = 2**20
"""Locks of the file. Robots that share one by chance begin one after another, no more."""


class StartLocks:
    """Locks by which processes begin to serve a robot one after another.

    They are of one state directory; any thread may call. A process holds the lock of a robot from its last look at who
    serves it until its own row is on disk, so that of two which begin at once the later one sees the earlier. Locks
    are bytes of one file; the system frees those of a process that dies. Each counts how often it was given back,
    after the row was written: a process sees by it that no row has come since it looked.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "starting.lock"
        self._lock = threading.Lock()
        self._held: dict[tuple[NetworkKey, str], int] = {}
        self._descriptor: int | None = None

    def count(self, network: NetworkKey, name: str) -> int:
        """Return how often the lock of a robot was given back, modulo 256.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock:
            try:
                return self._count(self._opened(), _place(network, name))
            finally:
                self._close_unused()

    def take(self, network: NetworkKey, name: str) -> int | None:
        """Take the lock of a robot, at once; None while another process holds it.

        Robots of one name and tenant share a lock, whatever their network.

        Returns:
            The present :meth:`count`.

        Raises:
            OSError: the file cannot be locked.
        """
        place = _place(network, name)
        with self._lock:
            try:
                descriptor = self._opened()
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
                self._held[network, name] = place
                return self._count(descriptor, place)
            except BlockingIOError:
                return None
            finally:
                self._close_unused()

    def free(self, network: NetworkKey, name: str) -> None:
        """Give the lock of a robot back, where this process holds it."""
        with self._lock:
            place = self._held.pop((network, name), None)
            if self._descriptor is None or place is None:
                return
            # On a full disk the row was not written either.
            with contextlib.suppress(OSError):
                os.pwrite(self._descriptor, bytes([(self._count(self._descriptor, place) + 1) % 256]), place)
            if place not in self._held.values():
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN, 1, place)
            self._close_unused()

    @staticmethod
    def _count(descriptor: int, place: int) -> int:
        return int.from_bytes(os.pread(descriptor, 1, place), "big")

    def _opened(self) -> int:
        if self._descriptor is None:
            make_private(self._path.parent)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            self._descriptor = os.open(self._path, flags, 0o600)
        return self._descriptor

    def _close_unused(self) -> None:
        # Closing any descriptor of the file frees every lock of this process.
        if self._descriptor is not None and not self._held:
            os.close(self._descriptor)
            self._descriptor = None


def _place(network: NetworkKey, name: str) -> int:
    digest = hashlib.sha256(f"{network.tenant} {name}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % PLACES
