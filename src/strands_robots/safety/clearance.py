"""The desk at the robot's own machine: how ``resume --local`` reaches a running process, and one that is not.

Whoever may write into the state directory, which is its owner's alone, is at the machine. A slip of paper laid
there names who clears which robots; each process looks while one of its robots is locked, takes what is meant for
its robots, and the audit says who laid it. Slips older than a minute are void.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from strands_robots.audit import flush_audit, log_safety_event
from strands_robots.safety.approval import state_dir
from strands_robots.safety.lockout import LockoutState
from strands_robots.safety.persistence import LockoutStore
from strands_robots.utils import identifier, text

logger = logging.getLogger(__name__)

VALID_S = 60.0


def clearances() -> Path:
    """Where the slips lie."""
    return state_dir() / "clearances"


def lay(who: str, robot_ids: Iterable[str]) -> list[Path]:
    """Lay a slip for each robot; it is taken within a second by the process that holds the robot.

    Raises:
        ValidationError: ``who`` is blank, or a name is no identifier.
        OSError: the state directory cannot be written.
    """
    text("who", who, longest=200)
    names = [identifier("robot_id", each) for each in robot_ids]
    directory = clearances()
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    return [_lay(directory, {"who": who, "robot_id": name, "t": time.time()}) for name in names]


def clear_here(who: str, robot_ids: Iterable[str], wait_s: float = 2.0) -> dict[str, str]:
    """Clear robots of this machine at the word of ``who``, whether their process runs or not.

    Returns, for each name: ``cleared`` once its running process has done so and kept it, ``cleared on disk`` where
    none runs, ``not locked here``, or that the process took the order and has not carried it out in ``wait_s``
    seconds. Recorded in the audit either way.

    Raises:
        ValidationError: ``who`` is blank, or a name is no identifier.
        OSError, ValueError: the state directory or the lockout file cannot be used.
    """
    names = list(dict.fromkeys(robot_ids))
    slips = dict(zip(names, lay(who, names), strict=True))
    _until(lambda: not any(path.exists() for path in slips.values()), wait_s)
    outcome: dict[str, str] = {}
    for name, path in slips.items():
        try:
            path.unlink()
        except FileNotFoundError:
            outcome[name] = _answered(path, wait_s)
        else:
            outcome[name] = "cleared on disk" if _clear_on_disk(who, name) else "not locked here"
    return outcome


def _answered(slip: Path, wait_s: float) -> str:
    taken = _taken(slip)
    if _until(lambda: not taken.exists(), wait_s):
        return "cleared"
    taken.unlink(missing_ok=True)
    return "its process took the order and has not carried it out; ask for its state"


def _until(condition: Callable[[], bool], wait_s: float) -> bool:
    deadline = time.monotonic() + wait_s
    while not condition():
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.02)
    return True


def _taken(slip: Path) -> Path:
    """Where a slip lies while the process that took it clears the robot."""
    return slip.with_suffix(".taken")


def _clear_on_disk(who: str, name: str) -> bool:
    store = LockoutStore()
    locked = {key: kept for key, kept in store.load_all().items() if kept.name == name and kept.state.locked}
    if not locked:
        return False
    store.save({key: replace(kept, state=LockoutState()) for key, kept in locked.items()})
    for kept in locked.values():
        log_safety_event("resume_local", name, {"who": who, "epochs": list(kept.state.epochs), "persisted": True})
    flush_audit()
    return True


def _lay(directory: Path, slip: dict[str, Any]) -> Path:
    path = directory / f"{secrets.token_hex(8)}.json"
    draft = path.with_suffix(".draft")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        json.dump(slip, file)
    return draft.replace(path)


class ClearanceDesk:
    """Looks for slips that are meant for this process.

    Args:
        here: the ids of the robots that this process holds.
        clear: clears the named robots at the word of somebody.
    """

    def __init__(self, here: Callable[[], Collection[str]], clear: Callable[[str, list[str]], object]) -> None:
        self._here = here
        self._clear = clear
        self._looked = float("-inf")

    def look(self, every_s: float = 0.3) -> None:
        """Take the slips for robots of this process and act on those still valid."""
        now = time.monotonic()
        if now - self._looked < every_s:
            return
        self._looked = now
        for path, slip in _slips():
            if slip["robot_id"] not in self._here():
                continue
            try:
                taken = path.replace(_taken(path))
            except FileNotFoundError:
                continue  # another process took it
            if -5.0 < time.time() - slip["t"] < VALID_S:
                self._clear(slip["who"], [slip["robot_id"]])
            taken.unlink(missing_ok=True)


def _slips() -> Iterator[tuple[Path, dict[str, Any]]]:
    directory = clearances()
    with contextlib.suppress(FileNotFoundError):  # nobody laid anything yet
        status = directory.lstat()
        if status.st_uid != os.getuid() or status.st_mode & 0o022:
            logger.error("%s may be written by others; no clearance is taken from it.", directory)
            return
        for path in sorted(directory.glob("*.json")):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # taken by another, or no slip
                if not path.is_symlink():
                    slip = json.loads(path.read_text())
                    yield path, {"who": str(slip["who"]), "robot_id": str(slip["robot_id"]), "t": float(slip["t"])}
