"""Clearances: ``resume --local`` clears robots, running or not.

A user who may write into the state directory, which is its owner's alone, is at the machine. A file there orders the
clearance of one robot and names the operator; each process looks while one of its robots is locked, takes the orders
for its robots, and audits the operator. Orders older than a minute are void.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from strands_robots.audit import log_safety_event
from strands_robots.safety.persistence import LockoutStore
from strands_robots.state_files import (
    StateFileError,
    boot,
    make_private,
    read_private,
    require_private,
    state_dir,
    uptime,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import identifier, text

logger = stop_logger(__name__)

VALID_S = 60.0

CLEARED = "cleared"
NOT_KEPT = "cleared, but not kept on the disk: after a restart it may be locked again"
NOT_LOCKED = "not locked here"
LEFT = "it left its process meanwhile; ask again"
VOID = "its process found the order older than a minute, or ahead of its clock; nothing was cleared"


def clearances() -> Path:
    """Return the directory of the orders."""
    return state_dir() / "clearances"


def order_clearance(who: str, robot_ids: Iterable[str]) -> list[Path]:
    """Write an order for each robot; its process takes it within a second.

    Raises:
        ValidationError: ``who`` is blank, or a name is no identifier.
        OSError: the state directory cannot be written.
    """
    text("who", who, longest=200)
    names = [identifier("robot_id", each) for each in robot_ids]
    directory = clearances()
    make_private(directory)
    asked = {"who": who, "boot": boot(), "t": uptime()}
    return [_write_order(directory, {**asked, "robot_id": name}) for name in names]


def clear_here(who: str, robot_ids: Iterable[str], wait_s: float = 2.0) -> dict[str, str]:
    """Clear robots of this machine for the operator ``who``, running or not.

    Returns, for each name, the outcome: that of its running process, ``cleared`` where it did so and kept it; ``cleared
    on disk`` where none runs; ``not locked here``; or that the process took the order and has not carried it out.
    Waits at most ``wait_s`` seconds for the processes to take the orders and as long for them to carry them out.
    What was cleared is recorded in the audit.

    Raises:
        ValidationError: ``who`` is blank, or a name is no identifier.
        OSError, ValueError: the state directory or the lockout file cannot be used.
    """
    names = list(dict.fromkeys(robot_ids))
    orders = dict(zip(names, order_clearance(who, names), strict=True))
    _until(lambda: not any(path.exists() for path in orders.values()), time.monotonic() + wait_s)
    deadline = time.monotonic() + wait_s
    outcome: dict[str, str] = {}
    for name, path in orders.items():
        try:
            path.unlink()
        except FileNotFoundError:
            outcome[name] = _answered(path, deadline)
        else:
            outcome[name] = "cleared on disk" if _clear_on_disk(who, name) else NOT_LOCKED
    return outcome


def _answered(order: Path, deadline: float) -> str:
    answer_file = _answer_of(order)
    if _until(answer_file.exists, deadline):
        answer = answer_file.read_text(encoding="utf-8")
        answer_file.unlink(missing_ok=True)
        return answer
    _taken(order).unlink(missing_ok=True)
    return "its process took the order and has not carried it out; ask for its state"


def _until(condition: Callable[[], bool], deadline: float) -> bool:
    while not condition():
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.02)
    return True


def _taken(order: Path) -> Path:
    """Return the path of an order while its process clears the robot."""
    return order.with_suffix(".taken")


def _answer_of(order: Path) -> Path:
    """Return the path of the answer of the process that took an order."""
    return order.with_suffix(".said")


def _clear_on_disk(who: str, name: str) -> bool:
    store = LockoutStore()
    locked = {key: kept for key, kept in store.load_all().items() if kept.name == name and kept.state.locked}
    if not locked:
        return False
    store.save({key: kept.freed() for key, kept in locked.items()})
    for kept in locked.values():
        log_safety_event("resume_local", name, {"who": who, "epochs": list(kept.state.epochs), "persisted": True})
    return True


def _write_order(directory: Path, order: dict[str, Any]) -> Path:
    path = directory / f"{secrets.token_hex(8)}.json"
    draft = path.with_suffix(".draft")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        json.dump(order, file)
    return draft.replace(path)


class ClearanceInbox:
    """Orders for the robots of this process.

    Args:
        here: returns the ids of the robots of this process.
        clear: clears the named robot for the named operator, and returns the outcome.
    """

    def __init__(self, here: Callable[[], Collection[str]], clear: Callable[[str, str], str]) -> None:
        self._here = here
        self._clear = clear
        self._looked = float("-inf")

    def look(self, every_s: float = 0.3) -> None:
        """Take the orders for robots of this process and act on those still valid."""
        now = time.monotonic()
        if now - self._looked < every_s:
            return
        self._looked = now
        for path, order in _orders():
            if order["robot_id"] not in self._here():
                continue
            try:
                taken = path.replace(_taken(path))
            except FileNotFoundError:
                continue  # another process took it
            valid = order["boot"] == boot() and 0 <= uptime() - order["t"] < VALID_S
            answer = self._clear(order["who"], order["robot_id"]) if valid else VOID
            with contextlib.suppress(FileNotFoundError):  # no caller waits for it any more
                with taken.open("r+", encoding="utf-8") as file:
                    file.truncate()
                    file.write(answer)
                taken.replace(_answer_of(path))


def _orders() -> Iterator[tuple[Path, dict[str, Any]]]:
    directory = clearances()
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):  # there was no order yet
        directory.lstat()
        try:
            require_private(directory, state_dir())
        except StateFileError as exc:
            logger.critical("No clearance is taken: %s", exc)
            return
        _sweep(directory)
        for path in sorted(directory.glob("*.json")):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # taken by another, or no order
                order = json.loads(read_private(path, state_dir()))
                names = {name: str(order[name]) for name in ("who", "robot_id", "boot")}
                yield path, {**names, "t": float(order["t"])}


def _sweep(directory: Path) -> None:
    """Remove orders of processes that died, and answers that no caller waited for."""
    for path in directory.iterdir():
        with contextlib.suppress(OSError):  # gone meanwhile, or none of ours
            if path.suffix in (".taken", ".draft", ".said") and time.time() - path.lstat().st_mtime > VALID_S:
                path.unlink()
