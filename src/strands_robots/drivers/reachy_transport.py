"""Talking to a Reachy Mini daemon with the standard library alone: its REST interface, and the door to its links.

:func:`api` never raises for what happens on the wire: every HTTP and connection failure is ``{"error": ...}``, so
that a driver can hand it on. The daemon has no authentication: whoever reaches its port moves the motors.
"""

from __future__ import annotations

import http.client
import json
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Any

from strands_robots.utils import ValidationError, choice, dial_host_error, port, shown

if TYPE_CHECKING:
    from strands_robots.drivers.reachy.links import WebSocketLink, ZenohLink

__all__ = ["WebSocketLink", "ZenohLink", "api"]

METHODS = ("GET", "POST", "PUT", "DELETE")

ANSWER_MAX = 4 * 2**20
"""Bytes of an answer that are read; the daemon's longest, the list of moves, is far below."""


def api(  # noqa: PLR0917 - the documented order
    host: str, api_port: int, path: str, method: str = "GET", data: Any = None, timeout: float = 5.0
) -> dict[str, Any] | list[Any] | Any:
    """One request to the daemon's REST interface; the decoded body, or ``{"error": why}``.

    Args:
        host: bare hostname or IP literal of the daemon.
        api_port: its TCP port, 8000 by default on a robot.
        path: with its query, such as ``/api/daemon/status``.
        method: GET, POST, PUT or DELETE.
        data: sent as JSON where it is not None.
        timeout: seconds without a byte after which the daemon counts as unreachable.
    """
    try:
        request = _request(host, api_port, path, method, data)
    except (ValidationError, TypeError, ValueError) as exc:
        return {"error": str(exc)}
    try:
        # Never through a proxy: the robot is on this network, and a proxy would answer in its place.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=timeout) as response:
            body = response.read(ANSWER_MAX + 1)
    except urllib.error.HTTPError as exc:
        with exc:
            return {"error": f"HTTP {exc.code} on {path}: {_detail(exc)}", "status_code": exc.code}
    except (OSError, http.client.HTTPException) as exc:
        reason = getattr(exc, "reason", exc)
        return {"error": f"{host}:{api_port} was not reached: {reason}"}
    if len(body) > ANSWER_MAX:
        return {"error": f"the answer to {path} is longer than {ANSWER_MAX} bytes"}
    try:
        return json.loads(body) if body.strip() else {}
    except ValueError:
        return {"error": f"the answer to {path} is no JSON: {shown(body)}"}


def _request(host: str, api_port: int, path: str, method: str, data: Any) -> urllib.request.Request:
    reason = dial_host_error(host)
    if reason is not None:
        raise ValidationError(reason)
    choice("method", method, METHODS)
    if not isinstance(path, str) or not path.startswith("/") or not path.isascii() or not path.isprintable():
        raise ValidationError(f"path must be printable ASCII and start with '/', not {shown(path)}.")
    if " " in path:
        raise ValidationError(f"path must not hold a blank; quote it: {shown(path)}.")
    bare = host.strip("[]")
    where = f"[{bare}]" if ":" in bare else bare
    body = None if data is None else json.dumps(data, allow_nan=False).encode()
    headers = {"Accept": "application/json"} | ({"Content-Type": "application/json"} if body is not None else {})
    url = f"http://{where}:{port('api_port', api_port)}{path}"
    return urllib.request.Request(url, data=body, headers=headers, method=method)


def _detail(exc: urllib.error.HTTPError) -> str:
    try:
        body = json.loads(exc.read(64 * 1024))
    except (OSError, ValueError, http.client.HTTPException):
        return str(exc.reason)
    detail = body.get("detail", body) if isinstance(body, dict) else body
    return detail if isinstance(detail, str) else shown(detail)


def __getattr__(name: str) -> Any:
    if name in ("WebSocketLink", "ZenohLink"):
        from strands_robots.drivers.reachy import links  # noqa: PLC0415 - the REST half needs nothing of it

        return getattr(links, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
