"""Emergency stops as values: order, rules, and each robot's report.

The e-stop listener, the runtime's handler, the mesh and the command line share them with the plane.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from strands_robots import settings
from strands_robots.bounded_json import SMALL_BYTES, parsed
from strands_robots.safety import ed25519
from strands_robots.safety.authorization import caller_name, entries, estop_refusal, matcher
from strands_robots.safety.lockout import OVERFLOW, is_epoch
from strands_robots.safety.persistence import ORIGINAL_MAX_BYTES
from strands_robots.safety.scope import EVERY_ROBOT, SCOPE, SCOPE_SIGNATURE, Scope
from strands_robots.safety.statements import Purpose, covered
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError

LATE_S = 1.0
"""Time from the press to its receipt, above which a stop is late."""

UNTIMED_LATE_S = 60.0
"""Age above which a stop is late where clocks were not compared or its press is not stated."""

AHEAD_S = 5.0

PARSED_MAX_BYTES = SMALL_BYTES
"""A message longer than this is not read; from a source that may stop, it stops all the same."""

UNREAD_AGAIN_S = 0.25
"""Seconds in which stops of one source that are too long to be read count as one."""

UNREAD_SOURCES_MAX = 64

REASON_MAX = 200
NO_REASON = "fleet e-stop"
"""Reason of a stop on the mesh that states none."""

COMES_UP_LOCKED = "it comes up locked"
"""Reason of the halt of a robot that is locked by a stop of before."""

ANSWERED = "answered"
"""Field of a repeated stop: the devices that its issuer asks for no further answer."""

ANSWERED_MAX_BYTES = 8 * 2**10
"""Encoded length of :data:`ANSWERED`; a name that exceeds it is left out, and answers again."""

LISTENER = "lane"
"""``path`` of a stop that the e-stop listener received."""

MISSED = "missed"
"""``path`` of a stop that another process answered with, see :mod:`.missed_stops`."""

REQUIRE_SIGNED = "STRANDS_ESTOP_REQUIRE_SIGNED"
ALLOW = "DEVICE_CONNECT_ESTOP_ALLOW"


def new_epoch() -> str:
    """A fresh id for an emergency stop: 32 hex digits."""
    return secrets.token_hex(16)


def derived_epoch(source: str, distinct: bytes) -> str:
    """Return the epoch of a stop without an id: 32 hex of a SHA-256."""
    return hashlib.sha256(source.encode("utf-8", "replace") + b"\0" + distinct).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class StopOrder:
    """One emergency stop, decided to count.

    Attributes:
        epoch: 32 hex digits; the same on every path by which this stop arrives.
        source: who stops, as declared.
        path: lane (the e-stop listener), runtime, mesh, local or check-in.
        remote: it came over a network, not from a program or a device of this process.
        issued: the issuer's wall-clock seconds at this sending, or None; decides only what the audit says.
        received: this process's monotonic seconds at receipt; latencies count from here.
        pressed: the issuer's wall-clock seconds at the press, the same in every repetition, or None.
        received_at: this process's wall-clock seconds at receipt.
        clock_ahead_s: seconds by which this process's clock is ahead of the issuer's, or None where not measured.
        answered: devices whose answer the issuer has; one that stopped does not repeat it.
        original: the message, where it can be passed on: it states its id, and is not too long.
        network: where it was received.
        age_s: seconds since the first process received it; not 0 for a missed stop only.
        scope: the robots that it is for.
    """

    epoch: str
    source: str
    reason: str = ""
    path: str = "local"
    remote: bool = False
    issued: float | None = None
    received: float = field(default_factory=time.monotonic)
    pressed: float | None = None
    received_at: float = field(default_factory=time.time, compare=False)
    clock_ahead_s: float | None = None
    answered: frozenset[str] = field(default=frozenset(), compare=False)
    scope: Scope = EVERY_ROBOT
    original: bytes | None = field(default=None, compare=False, repr=False)
    network: str = field(default="", compare=False)
    age_s: float = 0.0

    def delay_s(self, now: float) -> float | None:
        """Return the seconds from the press to wall-clock ``now``; None if not stated.

        The time until the sending is exact, for one clock measured it. The time on the network counts where the two
        clocks were compared.
        """
        if self.issued is None or self.pressed is None:
            return None
        on_network = 0.0 if self.clock_ahead_s is None else now - self.clock_ahead_s - self.issued
        return round(max(0.0, self.issued - self.pressed) + max(0.0, on_network), 3)

    def timing(self, now: float) -> str:
        """Return ``on time``, ``late``, ``ahead`` or ``untimed`` at wall-clock ``now``."""
        if self.issued is None:
            return "untimed"
        delay = self.delay_s(now)
        if delay is not None and delay > LATE_S:
            return "late"
        if self.clock_ahead_s is not None and delay is not None:
            return "on time"
        if now - self.issued > UNTIMED_LATE_S:
            return "late"
        return "ahead" if self.issued - now > AHEAD_S else "on time"


@dataclass(frozen=True, slots=True)
class RobotReport:
    """Answer of one robot to one emergency stop.

    ``elapsed_ms`` is from receipt to the halt's answer. ``persisted`` is None for a robot whose lockout is not
    kept. ``repeated``: this stop was known already; ``late``: reported again, because the halt answered, or the
    lockout was kept, after that was reported missing.
    """

    robot_id: str
    epoch: str
    verdict: StopVerdict
    epochs: tuple[str, ...]
    elapsed_ms: float
    persisted: bool | None = None
    repeated: bool = False
    late: bool = False
    sent_at: float | None = None
    received_at: float | None = None
    scope: Scope = EVERY_ROBOT

    @property
    def stopped(self) -> bool | None:
        """True, False, or None where it is unknown."""
        return self.verdict.stopped

    @property
    def names_its_epoch(self) -> bool:
        """False for a stop of a robot that is locked by more than it tells apart."""
        return self.epoch in self.epochs or OVERFLOW not in self.epochs

    def fields(self) -> dict[str, Any]:
        """The ``emergencyStopVerdict`` of this report, as it goes on the wire."""
        return {
            "estop_id": self.epoch,
            "device_id": self.robot_id,
            "stopped": self.stopped,
            "halted": list(self.verdict.halted),
            "not_stopped": dict(self.verdict.not_stopped),
            "unknown": dict(self.verdict.unknown),
            "elapsed_ms": round(self.elapsed_ms, 3),
            "epochs": list(self.epochs),
            "persisted": self.persisted,
            "repeated": self.repeated,
            "late": self.late,
            **({"settling": True} if self.verdict.settling else {}),
            **self.scope.field(),
        }


def epoch_of(source: str, params: Mapping[str, Any], raw: bytes) -> str:
    """Return the epoch of an ``emergencyStop``: ``estop_id``, else a derived one.

    Without either it is derived from ``raw``, the bytes that arrived: a stop is never dropped for its shape.
    """
    return stated_epoch(source, params) or derived_epoch(source, raw)


def stated_epoch(source: str, params: Mapping[str, Any]) -> str:
    """Return ``estop_id``, or the epoch derived from ``event_id``; empty without."""
    estop_id, event_id = params.get("estop_id"), params.get("event_id")
    if is_epoch(estop_id):
        return str(estop_id)
    if isinstance(event_id, str) and event_id:
        return derived_epoch(source, event_id.encode("utf-8", "replace"))
    return ""


def stated_reason(params: Mapping[str, Any]) -> str:
    """Return the reason that a stop states, cut to its length; empty for none."""
    reason = params.get("reason")
    return reason[:REASON_MAX] if isinstance(reason, str) and reason.isprintable() else ""


@dataclass(frozen=True, slots=True)
class StopRefused:
    """Message of ``source`` that does not count, with the reason."""

    source: str
    why: str


def signed_bytes(purpose: Purpose, source: str, params: Mapping[str, Any]) -> bytes:
    """Return the signed bytes of a stop or check-in.

    They hold purpose, source, id, both times, nonce and reason; a field that is absent or of another kind as null.
    """
    reason, pressed = params.get("reason"), params.get("pressed_at")
    stated = {
        "estop_id": params.get("estop_id"),
        "nonce": params.get("nonce"),
        "t": params.get("t"),
        "pressed_at": None if seconds_of(pressed) is None else pressed,
        "reason": reason if isinstance(reason, str) and len(reason) <= REASON_MAX else None,
    }
    return covered(purpose, source, stated)


def scope_bytes(source: str, params: Mapping[str, Any]) -> bytes:
    """Return the signed bytes of a stop's scope.

    They hold its own purpose, the source, id, both times and nonce of the stop, and the scope: those of one message.
    """
    pressed = params.get("pressed_at")
    stated = {name: params.get(name) for name in ("estop_id", "nonce", "t", SCOPE)}
    return covered(
        Purpose.STOP_SCOPE, source, {**stated, "pressed_at": None if seconds_of(pressed) is None else pressed}
    )


def signed_stop(key: Any, purpose: Purpose, source: str, params: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stop or check-in with its signature and that of its scope."""
    sig = ed25519.encode(key.sign(signed_bytes(purpose, source, params)))
    scoped = {SCOPE_SIGNATURE: ed25519.encode(key.sign(scope_bytes(source, params)))} if SCOPE in params else {}
    return {**params, "sig": sig, **scoped}


