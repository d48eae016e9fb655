"""Answers to check-ins, and the audits whose heads they carry.

A robot answers a controller's check-in with the head of its machine's audit. The controllers write it into their own
audit, and so do the robots of three machines, chosen by a hash, at most once a minute for each audit. All of them
choose alike, because each knows the audits from the answers.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.audit import audit_head, log_witness, own_log_id
from strands_robots.audit.witness import witnessed
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.statements import Purpose, signed

ANSWER_EVERY_S = 10.0
"""Seconds between two answers of one process: its robots share one audit."""

WRITE_EVERY_S = 60.0
WITNESSES = 3
KNOWN_S = 300.0
"""Seconds after which an audit that is in no answer any more takes no part in the choice."""

LOGS_MAX = 256
CLAIMS_PER_MIN = 32
"""Unproven heads that are written in a minute, so that a flood of invented ones does not fill the audit."""


class HeadWitness:
    """Choice of other machines' audits whose heads are written down. Thread-safe.

    Args:
        always: write those of all audits, as a controller does, not only where this machine is chosen.
        own: gives the name of this machine's audit.
        write: records a head.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        *,
        always: bool = False,
        own: Callable[[], str] = own_log_id,
        write: Callable[..., None] = log_witness,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._always = always
        self._own = own
        self._write = write
        self._clock = clock
        self._lock = threading.Lock()
        self._known: dict[str, float] = {}
        self._written: dict[str, tuple[float, str]] = {}
        self._claims = (float("-inf"), 0)

    def receive(self, robot_id: str, answer: Mapping[str, Any], *, by: str, proven: bool = False) -> bool:
        """Take an answer to a check-in; True when its head was written down.

        Args:
            by: the controller or robot that writes it.
            proven: it is signed by the robot's enrolled key.
        """
        head, own, now = witnessed(answer.get("audit")), self._own(), self._clock()
        if head is None or head.log == own:
            return False
        with self._lock:
            self._known = {log: at for log, at in self._known.items() if now - at < KNOWN_S}
            if head.log not in self._known and len(self._known) >= LOGS_MAX and not proven:
                return False
            self._known[head.log] = now
            if not self._always and own not in chosen(head.log, {*self._known, own}):
                return False
            at, last = self._written.get(head.log, (float("-inf"), ""))
            if now - at < WRITE_EVERY_S or last == head.last or not (proven or self._claim_allowed(now)):
                return False
            self._written = {log: each for log, each in self._written.items() if log in self._known}
            self._written[head.log] = (now, head.last)
        self._write(by, robot_id, answer["audit"], signed=proven)
        return True

    def _claim_allowed(self, now: float) -> bool:
        since, count = self._claims
        since, count = (now, 0) if now - since >= WRITE_EVERY_S else (since, count)
        self._claims = (since, count + 1)
        return count < CLAIMS_PER_MIN


def chosen(log: str, audits: set[str]) -> list[str]:
    """Return the audits whose machines witness ``log``: three others, by a hash."""
    others = audits - {log}
    return sorted(others, key=lambda each: hashlib.sha256(f"{log}:{each}".encode()).digest())[:WITNESSES]


class CheckInAnswers:
    """Answers to check-ins, one in ten seconds. Thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._next = float("-inf")

    def answer(self, robot_id: str, check_in: object, identity: SigningIdentity | None) -> dict[str, Any] | None:
        """Return the answer of a robot, or None when it is not due.

        Args:
            check_in: id of the check-in that is answered.
            identity: signs the answer; without one it is not signed.
        """
        head = audit_head()
        with self._lock:
            now = self._clock()
            if head is None or now < self._next:
                return None
            self._next = now + ANSWER_EVERY_S
        stated = check_in if isinstance(check_in, str) else ""
        fields = {"device_id": robot_id, "estop_id": stated[:64], "audit": head}
        return signed(identity, Purpose.CHECK_IN_ANSWER, robot_id, fields)
