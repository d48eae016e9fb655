"""Lockouts on disk: one file for all robots of this machine.

A robot is kept under a key that outlives the process (see :func:`hardware_key`); a robot without one, an unnamed
simulation, is not kept. A file that cannot be read locks: a robot whose record is unreadable comes up
under the overflow epoch, which an operator at the machine clears.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.safety.approval import state_dir
from strands_robots.safety.lockout import MAX_EPOCHS, OVERFLOW, Lockout, LockoutState
from strands_robots.safety.resume import is_epoch

logger = logging.getLogger(__name__)

VERSION = 1
LOCK_WAIT_S = 0.5
FILE_MAX_BYTES = 16 * 2**20


@dataclass(frozen=True, slots=True)
class StoredLockout:
    """State with which a robot starts: lockouts, seen stops, network name."""

    state: LockoutState = field(default_factory=LockoutState)
    seen: tuple[str, ...] = ()
    name: str = ""


def hardware_key(kind: str, stable_id: str) -> str:
    """Return the key of real hardware: its kind and an id of its own."""
    return f"hardware:{kind}:{stable_id}"


def simulation_key(peer_id: str) -> str:
    """The key of a simulation that was given a peer id."""
    return f"simulation:{peer_id}"


class LockoutStore:
    """File ``lockouts.json`` in ``directory``, by default the state directory."""

    def __init__(self, directory: Path | None = None) -> None:
        self._directory = directory

    @property
    def path(self) -> Path:
        """The file."""
        return (self._directory or state_dir()) / "lockouts.json"

    @property
    def _aside(self) -> Path:
        return self.path.with_suffix(".unreadable")

    def load(self, key: str) -> StoredLockout:
        """Return the record of ``key``: empty if absent, locked if unreadable.

        A robot without a record is locked as well while a file that could not be read lies aside.
        """
        try:
            return self._found(key)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as exc:
            logger.critical("%s cannot be read (%s): %s comes up locked.", self.path, exc, key)
            unreadable = Lockout(OVERFLOW, "this machine", "the lockout file is unreadable", time.time())
            return StoredLockout(LockoutState(overflow=unreadable))

    def _found(self, key: str) -> StoredLockout:
        record = self._read().get(key)
        if record is not None:
            return _kept(record)
        if self._aside.exists():
            raise ValueError(f"what was kept of this robot may stand in {self._aside.name}")
        return StoredLockout()

    def load_all(self) -> dict[str, StoredLockout]:
        """Every record, by key.

        Raises:
            OSError, ValueError: the file cannot be read or is no record of lockouts.
        """
        try:
            return {key: _kept(record) for key, record in self._read().items()}
        except (KeyError, TypeError, AttributeError) as exc:
            raise ValueError(f"{self.path} holds no record of lockouts: {exc!r}") from exc

    def save(self, kept: Mapping[str, StoredLockout]) -> None:
        """Write these records beside those of other processes, and wait.

        Raises:
            OSError: not written; TimeoutError (one of its kinds) when another process holds the file.
        """
        path = self.path
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with _locked(path.with_name("lockouts.lock")):
            try:
                records = self._read()
            except ValueError:
                # The unreadable file is set aside for a person; a robot without a record comes up locked by it.
                path.replace(self._aside)
                records = {}
            records.update({key: _record(each) for key, each in kept.items()})
            _replace(path, {"v": VERSION, "robots": records})

    def _read(self) -> dict[str, Any]:
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            return {}
        with os.fdopen(descriptor, "rb") as file:
            data = json.loads(file.read(FILE_MAX_BYTES))
        if not isinstance(data, dict) or data.get("v") != VERSION or not isinstance(data.get("robots"), dict):
            raise ValueError("not a record of lockouts")
        robots: dict[str, Any] = data["robots"]
        return robots


def _record(kept: StoredLockout) -> dict[str, Any]:
    return {
        "name": kept.name,
        "holds": [asdict(each) for each in kept.state.lockouts],
        "overflow": asdict(kept.state.overflow) if kept.state.overflow else None,
        "seen": list(kept.seen),
    }


def _kept(record: Mapping[str, Any]) -> StoredLockout:
    lockouts = tuple(_lockout(each) for each in record["holds"])
    overflow = _lockout(record["overflow"]) if record["overflow"] is not None else None
    if len(lockouts) > MAX_EPOCHS or len({each.epoch for each in lockouts}) != len(lockouts):
        raise ValueError("more epochs than a robot tells apart, or one of them twice")
    seen = tuple(each for each in record["seen"] if is_epoch(each))
    return StoredLockout(LockoutState(lockouts, overflow), seen, str(record.get("name", "")))


def _lockout(data: Mapping[str, Any]) -> Lockout:
    lockout = Lockout(data["epoch"], data["source"], data["reason"], float(data["at"]))
    if not all(isinstance(part, str) for part in (lockout.epoch, lockout.source, lockout.reason)):
        raise ValueError("a lockout whose fields are not text")
    return lockout


def _replace(path: Path, data: dict[str, Any]) -> None:
    draft = path.with_suffix(".draft")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    with os.fdopen(os.open(draft, flags, 0o600), "wb") as file:
        file.write(json.dumps(data, separators=(",", ":")).encode())
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        deadline = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise TimeoutError(f"{path} is held by another process") from None
                time.sleep(0.005)
        yield
    finally:
        os.close(descriptor)
