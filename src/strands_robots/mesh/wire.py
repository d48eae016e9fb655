"""Messages of the mesh as typed values, and their JSON.

Decoding never raises anything but :class:`WireError`, whatever the bytes: the receiver drops the message and
audits the reason. Times are wall-clock seconds as the sender states them; they are never used as ages.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from strands_robots.bounded_json import OutOfBoundsError, parsed
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.lockout import is_epoch
from strands_robots.utils import ValidationError, identifier, peer_id, shown

FRESH_S = 60.0
AHEAD_S = 5.0

BROADCAST_TARGET = "<broadcast>\x00"
"""The target of a command to all; the NUL keeps it apart from every peer id."""


class WireError(StrandsRobotsError, ValueError):
    """Bytes that are no message of this wire; the message says why."""


class TooLargeError(WireError):
    """A message above its topic's size."""


def encode(payload: Mapping[str, Any], limit: int) -> bytes:
    """Return UTF-8 JSON; a number that is not finite becomes null.

    Raises:
        TooLargeError: more than ``limit`` bytes.
        WireError: a value that JSON cannot hold.
    """
    try:
        data = _ENCODER.encode(payload).encode()
    except ValueError:
        data = _encode_finite(payload)
    except (TypeError, RecursionError) as exc:
        raise WireError(f"payload cannot be JSON: {exc}") from None
    if len(data) > limit:
        raise TooLargeError(f"a message of {len(data)} bytes is above the topic's {limit}.")
    return data


def decode(data: bytes, limit: int) -> dict[str, Any]:
    """Return the JSON object in ``data``.

    Raises:
        WireError: out of bounds, not UTF-8, not JSON, not an object, or a number that is not finite.
    """
    if len(data) > limit:
        raise TooLargeError(f"a message of {len(data)} bytes is above the topic's {limit}.")
    try:
        value = parsed(data, limit, _parse)
    except OutOfBoundsError as exc:
        raise WireError(f"cannot be read: {exc}") from None
    except ValueError as exc:
        raise WireError(f"not JSON: {type(exc).__name__}") from None
    if not isinstance(value, dict):
        raise WireError(f"not an object but a {type(value).__name__}")
    return value


def finite(value: object) -> float | None:
    """Return a finite JSON number as a float, or None; a boolean is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def fresh(stamp: float, now: float) -> bool:
    """True for a sender's wall-clock time at most 60 s old and 5 s ahead."""
    return -AHEAD_S <= now - stamp <= FRESH_S


def _refuse_constant(name: str) -> float:
    raise WireError(f"{name} is no JSON number")


