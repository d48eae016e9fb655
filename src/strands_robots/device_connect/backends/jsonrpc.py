"""JSON-RPC 2.0 on a device's command topic: check a message, encode its answer.

Codes are those of the JSON-RPC 2.0 specification, section 5.1; -32000 to -32099 are free for servers.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass, field
from typing import Any, NoReturn

from ...bounded_json import MESSAGE_MAX, SMALL_BYTES, OutOfBoundsError, json_object, parsed
from ...utils import shown

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
FUNCTION_FAILED = -32000
BUSY = -32001

MAX_COMMAND_BYTES = MESSAGE_MAX
"""Largest command that is read, in bytes."""

STOPS = ("stop", "stopMotion", "stopAll")
"""Methods that no other part of their message refuses."""

# The framework hands params to ``invoke(function_name, **params)``; these would collide with its own arguments.
_TAKEN = ("self", "function_name")

# The W3C trace headers, which the tracer behind the framework reads as text without asking.
_TRACE = ("traceparent", "tracestate", "baggage", "source_device")

RpcId = str | int | float | None

# A tuple: a union of types is made anew each time that it is read in a function.
_SCALARS = (str, int, float)


@dataclass(slots=True)
class RpcRequest:
    """A well-formed command, parsed; ``data`` is the message it came as."""

    method: str
    id: RpcId
    params: dict[str, Any] = field(default_factory=dict)
    data: bytes = field(default=b"", compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Refusal:
    """The JSON-RPC error that a message is owed which is no command, and the reason."""

    code: int
    reason: str
    id: RpcId = None

    def encoded(self) -> bytes:
        """The JSON-RPC error reply."""
        return error(self.id, self.code, self.reason)


def error(rpc_id: RpcId, code: int, reason: str) -> bytes:
    """Encode a JSON-RPC error reply."""
    return json.dumps({"jsonrpc": "2.0", "id": rpc_id, "error": {"code": code, "message": reason}}).encode()


def result(rpc_id: RpcId, value: object) -> bytes:
    """Encode a JSON-RPC result; NaN and Infinity become an error.

    Raises:
        TypeError, ValueError: the value has no JSON at all.
    """
    reply = json.dumps({"jsonrpc": "2.0", "id": rpc_id, "result": value}).encode()
    return sendable(reply) if b"NaN" in reply or b"Infinity" in reply else reply


def sendable(reply: bytes, size_max: int | None = None) -> bytes:
    """Return ``reply``, or an error where it is too large or holds NaN or Infinity."""
    if size_max is not None and len(reply) > size_max:
        reason = f"the result has {len(reply)} bytes and the NATS server takes at most {size_max}"
        return error(_id_of(reply), INTERNAL_ERROR, reason)
    if not valid_json(reply):
        return error(_id_of(reply), INTERNAL_ERROR, "the result holds NaN or Infinity, which JSON cannot carry")
    return reply


def check(data: bytes) -> RpcRequest | Refusal:
    """Parse ``data``: a command, or the refusal it is owed. Never raises."""
    if len(data) > MAX_COMMAND_BYTES:
        return too_large(len(data))
    try:
        request = parsed(data, MAX_COMMAND_BYTES, _parse)
    except OutOfBoundsError as problem:
        return Refusal(INVALID_REQUEST, f"a command cannot be read: {problem}")
    except ValueError as problem:
        return Refusal(PARSE_ERROR, f"no JSON: {str(problem)[:120]}")
    if not isinstance(request, dict):
        return Refusal(INVALID_REQUEST, f"a command is a JSON object, not {_kind(request)}")
    return _check_request(request, data)


def too_large(size: int) -> Refusal:
    """The refusal for a command of ``size`` bytes, which was not parsed."""
    return Refusal(INVALID_REQUEST, f"a command has at most {MAX_COMMAND_BYTES} bytes, not {size}")


def valid_json(data: bytes) -> bool:
    """Return False when ``data`` holds NaN or Infinity, which JSON forbids."""
    if b"NaN" not in data and b"Infinity" not in data:
        return True
    try:
        _DECODER.decode(data.decode())
    except (ValueError, RecursionError):
        return False
    return True


def _id_of(data: bytes) -> RpcId:
    """The id of an encoded reply, as far as it is readable."""
    # It stands before the result, and no result of any size is parsed for it.
    at = data.find(_ID, 0, SMALL_BYTES)
    if at >= 0 and len(data) > SMALL_BYTES:
        with contextlib.suppress(ValueError, RecursionError):
            text = data[at + len(_ID) : at + SMALL_BYTES].decode(errors="ignore")
            rpc_id, _ = _DECODER.raw_decode(text.lstrip())
            return rpc_id if isinstance(rpc_id, _SCALARS) else None
    rpc_id = json_object(data).get("id")
    return rpc_id if isinstance(rpc_id, _SCALARS) else None


def _stop_request(request: dict[str, Any], data: bytes) -> RpcRequest:
    """Return a stop, whatever else its message holds."""
    rpc_id, params = request.get("id"), request.get("params", {})
    finite = not isinstance(rpc_id, float) or math.isfinite(rpc_id)
    rpc_id = rpc_id if isinstance(rpc_id, _SCALARS) and not isinstance(rpc_id, bool) and finite else None
    if "id" not in request or _params_problem(params):
        params = {}
        data = json.dumps({"jsonrpc": "2.0", "id": rpc_id, "method": request["method"], "params": params}).encode()
    return RpcRequest(request["method"], rpc_id, params, data)


def _check_request(request: dict[str, Any], data: bytes) -> RpcRequest | Refusal:
    if request.get("method") in STOPS:
        return _stop_request(request, data)
    if "id" not in request:
        return Refusal(INVALID_REQUEST, "id is missing")
    rpc_id = request["id"]
    if isinstance(rpc_id, bool) or not (rpc_id is None or isinstance(rpc_id, _SCALARS)):
        return Refusal(INVALID_REQUEST, f"id must be a string or a number, not {_kind(rpc_id)}")
    if isinstance(rpc_id, float) and not math.isfinite(rpc_id):
        return Refusal(INVALID_REQUEST, "id must be a finite number")
    if request.get("jsonrpc", "2.0") != "2.0":
        return Refusal(INVALID_REQUEST, f"jsonrpc must be '2.0', not {shown(request['jsonrpc'])}", rpc_id)
    method = request.get("method")
    if not isinstance(method, str) or not method:
        return Refusal(INVALID_REQUEST, f"method must be a name, not {shown(method)}", rpc_id)
    params = request.get("params", {})
    problem = _params_problem(params)
    return Refusal(INVALID_PARAMS, problem, rpc_id) if problem else RpcRequest(method, rpc_id, params, data)


def _params_problem(params: object) -> str:
    if not isinstance(params, dict):
        return f"params must be an object of named arguments, not {_kind(params)}"
    for name in _TAKEN:
        if name in params:
            return f"no function takes a parameter named {name!r}"
    meta = params.get("_dc_meta", {})
    if not isinstance(meta, dict):
        return f"_dc_meta must be an object, not {_kind(meta)}"
    for name, value in meta.items():
        if value is not None and not isinstance(value, str if name in _TRACE else _SCALARS):
            return f"_dc_meta.{shown(name)[1:-1]} must be text, not {_kind(value)}"
    source = meta.get("source_device", params.get("source_device"))
    if source is not None and not isinstance(source, str):
        return f"source_device must be text, not {_kind(source)}"
    return ""


def _kind(value: object) -> str:
    names = {dict: "an object", list: "an array", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")


def _no_constant(token: str) -> NoReturn:
    raise ValueError(f"{token} is no JSON number")


def _parse(data: bytes) -> Any:
    return _DECODER.decode(data.decode())


_DECODER = json.JSONDecoder(parse_constant=_no_constant)
_ID = b'"id":'
