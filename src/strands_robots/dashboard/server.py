"""Server of the page: files, a WebSocket of state, one for STOP, cameras."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from strands_robots import audit
from strands_robots.audit.journal import NAME as AUDIT_FILE
from strands_robots.dashboard.access import HEADERS, Access, OperatorKey, is_local
from strands_robots.dashboard.feeds import Feeds, poll_interval
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.history import SAMPLE_S, SILENT_S
from strands_robots.dashboard.page_robots import FleetStop, PageRobots
from strands_robots.dashboard.page_session import PageSession, Shared
from strands_robots.dashboard.pictures import BOUNDARY, mjpeg
from strands_robots.http_access import Guard

logger = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}

STOP_PRESSED = "STOP pressed"
HELLO_S = 5.0
WRONG_TOKEN_S = 1.0
LINK_S = 0.2
"""Seconds between two messages that the server is alive and reaches the network; a page that misses them says so."""

LINK_LOOK_S = 0.04
"""Seconds between two looks whether a stop would leave; a change is told at once."""

REFRESH_S, LOOK_S = 0.02, 0.25
AUDIT_S = 1.0
AUDIT_BYTES = 256 * 2**10
SAMPLED_AT_ONCE = 10
"""Robots that are sampled before other work, such as a stop, has a turn."""

SESSIONS_MAX = 64
MESSAGE_MAX = 64 * 2**10
NO_TICKET = "This page's ticket is needed.\n"


class Dashboard:
    """Server of all pages: the model, the feeds, STOP and the pictures.

    Args:
        model: the fleet.
        feeds: of its networks, which this closes at its end.
        access: who may open a page.
        operator_key: frees robots and takes control.
        source: the caller that robots see.
        signed: emergency stops are signed.
        starting: ids of robots that were started and will come.
    """

    def __init__(
        self,
        model: FleetModel,
        feeds: Feeds,
        access: Access,
        operator_key: OperatorKey | None = None,
        *,
        source: str = "dashboard",
        signed: bool = False,
        starting: tuple[str, ...] = (),
    ) -> None:
        self.model = model
        self.feeds, self.robots = feeds, PageRobots(model, feeds)
        self.access = access
        self.stop = FleetStop(model, feeds)
        self._shared = Shared(model, self.robots, operator_key or OperatorKey(None), source, signed, starting)
        self._sessions: dict[str, PageSession] = {}

    def app(self) -> ASGIApp:
        """Return the application, guarded."""
        routes = [
            WebSocketRoute("/state", self._state),
            WebSocketRoute("/stop", self._stop),
            Route("/camera", self._camera),
            Route("/history", self._history),
            Route("/series", self._series),
            Route("/", _file(STATIC / "index.html")),
            *(Route(f"/{each.name}", _file(each)) for each in sorted(STATIC.iterdir()) if each.suffix in TYPES),
        ]
        return Guard(Starlette(routes=routes, lifespan=self._lifespan), self.access, HEADERS, ("GET", "HEAD"))

    def close(self) -> None:
        """Give up a running stop and leave the networks."""
        self.robots.close()
        self.feeds.close()

    def end_pictures(self) -> None:
        """End every stream of pictures; on the server's loop."""
        self._shared.pictures.close()

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        work = (self._refresh_stop(), self._find_shared_ids(), self._sample(), self._follow_audit())
        tasks = [asyncio.create_task(each) for each in work]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            self.end_pictures()

    async def _refresh_stop(self) -> None:
        while True:
            with _logged("The answers to a stop could not be read."):
                self.stop.refresh()
            await asyncio.sleep(REFRESH_S if self.stop.running else 5 * REFRESH_S)

    async def _find_shared_ids(self) -> None:
        """Find which rows are of one robot."""
        while True:
            with _logged("Robots that are on several networks could not be looked at."):
                self.robots.look({key for each in self._sessions.values() for key in each.in_use})
            await asyncio.sleep(LOOK_S)

    async def _sample(self) -> None:
        """Take a sample of every robot's joints, lag and load, a few robots at a time."""
        clock = asyncio.get_running_loop().time
        due = clock()
        while True:
            with _logged("A sample of the fleet's history could not be taken."):
                keys = self.model.begin_sample()
                # A robot of a large fleet that does nothing is asked less often.
                self.model.history.silent_s = SILENT_S + poll_interval(len(keys))
                for first in range(0, len(keys), SAMPLED_AT_ONCE):
                    self.model.sample(keys[first : first + SAMPLED_AT_ONCE])
                    await asyncio.sleep(0)
            due = max(due + SAMPLE_S, clock())
            await asyncio.sleep(due - clock())

    async def _follow_audit(self) -> None:
        """Put new records of this machine's audit into the timeline."""
        path = audit.audit_directory() / AUDIT_FILE
        at = await asyncio.to_thread(_size, path)
        while True:
            await asyncio.sleep(AUDIT_S)
            records, at = await asyncio.to_thread(_new_records, path, at)
            for record in records:
                payload = record.get("payload")
                facts = payload if isinstance(payload, dict) else {}
                name, event = str(record.get("peer_id", "")), str(record.get("event", ""))
                # The page renews each lease that it holds four times a second.
                if (event, facts.get("action")) != ("command_executed", "renewControl"):
                    self.model.note("audit", name, event, facts, audit=True)

    async def _admitted(self, socket: WebSocket) -> str | None:
        """Accept a WebSocket and return the role of its first message, or None."""
        await socket.accept()
        try:
            async with asyncio.timeout(HELLO_S):
                hello = json.loads(await socket.receive_text())
        except (TimeoutError, ValueError, RecursionError, KeyError, WebSocketDisconnect):
            return None
        token = hello.get("token") if isinstance(hello, dict) else None
        role = self.access.role(token, local=is_local(socket.client))
        if role is None:
            await asyncio.sleep(WRONG_TOKEN_S)
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(4401, "token")
        return role

    async def _state(self, socket: WebSocket) -> None:
        role = await self._admitted(socket)
        if role is None:
            return
        if len(self._sessions) >= SESSIONS_MAX:
            await socket.close(4429, "too many pages")
            return
        session = PageSession(self._shared, socket, role, local=is_local(socket.client))
        self._sessions[session.ticket] = session
        try:
            await session.run()
        finally:
            self._sessions.pop(session.ticket, None)

    async def _stop(self, socket: WebSocket) -> None:
        """Take presses of STOP, and tell the page that they would arrive."""
        if await self._admitted(socket) is None:
            return
        telling = asyncio.create_task(self._tell_link(socket))
        try:
            while True:
                pressed = json.loads(await socket.receive_text())
                if isinstance(pressed, dict) and pressed.get("type") == "stop":
                    # Before anything else is done with it.
                    named = pressed.get("robot")
                    who = named[:128] if isinstance(named, str) else ""
                    only, cell = pressed.get("only"), pressed.get("cell")
                    # A robot that is not known here is no reason to stop none; both are no scope.
                    row = self.model.row(only) if isinstance(only, str) and cell is None else None
                    button = who or "all robots"
                    if row is not None:
                        self.stop.press_one(row.id)
                        button = f"{row.id} alone"
                    elif isinstance(cell, str) and only is None:
                        self.stop.press_cell(cell[:128])
                        button = f"cell {cell[:128]}"
                    else:
                        self.stop.press(who)
                    self.model.note_stop(STOP_PRESSED, {"button": button})
                    await socket.send_text(json.dumps({"type": "pressed", "id": pressed.get("id")}, default=str))
        except (ValueError, RecursionError, KeyError, RuntimeError, WebSocketDisconnect) as gone:
            logger.debug("A page is gone, or sent no message of this page: %s", type(gone).__name__)
        finally:
            telling.cancel()

    async def _tell_link(self, socket: WebSocket) -> None:
        clock, sent, due = asyncio.get_running_loop().time, None, 0.0
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            while True:
                state = self.stop.state()
                if state["can_stop"] is not sent or clock() >= due:
                    sent, due = state["can_stop"], clock() + LINK_S
                    await socket.send_text(json.dumps(state, allow_nan=False))
                await asyncio.sleep(LINK_LOOK_S)

    async def _camera(self, request: Request) -> Response:
        asked = request.query_params
        row = self.model.row(asked.get("robot", ""))
        feed = None if row is None else self.feeds.get(row.network)
        if asked.get("ticket", "") not in self._sessions:
            return PlainTextResponse(NO_TICKET, 403)
        if row is None or feed is None:
            return PlainTextResponse("No such robot.\n", 404)
        pictures = self._shared.pictures
        posed = asked.get("pose", "") != ""
        frames = pictures.pose(feed, row.id) if posed else pictures.camera(feed, row.id, asked.get("camera", "")[:128])
        stream = mjpeg(frames)
        return StreamingResponse(stream, media_type=f"multipart/x-mixed-replace; boundary={BOUNDARY.decode()}")

    async def _history(self, request: Request) -> Response:
        """Send the states of all robots, a line a robot, behind a line with the time."""
        asked = request.query_params
        if asked.get("ticket", "") not in self._sessions:
            return PlainTextResponse(NO_TICKET, 403)
        number, at = _number(asked.get("number")), _number(asked.get("at"))
        model = self.model
        head = {"number": model.history.number, "now": model.clock(), "wall": time.time(), "stops": model.stops()}
        keys = [row.key for row in model.rows()]
        return _lines(chain((json.dumps(head),), model.states(keys, int(number), at)))

    async def _series(self, request: Request) -> Response:
        """Send the samples of one robot."""
        asked = request.query_params
        if asked.get("ticket", "") not in self._sessions:
            return PlainTextResponse(NO_TICKET, 403)
        found = self.model.series(asked.get("robot", ""), _number(asked.get("after")))
        if found is None:
            return PlainTextResponse("No such robot.\n", 404)
        return _lines(found)


