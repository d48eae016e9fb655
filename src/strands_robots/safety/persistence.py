"""Lockouts, resumed epochs and the stops themselves on disk: two files a robot.

A robot is kept under a key that outlives the process (see :func:`hardware_key`); a robot without one, an unnamed
simulation, is not kept. Files of different robots never wait for one another, whichever processes write them. A file
that cannot be read locks: its robot comes up under the overflow epoch, which an operator at the machine clears.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from strands_robots.safety import ed25519
from strands_robots.safety.lockout import (
    ANY_TIME,
    LONG_AGO,
    MAX_EPOCHS,
    OVERFLOW,
    Lockout,
    LockoutState,
    Span,
    is_epoch,
    with_cleared,
    with_resumed,
)
from strands_robots.safety.scope import SCOPE, Scope
from strands_robots.state_files import (
    StateFileError,
    adopt,
    boot,
    make_private,
    read_private,
    require_private,
    state_dir,
    uptime,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import field_values

logger = stop_logger(__name__)

VERSION = 2
RESUMED_VERSION = 1
VERSION_OF_ALL = 1
"""Version of ``lockouts.json``, in which earlier releases kept all robots of a machine."""


@dataclass(frozen=True, slots=True)
class ResumedEpochs:
    """Epochs that a robot was resumed from, and the beginning of that record.

    Attributes:
        since: seconds since boot at which the robot was first registered on this state directory.
        cleared: moments between which it was locked by more stops than it tells apart, until it was cleared.
    """

    epochs: Mapping[str, None] = field(default_factory=dict)
    since: float = field(default_factory=uptime)
    cleared: tuple[Span, ...] = ()

    def holds(self, epochs: Mapping[str, None], cleared: tuple[Span, ...]) -> bool:
        """Return True where it is the record of these very objects."""
        return self.epochs is epochs and self.cleared is cleared


@dataclass(frozen=True, slots=True)
class StoredLockout:
    """State with which a robot starts: lockouts, seen stops, network name.

    Attributes:
        originals: the stops that lock it, as they arrived.
        resumed: None where there is no record yet; a lockout that is saved without leaves it as it is.
        crowd: first and last moment, in seconds since boot, of the stops that the overflow stands for.
    """

    state: LockoutState = field(default_factory=LockoutState)
    seen: tuple[str, ...] = ()
    name: str = ""
    originals: tuple[Original, ...] = ()
    resumed: ResumedEpochs | None = None
    crowd: Span = ANY_TIME

    def freed(self) -> StoredLockout:
        """Return the record after an operator cleared the robot."""
        state, resumed = self.state, self.resumed or ResumedEpochs()
        epochs = with_resumed(dict(resumed.epochs), [*self.seen, *state.resumable])
        spans = with_cleared(resumed.cleared, state, self.crowd)
        freed = replace(resumed, epochs=epochs, cleared=spans)
        return replace(self, state=LockoutState(), originals=(), resumed=freed)


def hardware_key(kind: str, stable_id: str) -> str:
    """Return the key of real hardware: its kind and an id of its own."""
    return f"hardware:{kind}:{stable_id}"


def simulation_key(peer_id: str) -> str:
    """The key of a simulation that was given a peer id."""
    return f"simulation:{peer_id}"


class LockoutStore:
    """Directory ``lockouts`` in ``state``, by default the state directory.

    ``lockouts.json`` of an earlier release is read for robots that have no file of their own yet, and put aside if
    it cannot be read.
    """

    def __init__(self, state: Path | None = None) -> None:
        self._state = state

    @property
    def root(self) -> Path:
        """The state directory."""
        return self._state or state_dir()

    @property
    def directory(self) -> Path:
        """The directory of the files."""
        return self.root / "lockouts"

    @property
    def file_of_all(self) -> Path:
        """The one file of an earlier release."""
        return self.directory.with_suffix(".json")

    @property
    def resumed_directory(self) -> Path:
        """The directory of the records of resumed epochs."""
        return self.root / "resumed"

    def file(self, key: str) -> Path:
        """The file of one robot, named for a person and distinct by a hash."""
        readable = re.sub(r"[^A-Za-z0-9._-]+", "_", key)[:64]
        return self.directory / f"{readable}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.json"

    def resumed_file(self, key: str) -> Path:
        """The record of one robot's resumed epochs."""
        return self.resumed_directory / self.file(key).name

    def load(self, key: str) -> StoredLockout:
        """Return the record of ``key``: empty if absent, locked if unreadable.

        A file of another user, or in a folder that others may write, locks as well: what it does not say counts least.
        A robot without a record is locked as well while a ``lockouts.json`` that could not be read lies there, or lies
        aside as ``lockouts.unreadable``.
        """
        try:
            return self._found(key)
        except (OSError, ValueError) as exc:
            logger.critical("The lockout file of %s cannot be read (%s): it comes up locked.", key, exc)
            foreign = isinstance(exc, StateFileError)
            why = "the lockout file is not this user's alone" if foreign else "the lockout file is unreadable"
            unreadable = Lockout(OVERFLOW, "this machine", why, time.time())
            return StoredLockout(LockoutState(overflow=unreadable))

    def load_all(self) -> dict[str, StoredLockout]:
        """Every record, by key.

        Raises:
            OSError, ValueError: a file cannot be read or is no record of lockouts.
        """
        found = {key: _kept(record) for key, record in self._of_all().items()}
        for path in self._files():
            record = self._read(path, VERSION)
            if record is not None:
                key = str(record.get("key", path.name))
                found[key] = replace(_kept(record), resumed=self._resumed(key))
        return found

    def save(self, kept: Mapping[str, StoredLockout]) -> None:
        """Write these records, and return when all are on the disk.

        Raises:
            OSError: not written.
        """
        records = {self.file(key): {"v": VERSION, "key": key, **_record(each)} for key, each in kept.items()}
        self._put_aside()
        self.save_resumed({key: each.resumed for key, each in kept.items() if each.resumed is not None})
        self._save(self.directory, records)

    def save_resumed(self, resumed: Mapping[str, ResumedEpochs]) -> None:
        """Write the records of resumed epochs, and return when all are on the disk.

        Raises:
            OSError: not written.
        """
        if not resumed:
            return
        records = {}
        for key, each in resumed.items():
            spans = [[moment(at) for at in span] for span in each.cleared]
            stated = {"v": RESUMED_VERSION, "key": key, **moment(each.since), "epochs": list(each.epochs)}
            records[self.resumed_file(key)] = {**stated, **({"cleared": spans} if spans else {})}
        self._save(self.resumed_directory, records)

    def _save(self, directory: Path, records: Mapping[Path, dict[str, Any]]) -> None:
        if not directory.exists():
            adopt(self.root)
            make_private(directory)
            _sync(directory.parent)
        with ExitStack() as files:
            # All are written before the first is waited for: the disk takes them together.
            drafts = []
            for path, record in records.items():
                draft = _draft_of(path)
                descriptor = files.enter_context(_opened(draft))
                _write(descriptor, record)
                drafts.append((descriptor, draft, path))
            for descriptor, draft, path in drafts:
                os.fsync(descriptor)
                draft.replace(path)
        _sync(directory)

    def _found(self, key: str) -> StoredLockout:
        adopt(self.root)
        # A folder that others may write says nothing by what is not in it.
        require_private(self.directory, self.root)
        require_private(self.resumed_directory, self.root)
        path, resumed = self.file(key), self._resumed(key)
        record = self._read(path, VERSION)
        if record is not None:
            if record.get("key") != key:
                raise ValueError(f"{path.name} is of another robot")
            return replace(_kept(record), resumed=resumed)
        earlier = self._of_all().get(key)
        if earlier is not None:
            return replace(_kept(earlier), resumed=resumed)
        if self._aside.exists():
            raise ValueError(f"what was kept of this robot may stand in {self._aside.name}")
        return StoredLockout(resumed=resumed)

    def _resumed(self, key: str) -> ResumedEpochs | None:
        """Return the record of ``key``, None where there is none.

        Raises:
            OSError, ValueError: it cannot be read, or is none.
        """
        path = self.resumed_file(key)
        record = self._read(path, RESUMED_VERSION)
        if record is None:
            return None
        try:
            epochs = dict.fromkeys(each for each in record["epochs"] if is_epoch(each))
            # A clock that was set back since tells no age: every stop may be of its time.
            set_back = record["boot"] != boot() and time.time() < float(record["wall"])
            since = LONG_AGO if set_back else since_boot(record)
            cleared = tuple((since_boot(first), since_boot(last)) for first, last in record.get("cleared", ()))
        except (KeyError, TypeError, ValueError) as exc:
            raise ValueError(f"{path.name} is no record of resumed epochs: {exc!r}") from exc
        if record.get("key") != key:
            raise ValueError(f"{path.name} is of another robot")
        return ResumedEpochs(epochs, since, cleared)

    @property
    def _aside(self) -> Path:
        return self.file_of_all.with_suffix(".unreadable")

    def _put_aside(self) -> None:
        """Keep an unreadable file of an earlier release for a person to look at."""
        try:
            self._of_all()
        except ValueError:
            with contextlib.suppress(FileNotFoundError):  # another process was first
                self.file_of_all.replace(self._aside)

    def _files(self) -> list[Path]:
        try:
            return sorted(path for path in self.directory.iterdir() if path.suffix == ".json")
        except FileNotFoundError:
            return []

    def _of_all(self) -> dict[str, Any]:
        data = self._read(self.file_of_all, VERSION_OF_ALL)
        if data is None:
            return {}
        robots = data.get("robots")
        if robots is None or not isinstance(robots, dict):
            raise ValueError(f"{self.file_of_all.name} is no record of lockouts")
        return robots

    def _read(self, path: Path, version: int) -> dict[str, Any] | None:
        """Return what a file of lockouts holds, None where there is no file.

        Raises:
            OSError, ValueError: it cannot be read, is not this user's alone, or is none of this version.
        """
        try:
            data = json.loads(read_private(path, self.root))
        except FileNotFoundError:
            return None
        if not isinstance(data, dict) or data.get("v") != version:
            raise ValueError(f"{path.name} is no record of lockouts")
        return data


