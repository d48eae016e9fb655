"""Check-in: a robot stops when its last safety controller falls silent.

Both networks carry it: Device Connect as the event ``safetyCheckIn`` of the controller, the mesh on
``strands/P/checkin``. Off while the timeout is 0.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.audit import audit_head, log_witness, own_log_id
from strands_robots.audit.verification import witnessed
from strands_robots.rate_limits import EventBudget
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.orders import StopRules
from strands_robots.safety.statements import Purpose, signed

CONTROLLERS_MAX = 64
SOURCES_MAX = 256
AGE_S = 60.0
"""Largest difference in seconds between a signed check-in's clock and ours."""


class CheckInRules:
    """Rules by which a check-in counts: those of a stop, and each signed one once.

    Args:
        stops: by which the controller's stops count.
        clock: wall-clock seconds.
    """

    def __init__(self, stops: StopRules, clock: Callable[[], float] = time.time) -> None:
        self._stops = stops
        self._clock = clock
        self._latest: dict[str, float] = {}

    def refusal(self, source: str, params: Mapping[str, Any]) -> str | None:
        """Return the reason why this check-in does not count, or None."""
        why = self._stops.source_refusal(source) or self._stops.signature_refusal(source, params, Purpose.CHECK_IN)
        t = params.get("t")
        if why is None and self._stops.signed and isinstance(t, int | float):
            # A recorded check-in played again must not keep a robot moving.
            if t <= self._latest.get(source, 0.0) or abs(self._clock() - t) > AGE_S:
                return "it was checked in before, or its clock is a minute off"
            if len(self._latest) < SOURCES_MAX or source in self._latest:
                self._latest[source] = t
        return why


class CheckIn:
    """The last check-in of each controller, and the time that is left.

    Pure: times come in (monotonic seconds), decisions go out.

    The clock runs from the start: a robot that needs a controller and never receives a check-in stops too. After it has
    lapsed once it is at rest until a controller checks in or the robots are free again.
    """

    def __init__(self, timeout_s: float, now: float | None = None) -> None:
        self.timeout_s = timeout_s
        self._last: dict[str, float] = {}
        self._since = time.monotonic() if now is None else now
        self._lapsed = False

    @property
    def on(self) -> bool:
        """True when a live controller is needed."""
        return self.timeout_s > 0

    def record(self, controller: str, now: float) -> None:
        """Record a check-in of ``controller``."""
        if controller not in self._last and len(self._last) >= CONTROLLERS_MAX:
            del self._last[min(self._last, key=self._last.__getitem__)]
        self._last[controller] = now
        self._lapsed = False

    def rearm(self, now: float) -> None:
        """Restart the timeout when the robots are free; forget silent controllers."""
        self._last = {name: at for name, at in self._last.items() if now - at <= self.timeout_s}
        self._since = now
        self._lapsed = False

    def time_left(self, now: float) -> float | None:
        """Return the seconds until the robots stop; None while off, 0 once lapsed."""
        if not self.on:
            return None
        latest = max([self._since, *self._last.values()])
        return 0.0 if self._lapsed else max(0.0, self.timeout_s - (now - latest))

    def lapsed(self, now: float) -> tuple[str, ...] | None:
        """Return, once, the silent controllers after the timeout; else None."""
        if not self.on or self._lapsed or (self.time_left(now) or 0.0) > 0.0:
            return None
        self._lapsed = True
        return tuple(sorted(self._last))

    def fields(self, now: float) -> dict[str, object]:
        """Return the fields of ``getStatus``: timeout, seconds left, check-in ages."""
        left = self.time_left(now)
        return {
            "required": self.on,
            "timeout_s": self.timeout_s,
            "time_left_s": None if left is None else round(left, 3),
            "controllers": {name: round(now - at, 3) for name, at in self._last.items()},
        }


ANSWER_EVERY_S = 10.0
"""Seconds between two answers of one process: its robots share one audit."""

WRITE_EVERY_S = 60.0
WITNESSES = 3
KNOWN_S = 300.0
"""Seconds after which an audit that is in no answer any more takes no part in the choice."""

LOGS_MAX = 256
HEADS_PER_S = 20
"""Answers to check-ins that are read in a second; robots send them, and a flood of them costs no more."""

CLAIMS_PER_MIN = 32
"""Unproven heads that are written in a minute, so that a flood of invented ones does not fill the audit."""


class HeadWitness:
    """Choice of other machines' audits whose heads are written down. Thread-safe.

    A robot answers a controller's check-in with the head of its machine's audit. The controllers write it into their
    own audit, and so do the robots of three machines, chosen by a hash, at most once a minute for each audit. All of
    them choose alike, because each knows the audits from the answers.

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
        self._claims = EventBudget(CLAIMS_PER_MIN, window_s=WRITE_EVERY_S)

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
            if now - at < WRITE_EVERY_S or last == head.last or not (proven or self._claims.take("", now)):
                return False
            self._written = {log: each for log, each in self._written.items() if log in self._known}
            self._written[head.log] = (now, head.last)
        self._write(by, robot_id, answer["audit"], signed=proven)
        return True


def chosen(log: str, audits: set[str]) -> list[str]:
    """Return the audits whose machines witness ``log``: three others, by a hash."""
    others = audits - {log}
    return sorted(others, key=lambda each: hashlib.sha256(f"{log}:{each}".encode()).digest())[:WITNESSES]


class CheckInAnswers:
    """Answers to check-ins with the head of this machine's audit. Thread-safe."""

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
