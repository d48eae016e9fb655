"""Orders of the operator: to resume robots, and to take one from its holder.

An assertion is exactly ``v``, ``epoch``, ``targets``, ``t``, ``nonce`` and ``sig``, the Ed25519 signature over the
canonical JSON of the other five. It clears one epoch of the robots it names, once, within a minute. Why one was
refused is for the local audit; the sender learns only that it was.

The order to take a robot names it and the epoch of its control lease. That epoch rises with each holder, so an order is
good once, and a restarted process begins above all epochs of the one before, so that a recorded order never fits again.
Neither a clock that is set back nor a second process with the same state directory changes that. The file
``control-epochs`` there has one byte for each robot that ever reserved its first epoch; the byte's place is the high
part of the epoch. The low part is random, so that a state directory that was lost or put back does not bring an epoch
back either.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.audit import log_safety_event
from strands_robots.safety import ed25519
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.persistence import LockoutStore
from strands_robots.state_files import (
    StateFileError,
    adopt,
    boot,
    make_private,
    read_private,
    require_private,
    state_dir,
    uptime,
    write_private,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, canonical_json, identifier, shown, text

logger = stop_logger(__name__)

VERSION = 1
FIELDS = frozenset({"v", "epoch", "targets", "t", "nonce", "sig"})
TARGETS_MAX = 256
OLDEST_S = 60.0
NEWEST_S = 5.0
REFUSALS_MAX = 5
BACK_OFF_S = 30.0
NONCES_MAX = 4096
ASSERTION_MAX_BYTES = 3600
"""Longest assertion, of the 4 KiB of a message that relays it, beside the relay's own fields."""

REJECTED = "resume rejected"
"""The one answer to every refused resume on the wire."""


class Denial(Enum):
    """Reasons to refuse an assertion, in the order of the checks."""

    BACKING_OFF = "backing off after five refusals"
    NO_KEYS = "no public key is configured"
    NOT_LOCKED = "no epoch is held"
    NO_OBJECT = "not an object"
    FIELDS = "not exactly the fields of an assertion"
    VERSION = "unknown version"
    SHAPES = "a field of the wrong shape"
    SIGNATURE = "no configured key made the signature"
    TARGETS = "this robot is not among the targets"
    EPOCH = "the epoch is not held"
    STALE = "not fresh"
    NONCE = "the nonce was used before"


def configured_keys() -> tuple[bytes, ...]:
    """The public keys of ``STRANDS_MESH_RESUME_PUBLIC_KEY``."""
    name = "STRANDS_MESH_RESUME_PUBLIC_KEY"
    return ed25519.public_keys(settings.items(name), name)


def sign(
    signing_key: Any, epoch: str, targets: Iterable[str], *, clock: Callable[[], float] = time.time
) -> list[dict[str, Any]]:
    """Return assertions that together clear ``epoch`` for all ``targets``.

    Raises:
        ValidationError: no targets, a target that is no identifier, or an epoch that is not 32 hex digits.
    """
    if not is_epoch(epoch):
        raise ValidationError(f"epoch must be 32 lower-case hex digits, not {shown(epoch)}.")
    wanted = sorted({identifier("target", target) for target in targets})
    if not wanted:
        raise ValidationError("targets must name at least one robot, not [].")
    return [_signed(signing_key, epoch, part, clock()) for part in _parts(wanted)]


def _parts(targets: Sequence[str]) -> list[list[str]]:
    # The other fields and their names take under 300 bytes; an identifier is ASCII, so its length is its size.
    room = ASSERTION_MAX_BYTES - 300
    parts: list[list[str]] = []
    used = room
    for target in targets:
        size = len(target) + 3
        if used + size > room or len(parts[-1]) >= TARGETS_MAX:
            parts.append([])
            used = 0
        parts[-1].append(target)
        used += size
    return parts


def _signed(signing_key: Any, epoch: str, targets: list[str], now: float) -> dict[str, Any]:
    body: dict[str, Any] = {
        "v": VERSION,
        "epoch": epoch,
        "targets": targets,
        "t": now,
        "nonce": secrets.token_hex(16),
    }
    return {**body, "sig": ed25519.encode(signing_key.sign(canonical_json(body)))}