def _record(kept: StoredLockout) -> dict[str, Any]:
    return {
        "name": kept.name,
        "holds": [_fields(each) for each in kept.state.lockouts],
        "overflow": _fields(kept.state.overflow) if kept.state.overflow else None,
        **(_crowd_fields(kept.crowd) if kept.state.overflow else {}),
        "seen": list(kept.seen),
        **({"originals": [each.record() for each in _fitting(kept.originals)]} if kept.originals else {}),
    }


def _crowd_fields(crowd: Span) -> dict[str, Any]:
    since, until = crowd
    last = {"crowded_until": moment(until)} if math.isfinite(until) else {}
    return {"crowded": moment(since), **last}


def _fitting(originals: tuple[Original, ...]) -> list[Original]:
    return newest_within(originals, STORED_MAX_BYTES, lambda each: len(each.payload))


def _fields(lockout: Lockout) -> dict[str, Any]:
    # Releases that know no scope read the other fields, and write none.
    return {**field_values(lockout), SCOPE: lockout.scope.value()}


def _kept(record: Mapping[str, Any]) -> StoredLockout:
    try:
        return _stored(record)
    except (KeyError, TypeError, AttributeError) as exc:
        raise ValueError(f"no record of lockouts: {exc!r}") from exc


def _stored(record: Mapping[str, Any]) -> StoredLockout:
    lockouts = tuple(_lockout(each) for each in record["holds"])
    overflow = _lockout(record["overflow"]) if record["overflow"] is not None else None
    if len(lockouts) > MAX_EPOCHS or len({each.epoch for each in lockouts}) != len(lockouts):
        raise ValueError("more epochs than a robot tells apart, or one of them twice")
    seen = tuple(each for each in record["seen"] if is_epoch(each))
    originals = tuple(Original.of(each) for each in record.get("originals", ()))
    since, until = ANY_TIME
    since = since_boot(record["crowded"]) if "crowded" in record else since
    # Earlier releases kept no end.
    until = since_boot(record["crowded_until"]) if "crowded_until" in record else until
    state, name = LockoutState(lockouts, overflow), str(record.get("name", ""))
    return StoredLockout(state, seen, name, originals, crowd=(since, until))