def estop_keys() -> tuple[bytes, ...]:
    """The public keys of ``DEVICE_CONNECT_ESTOP_PUBLIC_KEYS``."""
    name = "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS"
    return ed25519.public_keys(settings.items(name), name)


class StopRules:
    """Rules by which an emergency stop counts: its source and its signature.

    Nothing else refuses a stop: not its age, not its shape, not its size. The settings are read when this is made, so
    that a flood meets no environment and no parsing. Each robot asks for itself if it has seen a stop before.

    Args:
        allow: sources that may stop, as globs; ``DEVICE_CONNECT_ESTOP_ALLOW`` by default.
        keys: public keys of which one must have signed; empty: none is required. A configured list without one
            usable key is empty too, and in the log: a mistyped key must not make a fleet unstoppable.

    Attributes:
        required: the operator chose that unsigned stops do not count on any network.
    """

    def __init__(
        self,
        allow: Sequence[str] | None = None,
        keys: Sequence[bytes] | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._allow = entries(settings.items(ALLOW) if allow is None else allow)
        self._fits = matcher(self._allow)
        self._keys = tuple(estop_keys() if keys is None else keys)
        self._clock = clock
        self._clocks = ObservedClocks()
        self._unread: dict[str, tuple[float, str]] = {}
        self.required = settings.boolean(REQUIRE_SIGNED)

    def require_keys(self) -> None:
        """Refuse to start where only signed stops count and no key could have signed one.

        Raises:
            ValidationError: naming both settings.
        """
        if self.required and not self._keys:
            raise ValidationError(
                f"{REQUIRE_SIGNED} is true and DEVICE_CONNECT_ESTOP_PUBLIC_KEYS holds no usable key: no emergency stop "
                "would count. Make a key with: strands-robots keys estop FILE"
            )

    @property
    def open(self) -> bool:
        """True when the name of a source is not checked, only a signature."""
        return not self._allow

    @property
    def signed(self) -> bool:
        """True when a stop needs a signature; else its source is what it says it is."""
        return bool(self._keys)

    @property
    def keys(self) -> tuple[bytes, ...]:
        """The public keys of which one must have signed."""
        return self._keys

    def source_refusal(self, source: str) -> str | None:
        """Return the reason why this source may not stop, or None; costs next to nothing."""
        if caller_name(source) is not None and (not self._allow or self._fits(source) is not None):
            return None
        return estop_refusal(source, self._allow)

    def order(
        self,
        source: str,
        params: Mapping[str, Any],
        path: str,
        raw: bytes | int | None = None,
        received: float | None = None,
        *,
        network: str = "",
        age_s: float = 0.0,
    ) -> StopOrder | StopRefused:
        """Decide on the parameters of an ``emergencyStop``.

        ``raw`` are the bytes that they were read from, or their number where there are too many to be read. A message
        without an id, read or not, has a fresh epoch, and its repetitions within UNREAD_AGAIN_S have the same.
        """
        why = self.source_refusal(source)
        if why is None and self._keys:
            why = self.signature_refusal(source, params, Purpose.EMERGENCY_STOP)
        if why is not None:
            return StopRefused(source, why)
        received = time.monotonic() if received is None else received
        if isinstance(raw, int):
            epoch, why = self._unread_epoch(source, received), f"an emergency stop of {raw} bytes, which was not read"
            return StopOrder(epoch, source, why, path, remote=True, received=received)
        received_at, issued = self._clock() - (time.monotonic() - received), seconds_of(params.get("t"))
        compared = issued is not None and path != MISSED
        ahead = self._clocks.note(source, received_at - issued, received) if compared and issued is not None else None
        epoch = stated_epoch(source, params)
        passed_on = raw is not None and len(raw) <= ORIGINAL_MAX_BYTES and epoch != ""
        return StopOrder(
            # The bytes of a stop without an id of its own may be those of every press.
            epoch or self._unread_epoch(source, received),
            source,
            stated_reason(params),
            path,
            remote=True,
            issued=issued,
            received=received,
            pressed=seconds_of(params.get("pressed_at")),
            received_at=received_at,
            clock_ahead_s=ahead,
            answered=_names(params[ANSWERED]) if ANSWERED in params else frozenset(),
            scope=self.scope(source, params) if SCOPE in params else EVERY_ROBOT,
            original=raw if passed_on else None,
            network=network,
            age_s=age_s,
        )

    def _unread_epoch(self, source: str, received: float) -> str:
        """Return the epoch of a stop without an id, the same for repetitions."""
        since, epoch = self._unread.get(source, (float("-inf"), ""))
        if received - since >= UNREAD_AGAIN_S:
            since, epoch = received, new_epoch()
            self._unread.pop(source, None)
            self._unread[source] = since, epoch
            while len(self._unread) > UNREAD_SOURCES_MAX:
                del self._unread[next(iter(self._unread))]
        return epoch

    def signature_refusal(self, source: str, params: Mapping[str, Any], purpose: Purpose) -> str | None:
        """Return the reason why the signature is not valid, or None; None without keys."""
        if not self._keys:
            return None
        signature = ed25519.decode(params.get("sig"), 64)
        shaped = is_epoch(params.get("estop_id")) and is_epoch(params.get("nonce"))
        if signature is None or not shaped or seconds_of(params.get("t")) is None:
            return "it is not signed, and DEVICE_CONNECT_ESTOP_PUBLIC_KEYS asks for a signature"
        if not ed25519.signed_by_one_of(self._keys, signature, signed_bytes(purpose, source, params)):
            return f"none of DEVICE_CONNECT_ESTOP_PUBLIC_KEYS signed it as {purpose.value}"
        return None

    def scope(self, source: str, params: Mapping[str, Any], *, demanded: bool = True) -> Scope:
        """Return the scope of a stop that counts; every robot where it is unfit.

        Args:
            demanded: False where unsigned stops count in spite of keys; a signature that is there has to be valid all
                the same.
        """
        scope = Scope.read(params.get(SCOPE))
        if scope.everything or not self._keys or not (demanded or SCOPE_SIGNATURE in params):
            return scope
        signature = ed25519.decode(params.get(SCOPE_SIGNATURE), 64)
        shaped = is_epoch(params.get("estop_id")) and is_epoch(params.get("nonce"))
        if signature is None or not shaped or seconds_of(params.get("t")) is None:
            return EVERY_ROBOT
        proven = ed25519.signed_by_one_of(self._keys, signature, scope_bytes(source, params))
        return scope if proven else EVERY_ROBOT

    def compare_clock(self, source: str, params: Mapping[str, Any], received: float) -> None:
        """Take the time of a check-in that counts as a comparison of clocks."""
        sent = seconds_of(params.get("t"))
        if sent is not None:
            self._clocks.note(source, self._clock() - (time.monotonic() - received) - sent, received)


def params_of(payload: bytes | int | None) -> dict[str, Any]:
    """Return the parameters of a JSON-RPC notification; empty for anything else.

    Args:
        payload: the message, or its number of bytes where there are too many to be read; None for none.
    """
    try:
        message = parsed(payload, PARSED_MAX_BYTES) if isinstance(payload, bytes) else None
    except ValueError:
        return {}
    params = message.get("params") if isinstance(message, dict) else None
    return params if isinstance(params, dict) else {}


def answered_field(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the field that names who has answered; empty where there is nobody.

    Args:
        names: the ones that matter most come first.
    """
    named, length = [], len("[]")
    for name in names:
        # Encoded: a letter outside ASCII takes six bytes or twelve.
        more = len(json.dumps(name)) + len(", ")
        if length + more <= ANSWERED_MAX_BYTES:
            length += more
            named.append(name)
    return {ANSWERED: named} if named else {}


SOURCES_MAX = 64
KEPT_S = 600.0
"""A comparison older than this gives way to a newer one: clocks drift, and are set."""


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One question and its answer, by which NTP compares clocks.

    All times are wall-clock seconds (RFC 5905, section 8).

    Attributes:
        sent: of the question, by this clock.
        received_there: of the question, by the other clock.
        answered_there: of the answer's sending, by the other clock.
        received: of the answer, by this clock.
    """

    sent: float
    received_there: float
    answered_there: float
    received: float

    @property
    def ahead_s(self) -> float:
        """Lead of the other clock in s, exact to half of :attr:`on_network_s`."""
        return ((self.received_there - self.sent) + (self.answered_there - self.received)) / 2

    @property
    def on_network_s(self) -> float:
        """Seconds that question and answer were on the network."""
        return (self.received - self.sent) - (self.answered_there - self.received_there)


class ObservedClocks:
    """Lead of this clock over each sender's, from its messages alone.

    The message that took least time on the network shows the difference best, so the smallest one counts. It includes
    the least time that a message takes, milliseconds on a network of machines.
    """

    def __init__(self) -> None:
        self._smallest: dict[str, tuple[float, float]] = {}

    def note(self, source: str, difference_s: float, now: float) -> float | None:
        """Record one message; return what the messages before it showed, or None.

        Args:
            source: the sender, whose name was checked.
            difference_s: this clock at its receipt less the sender's at its sending.
            now: monotonic seconds.
        """
        known = self._smallest.get(source)
        if known is None or difference_s < known[0] or now - known[1] > KEPT_S:
            self._smallest[source] = (difference_s, now)
            while len(self._smallest) > SOURCES_MAX:
                self._smallest.pop(next(iter(self._smallest)), None)
        return None if known is None else known[0]


def seconds_of(t: object) -> float | None:
    """Return a time of a message: a finite number that a float holds, else None."""
    if isinstance(t, bool) or not isinstance(t, int | float) or not abs(t) < 1e18:
        return None
    return float(t)


def _names(value: object) -> frozenset[str]:
    return frozenset(each for each in value if isinstance(each, str)) if isinstance(value, list) else frozenset()