def _encode_finite(payload: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(_scrubbed(payload), allow_nan=False, separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise WireError(f"payload cannot be JSON: {exc}") from None


def _scrubbed(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _scrubbed(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_scrubbed(entry) for entry in value]
    return value


def _parse(data: bytes) -> Any:
    return _DECODER.decode(data.decode())


# Made once: a coder with options is otherwise made anew for every message.
_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"))
_DECODER = json.JSONDecoder(parse_constant=_refuse_constant)


@dataclass(frozen=True, slots=True)
class Presence:
    """A heartbeat; ``body`` is the message as received, signature included."""

    robot_id: str
    robot_type: str
    hostname: str
    timestamp: float
    body: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Presence:
        """Parse ``body``; type and host are cut to 256 characters. Raises WireError."""
        return cls(
            _peer(body, "robot_id"),
            _label(body.get("robot_type"), "robot"),
            _label(body.get("hostname"), ""),
            _time(body, "timestamp"),
            body,
        )

    def facts(self) -> dict[str, Any]:
        """The fields of a registry's row besides id, type and host."""
        known = {"robot_id", "robot_type", "hostname", "sig"}
        return {key: value for key, value in self.body.items() if key not in known}


@dataclass(slots=True)  # not frozen: that would cost each message a microsecond
class Request:
    """A command to one peer or to all; ``command`` is not validated yet."""

    sender_id: str
    turn_id: str
    command: Any
    timestamp: float | None
    body: Mapping[str, Any] = field(default_factory=dict)
    target_id: str = ""

    def to_wire(self) -> dict[str, Any]:
        return {
            "sender_id": self.sender_id,
            "turn_id": self.turn_id,
            "command": self.command,
            "timestamp": self.timestamp,
            "target_id": self.target_id,
        }

    def is_for(self, peer_id: str) -> bool:
        """True where the stated target is the peer, or all of them."""
        return self.body.get("target_id") in (peer_id, BROADCAST_TARGET)

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Request:
        """Parse ``body``; the time may be missing. Raises WireError."""
        sender, turn = _identifier(body, "sender_id"), _identifier(body, "turn_id")
        return cls(sender, turn, body.get("command"), finite(body.get("timestamp")), body)


@dataclass(slots=True)  # not frozen: that would cost each message a microsecond
class Reply:
    """An answer in a turn: ``result`` of a response, ``error`` of an error.

    ``refusal`` is the envelope of an error, for callers that read more than its words.
    """

    type: Literal["response", "error"]
    responder_id: str
    turn_id: str
    result: Any = None
    error: str = ""
    timestamp: float = 0.0
    body: Mapping[str, Any] = field(default_factory=dict)
    refusal: Mapping[str, Any] | None = None

    def to_wire(self) -> dict[str, Any]:
        answer: dict[str, Any] = {"error": self.error} if self.type == "error" else {"result": self.result}
        if self.refusal is not None:
            answer["refusal"] = self.refusal
        head = {"type": self.type, "responder_id": self.responder_id, "turn_id": self.turn_id}
        return {**head, **answer, "timestamp": self.timestamp}

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Reply:
        """Parse ``body``. Raises WireError for another ``type`` or a bad id."""
        kind = body.get("type")
        if kind not in ("response", "error"):
            raise WireError(f"type must be response or error, not {shown(kind)}")
        responder, turn = _identifier(body, "responder_id"), _identifier(body, "turn_id")
        error = body.get("error")
        text, stamp = error if isinstance(error, str) else "", finite(body.get("timestamp")) or 0.0
        return cls(kind, responder, turn, body.get("result"), text, stamp, body)


@dataclass(frozen=True, slots=True)
class EstopNotice:
    """A fleet e-stop. ``source_zid`` is None where the transport names no sessions."""

    peer_id: str
    t: float
    estop_id: str | None
    source_zid: str | None
    counts: Mapping[str, Any] = field(default_factory=dict)

    def to_wire(self) -> dict[str, Any]:
        body = {"peer_id": self.peer_id, "t": self.t, "estop_id": self.estop_id, **self.counts}
        return body | ({"source_zid": self.source_zid} if self.source_zid is not None else {})

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> EstopNotice:
        """Parse ``body``. Raises WireError for an empty issuer or a bad time."""
        issuer = body.get("peer_id")
        if not isinstance(issuer, str) or not issuer.strip() or len(issuer) > 256:
            raise WireError(f"peer_id must name the issuer, not {shown(issuer)}")
        zid, epoch = body.get("source_zid"), body.get("estop_id")
        return cls(
            issuer,
            _time(body, "t"),
            epoch if is_epoch(epoch) else None,
            zid if isinstance(zid, str) else None,
        )


@dataclass(frozen=True, slots=True)
class ResumeRelay:
    """A signed resume on its way to the fleet."""

    peer_id: str
    t: float
    assertion: Any
    source_zid: str | None

    def to_wire(self) -> dict[str, Any]:
        body = {"peer_id": self.peer_id, "t": self.t, "assertion": self.assertion}
        return body | ({"source_zid": self.source_zid} if self.source_zid is not None else {})

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> ResumeRelay:
        """Parse ``body``. Raises WireError for a bad peer id or a bad time."""
        zid = body.get("source_zid")
        return cls(
            _identifier(body, "peer_id"),
            _time(body, "t"),
            body.get("assertion"),
            zid if isinstance(zid, str) else None,
        )


def _peer(body: Mapping[str, Any], name: str) -> str:
    try:
        return peer_id(name, body.get(name))
    except ValidationError as exc:
        raise WireError(str(exc)) from None


def _identifier(body: Mapping[str, Any], name: str) -> str:
    try:
        return identifier(name, body.get(name))
    except ValidationError as exc:
        raise WireError(str(exc)) from None


def _time(body: Mapping[str, Any], name: str) -> float:
    value = finite(body.get(name))
    if value is None:
        raise WireError(f"{name} must be a finite number, not {shown(body.get(name))}")
    return value


def _label(value: object, default: str) -> str:
    return value[:256] if isinstance(value, str) else default