def _lockout(data: Mapping[str, Any]) -> Lockout:
    lockout = Lockout(data["epoch"], data["source"], data["reason"], float(data["at"]), Scope.read(data.get(SCOPE)))
    if not all(isinstance(part, str) for part in (lockout.epoch, lockout.source, lockout.reason)):
        raise ValueError("a lockout whose fields are not text")
    return lockout


@contextlib.contextmanager
def _opened(draft: Path) -> Iterator[int]:
    """Open a draft, and remove it unless it was renamed."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(draft, flags, 0o600)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
        draft.unlink(missing_ok=True)


def _draft_of(path: Path) -> Path:
    # Of this writer: another process may clear a robot that is just coming up here.
    return path.with_suffix(f".{os.getpid()}-{threading.get_ident()}.draft")


def _write(descriptor: int, data: Mapping[str, Any]) -> None:
    text = json.dumps(data, separators=(",", ":")).encode()
    if os.write(descriptor, text) != len(text):
        raise OSError("a part of the lockout fitted on the disk")


def _sync(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


STOPS_MAX = 64
"""Originals kept, and told in one answer."""

ORIGINAL_MAX_BYTES = 8 * 2**10
"""A longer stop locks as any other one and is not passed on."""

STORED_MAX_BYTES = 56 * 2**10
"""Bytes of originals in the lockout file of one robot, as many as an answer holds."""


@dataclass(frozen=True, slots=True)
class Original:
    """One emergency stop as it arrived.

    Attributes:
        epoch: its id, stated by itself.
        source: who stops, as declared.
        payload: the message.
        network: where it was received; it is passed on nowhere else.
        received: seconds since boot of its first receipt, see :func:`~strands_robots.state_files.uptime`.
        learnt: that moment is one that an answer to this process stated.
    """

    epoch: str
    source: str
    payload: bytes
    network: str
    received: float
    learnt: bool = False

    def record(self) -> dict[str, Any]:
        """Return the original as it stands in a file."""
        event = ed25519.encode(self.payload)
        stated = {"epoch": self.epoch, "source": self.source, "event": event, "network": self.network}
        return {**stated, **moment(self.received), **({"learnt": True} if self.learnt else {})}

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Original:
        """Read an original of a file.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        payload = ed25519.decode_up_to(record["event"], ORIGINAL_MAX_BYTES)
        texts = [record[name] for name in ("epoch", "source", "network")]
        if payload is None or not all(isinstance(each, str) for each in texts):
            raise ValueError("an original without its bytes or its names")
        return cls(texts[0], texts[1], payload, texts[2], since_boot(record), record.get("learnt") is True)


