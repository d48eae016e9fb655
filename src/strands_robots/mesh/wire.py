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
from strands_robots.utils import ValidationError, identifier, json_value, peer_id, plain_scalar, plain_value, shown

FRESH_S = 60.0
AHEAD_S = 5.0

OTHER_SESSION = "source_zid and the sample's session disagree"
"""A stop or a resume states the session that it came from."""

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
    except (TypeError, ValueError):
        # A number that is not finite, or a key that is numpy's.
        data = _encode_finite(payload)
    except RecursionError as exc:
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
        value = parsed(data, limit, lambda data: _DECODER.decode(data.decode()))
    except OutOfBoundsError as exc:
        raise WireError(f"cannot be read: {exc}") from None
    except ValueError as exc:
        raise WireError(f"not JSON: {type(exc).__name__}") from None
    if not isinstance(value, dict):
        raise WireError(f"not an object but a {type(value).__name__}")
    return value


def finite(value: object) -> float | None:
    """Return a finite JSON number as a float, or None; a boolean is no number."""
    plain = value if type(value) is float else plain_scalar(value)
    if isinstance(plain, bool) or not isinstance(plain, int | float):
        return None
    try:
        number = float(plain)
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
        return _ENCODER.encode(_scrubbed(payload)).encode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise WireError(f"payload cannot be JSON: {exc}") from None


def _scrubbed(value: Any) -> Any:
    value = plain_value(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {plain_value(key): _scrubbed(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_scrubbed(entry) for entry in value]
    return value


# Made once: a coder with options is otherwise made anew for every message.
_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=json_value)
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

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Request:
        """Parse ``body``; the time may be missing. Raises WireError."""
        try:
            sender, turn = (identifier(name, body.get(name)) for name in ("sender_id", "turn_id"))
        except ValidationError as exc:
            raise WireError(str(exc)) from None
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


def issuer_of(body: Mapping[str, Any]) -> tuple[str, float]:
    """Return the issuer of an e-stop and its time. Raises WireError without one."""
    issuer, at = body.get("peer_id"), finite(body.get("t"))
    if not isinstance(issuer, str) or not issuer.strip() or len(issuer) > 256:
        raise WireError(f"peer_id must name the issuer, not {shown(issuer)}")
    if at is None:
        raise WireError(f"t must be a finite number, not {shown(body.get('t'))}")
    return issuer, at


def relay_of(body: Mapping[str, Any], session: str | None) -> tuple[str, Any]:
    """Return the peer that relays a resume, and its assertion, or raise WireError."""
    if body.get("source_zid") != session:
        raise WireError(OTHER_SESSION)
    _time(body, "t")
    return _identifier(body, "peer_id"), body.get("assertion")


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