@dataclass(frozen=True, slots=True)
class Admitted:
    """An assertion that passed every check, and the epoch it clears."""

    epoch: str


class ResumeVerifier:
    """Check of assertions for one robot, with nonces and refusals; thread-safe.

    Args:
        robot_ids: the names under which this robot may be a target.
        keys: gives the public keys; the configured ones by default, read at each check.
        clock: wall-clock seconds, against which ``t`` is held.
        monotonic: seconds, by which the back-off and the nonces age.
    """

    def __init__(
        self,
        robot_ids: Iterable[str],
        keys: Callable[[], Sequence[bytes]] = configured_keys,
        clock: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot_ids = frozenset(robot_ids)
        self._keys = keys
        self._clock = clock
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._nonces: dict[str, float] = {}
        self._refusals = 0
        self._closed_until = float("-inf")

    def check(self, assertion: object, held: Sequence[str]) -> Admitted | Denial:
        """Check that ``assertion`` clears one of the ``held`` epochs of this robot now."""
        with self._lock:
            now = self._monotonic()
            if now < self._closed_until:
                return Denial.BACKING_OFF
            verdict = self._verdict(assertion, held, now)
            if isinstance(verdict, Admitted):
                self._refusals = 0
                return verdict
            self._refusals += 1
            if self._refusals >= REFUSALS_MAX:
                self._refusals, self._closed_until = 0, now + BACK_OFF_S
            return verdict

    def _verdict(self, assertion: object, held: Sequence[str], now: float) -> Admitted | Denial:
        keys = self._keys()
        if not keys:
            return Denial.NO_KEYS
        if not held:
            return Denial.NOT_LOCKED
        if not isinstance(assertion, dict):
            return Denial.NO_OBJECT
        if set(assertion) != FIELDS:
            return Denial.FIELDS
        version = assertion["v"]
        if isinstance(version, bool) or not isinstance(version, int) or version != VERSION:
            return Denial.VERSION
        signature = ed25519.decode(assertion["sig"], 64)
        if signature is None or not _shapes(assertion):
            return Denial.SHAPES
        body = {key: value for key, value in assertion.items() if key != "sig"}
        if not ed25519.signed_by_one_of(keys, signature, canonical_json(body)):
            return Denial.SIGNATURE
        if self._robot_ids.isdisjoint(assertion["targets"]):
            return Denial.TARGETS
        if assertion["epoch"] not in held:
            return Denial.EPOCH
        age = self._clock() - assertion["t"]
        if not -NEWEST_S < age < OLDEST_S:
            return Denial.STALE
        if not self._first_use(assertion["nonce"], now):
            return Denial.NONCE
        return Admitted(assertion["epoch"])

    def _first_use(self, nonce: str, now: float) -> bool:
        if nonce in self._nonces:
            return False
        # Only an operator's signature brings a nonce here, and past this age freshness refuses it.
        old = [each for each, at in self._nonces.items() if now - at > OLDEST_S + NEWEST_S]
        for each in old:
            del self._nonces[each]
        if len(self._nonces) >= NONCES_MAX:
            del self._nonces[next(iter(self._nonces))]
        self._nonces[nonce] = now
        return True


def _shapes(assertion: dict[str, Any]) -> bool:
    targets, at = assertion["targets"], assertion["t"]
    if not is_epoch(assertion["epoch"]) or not is_epoch(assertion["nonce"]):
        return False
    if isinstance(at, bool) or not isinstance(at, int | float) or not abs(at) < 1e12:
        return False
    if not isinstance(targets, list) or not 1 <= len(targets) <= TARGETS_MAX:
        return False
    try:
        names = [identifier("target", target) for target in targets]
    except ValidationError:
        return False
    return names == sorted(set(names))


VALID_S = 60.0

CLEARED = "cleared"
NOT_KEPT = "cleared, but not kept on the disk: after a restart it may be locked again"
NOT_LOCKED = "not locked here"
LEFT = "it left its process meanwhile; ask again"
VOID = "its process found the order older than a minute, or ahead of its clock; nothing was cleared"


def clearances() -> Path:
    """Return the directory of the orders of ``resume --local``.

    A user who may write into the state directory, which is its owner's alone, is at the machine. A file there orders
    the clearance of one robot and names the operator; each process looks while one of its robots is locked, takes the
    orders for its robots, and audits the operator. Orders older than a minute are void.
    """
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
    paths = [directory / f"{secrets.token_hex(8)}.json" for _ in names]
    for path, name in zip(paths, names, strict=True):
        write_private(path, json.dumps({**asked, "robot_id": name}).encode())
    return paths


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
            left = path.suffix in (".taken", ".draft", ".said") or path.name.startswith(".")
            if left and time.time() - path.lstat().st_mtime > VALID_S:
                path.unlink()


TAKE_PURPOSE = "take-control"
TAKE_FIELDS = frozenset({"v", "purpose", "robot", "epoch", "t", "nonce", "sig"})
"""Fields of the operator's assertion; ``sig`` is the Ed25519 signature over the canonical JSON of the others."""

TAKE_TEXT_MAX = 1024
"""Longest text of a field, in characters."""


EPOCHS_EACH = 2**28
"""Epochs from one reservation to the next; the first half is where a lease may begin."""


def sign_take(signing_key: Any, robot: str, epoch: int, *, clock: Callable[[], float] = time.time) -> dict[str, Any]:
    """Return the operator's assertion that takes ``robot`` from its holder."""
    body = {
        "v": VERSION,
        "purpose": TAKE_PURPOSE,
        "robot": robot,
        "epoch": epoch,
        "t": clock(),
        "nonce": secrets.token_hex(16),
    }
    return {**body, "sig": ed25519.encode(signing_key.sign(canonical_json(body)))}


def unproven_take(assertion: object, robot: str, keys: Sequence[bytes]) -> str | None:
    """Return why none of ``keys`` has signed that ``robot`` be taken, or None."""
    if not assertion:
        return "it needs the operator's signature (assertion; strands-robots take --key FILE)"
    if not isinstance(assertion, Mapping) or set(assertion) != TAKE_FIELDS:
        return f"assertion must have exactly the fields {', '.join(sorted(TAKE_FIELDS))}"
    misshapen = sorted(name for name, value in assertion.items() if not _is_scalar(value))
    if misshapen or not isinstance(assertion["nonce"], str):
        return f"{', '.join(misshapen) or 'nonce'} of the assertion is none that an operator's machine makes"
    body = {name: value for name, value in assertion.items() if name != "sig"}
    signature = ed25519.decode(assertion["sig"], 64)
    try:
        signed = signature is not None and ed25519.signed_by_one_of(keys, signature, canonical_json(body))
    except ValueError:  # a number that JSON cannot carry
        signed = False
    if not signed:
        return "no configured key made the signature"
    if (body["v"], body["purpose"], body["robot"]) != (VERSION, TAKE_PURPOSE, robot):
        return f"the assertion is for something else than taking control of {robot}"
    return None


def outdated_take(assertion: Mapping[str, Any], epoch: int, now: float) -> str | None:
    """Return why it is not for the lease of ``epoch`` at ``now``, or None.

    Args:
        assertion: one that is not :func:`unproven_take`.
        now: wall-clock seconds.
    """
    named, at = assertion["epoch"], assertion["t"]
    if named != epoch or isinstance(named, bool):
        return f"the assertion names epoch {shown(named)}, and the lease has epoch {epoch}"
    if isinstance(at, bool) or not isinstance(at, int | float) or not -NEWEST_S < now - at < OLDEST_S:
        return "the assertion is not fresh"
    return None


def _is_scalar(value: object) -> bool:
    return isinstance(value, int | float) or (isinstance(value, str) and len(value) <= TAKE_TEXT_MAX)


def reserve_epochs() -> int:
    """Return an epoch above all that were ever reached here, kept on the disk.

    Raises:
        OSError: the state directory cannot be written.
        StateFileError: it, or the file, is not this user's alone.
    """
    root = state_dir()
    path = root / "control-epochs"
    adopt(root)
    make_private(root)
    require_private(root, root)
    with suppress(FileNotFoundError):
        read_private(path, root, longest=0)
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        os.write(descriptor, b".")
        os.fsync(descriptor)
        # Appending is atomic: no other process ends its byte at this place.
        place = os.lseek(descriptor, 0, os.SEEK_CUR)
    finally:
        os.close(descriptor)
    return place * EPOCHS_EACH + secrets.randbelow(EPOCHS_EACH // 2)
