"""Operator's signed resume, made on one machine and checked at each robot.

An assertion is exactly ``v``, ``epoch``, ``targets``, ``t``, ``nonce`` and ``sig``, the Ed25519 signature over the
canonical JSON of the other five. It clears one epoch of the robots it names, once, within a minute. Why one was
refused is for the local audit; the sender learns only that it was.
"""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from strands_robots import settings
from strands_robots.safety import ed25519
from strands_robots.utils import ValidationError, canonical_json, identifier, shown

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

_HEX32 = re.compile(r"[0-9a-f]{32}\Z")


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


def is_epoch(value: object) -> bool:
    """True for 32 lower-case hex digits."""
    return isinstance(value, str) and bool(_HEX32.match(value))


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