class QuietServer(uvicorn.Server):
    """Uvicorn without signal handlers, which the command has; it ends streams first.

    Args:
        config: of the listener.
        ending: ends the streams of its answers, which the server would wait for and then cut off.
    """

    def __init__(self, config: uvicorn.Config, ending: Callable[[], None]) -> None:
        super().__init__(config)
        self._ending = ending

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then everything else."""
        self._ending()
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """Leave the process's signals alone."""
        yield


def configured(app: ASGIApp, host: str, port: int, **tls: Any) -> uvicorn.Config:
    """Return the configuration of one listener."""
    return uvicorn.Config(
        app,
        host=host,
        port=port,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="websockets-sansio",
        ws_max_size=MESSAGE_MAX,
        ws_ping_interval=5.0,
        ws_ping_timeout=5.0,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=2,
        **tls,
    )


@contextlib.contextmanager
def _logged(problem: str) -> Iterator[None]:
    """Log what the block raises: the page goes on, and the next time may succeed."""
    try:
        yield
    except Exception:
        logger.exception(problem)


def _file(path: Path) -> Any:
    """Return a handler that answers from memory, without a thread a file."""
    content, kind = path.read_bytes(), TYPES[path.suffix]

    async def serve(request: Request) -> Response:
        return Response(content, media_type=kind)

    return serve


def _lines(lines: Iterable[str]) -> Response:
    """Return an answer of many lines; other work has a turn behind each."""

    async def sent() -> AsyncIterator[str]:
        for line in lines:
            yield line + "\n"
            await asyncio.sleep(0)

    return StreamingResponse(sent(), media_type="application/x-ndjson")


def _number(given: str | None) -> float:
    """Return a finite number of a query, 0 for anything else."""
    try:
        value = float(given or 0)
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _new_records(path: Path, at: int) -> tuple[list[dict[str, Any]], int]:
    """Return the audit records behind byte ``at``, and the end of the last one."""
    size = _size(path)
    if size == at:
        return [], at
    at = 0 if size < at else max(at, size - AUDIT_BYTES)
    try:
        with path.open("rb") as file:
            file.seek(at)
            data = file.read(AUDIT_BYTES)
    except OSError:
        return [], at
    whole = data.rfind(b"\n") + 1
    records = []
    for line in data[:whole].splitlines():
        with contextlib.suppress(ValueError, RecursionError):  # the first line may be a part of one
            record = json.loads(line)
            if isinstance(record, dict):
                records.append(record)
    return records, at + whole