def moment(up: float) -> dict[str, Any]:
    """Return a moment in seconds since boot as it stands in a file."""
    return {"boot": boot(), "up": up, "wall": time.time() - (uptime() - up)}


def since_boot(record: Mapping[str, Any]) -> float:
    """Return a recorded moment in seconds since boot, below 0 if of an earlier one.

    Within a boot no clock that can be set counts.
    """
    if record["boot"] == boot():
        return float(record["up"])
    return uptime() - max(0.0, time.time() - float(record["wall"]))


def newest_within(originals: Sequence[Original], longest: int, length: Callable[[Original], int]) -> list[Original]:
    """Return the newest originals whose lengths sum up to ``longest``, oldest first.

    Sources take turns, so that many stops of one displace no other one's latest.
    """
    waiting: dict[str, list[Original]] = {}
    for each in sorted(originals, key=lambda each: each.received):
        waiting.setdefault(each.source, []).append(each)
    taken: list[Original] = []
    while waiting and len(taken) < STOPS_MAX:
        for source in list(waiting):
            each = waiting[source].pop()
            if not waiting[source]:
                del waiting[source]
            if length(each) <= longest and len(taken) < STOPS_MAX:
                longest -= length(each)
                taken.append(each)
    return sorted(taken, key=lambda each: each.received)


class Originals:
    """Originals of a process, kept while they lock one of its robots.

    :meth:`add` takes no lock; any thread may call.
    """

    def __init__(self) -> None:
        self._new: deque[Original] = deque(maxlen=2 * STOPS_MAX)
        self._stored: dict[tuple[str, str], tuple[Original, ...]] = {}
        self._lock = threading.Lock()

    def add(self, original: Original) -> None:
        """Keep an original; of several of one stop the first and the latest count.

        The latest may be for more robots than the first.
        """
        self._new.append(original)

    def younger(self, network: str, epoch: str, payload: bytes, received: float) -> None:
        """Correct the moment of an original that was learnt, if it was received later.

        Whoever states too high an age must not have others take a stop for one from before their time.
        """
        with self._lock:
            self._sort_in()
            rows = self._stored.get((network, epoch), ())
            if any(each.learnt and each.payload == payload and each.received < received for each in rows):
                self._stored[network, epoch] = tuple(
                    replace(each, received=received) if each.learnt and each.payload == payload else each
                    for each in rows
                )

    def has(self, epoch: str, network: str) -> bool:
        """Return True where this stop is kept, or is about to be."""
        try:
            new = tuple(self._new)
        except RuntimeError:
            # A collection of garbage let other threads run during the copy. To add one twice is no harm.
            new = ()
        return (network, epoch) in self._stored or any((each.network, each.epoch) == (network, epoch) for each in new)

    def of(self, epochs: Collection[str], network: str | None = None) -> list[Original]:
        """Return those of these epochs, oldest first."""
        with self._lock:
            self._sort_in()
            rows = [each for rows in self._stored.values() for each in rows]
        return [each for each in rows if each.epoch in epochs and network in (None, each.network)]

    def keep(self, epochs: Collection[str]) -> None:
        """Forget the originals of other epochs, and beyond :data:`STOPS_MAX` the oldest."""
        with self._lock:
            self._sort_in()
            held = [each for rows in self._stored.values() for each in rows if each.epoch in epochs]
            kept = newest_within(held, STOPS_MAX * ORIGINAL_MAX_BYTES, lambda each: len(each.payload))
            self._stored = {}
            self._take(kept)

    def _sort_in(self) -> None:
        new = [self._new.popleft() for _ in range(len(self._new))]
        self._take(new)

    def _take(self, originals: Iterable[Original]) -> None:
        for each in originals:
            key = (each.network, each.epoch)
            known = self._stored.get(key, ())
            if each not in known:
                self._stored[key] = (*known[:1], each)
